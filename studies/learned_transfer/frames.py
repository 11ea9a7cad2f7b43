"""Whole frames of the corpus `hard` with their truth, kept in files: rendered once, judged often.

`studies.hard` keeps single highlights; a network needs the frame. The scenes are those of `studies.hard.scenes`, with
numbers of their own. Rows change them as the rows of `studies.hard` do, but every frame is a picture (sRGB, 8 bits),
which is what a network was taught. The corpus has one light at the camera; the rows of `GUIDES` have the two light
guides of a colonoscope, since the networks know no rig of one light.
"""

import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration, Frame, Normal
from simtest.errors import InputError, SimtestError
from simtest.runtime.arrays import AnyArray, Array, Image
from simtest.runtime.files import make_folder, write_atomically
from simtest.runtime.seeds import key as hashed
from simtest.simulation.frame import RenderedView
from simtest.simulation.sensor import displayed
from studies.hard.cases import scene_of
from studies.hard.measure import Frames
from studies.hard.rows import PICTURE, Row, lit_from, moving, plain, vessels, wide, with_relief
from studies.hard.scenes import Tables, kind_of

FIRST = 9000
"""Number of the first scene; those of `studies.hard` end before, so no figure was ever quoted on these."""

DISTANCE_MM, DISTANCE_SD = 30.0, 15.0
"""What is told of the distance, as in the dataset that the networks learn from; they do not see it."""

SMOOTHING_PX = 1.0

Change = Callable[[int, Tables], Tables]


def by_guides(change: Change) -> Change:
    """Return a change of the corpus with the two light guides of a colonoscope instead of a light at the camera."""

    def changed(number: int, tables: Tables) -> Tables:
        return change(number, tables) | {"rig": {"preset": "colonoscope_2"}}

    return changed


def _picture(**more: object) -> Callable[[int], Tables]:
    return lambda number: PICTURE | {"saturation": True} | more


ONE_LIGHT = (
    Row("one light at the camera", plain, _picture()),
    Row("one light 3 mm beside the camera", lit_from(3.0), _picture()),
)
"""Rows with the corpus's own rig."""

GUIDES = (
    Row("relief 0 deg", by_guides(with_relief(0.0)), _picture()),
    Row("relief 2 deg", by_guides(with_relief(2.0)), _picture()),
    Row("relief 4 deg", by_guides(with_relief(4.0)), _picture()),
    Row("vessels", by_guides(vessels), _picture()),
    Row("JPEG 60", by_guides(vessels), _picture(coding={"type": "jpeg", "quality": 60})),
    Row("exposed for the tissue", by_guides(vessels), _picture(exposure={"average": 0.4})),
    Row("motion 7 px", by_guides(moving(7.0)), _picture()),
)
"""Rows with a rig and a lens that the networks know."""

LENS = (Row("wide-angle lens", by_guides(wide), _picture()),)

ROWS = (*ONE_LIGHT, *GUIDES, *LENS)


@dataclass(frozen=True)
class HardFrame:
    """A frame with its truth.

    Parameters
    ----------
    scene : int
        Number of the scene.
    row : Row
        Of `ROWS`.
    picture : ndarray of uint8, shape (H, W, 3)
        RGB as encoded.
    normal_base : ndarray of float16, shape (H, W, 3)
        The base's true unit normal at each pixel, camera frame; NaN off the surface.
    depth : ndarray of float32, shape (H, W)
        Distance along the ray, mm; NaN off the surface.
    peaks : ndarray, shape (N, 2)
        Peaks of the visible highlights, px.
    fine : ndarray, shape (N, 3)
        The fine surface's true normal at the only glint of each; NaN where it holds none or several.
    """

    scene: int
    row: Row
    picture: AnyArray
    normal_base: AnyArray
    depth: AnyArray
    peaks: Array
    fine: Array

    @property
    def kind(self) -> str:
        """What is seen: plane, colon, ..."""
        return kind_of(self.scene)

    @cached_property
    def encoded(self) -> Image:
        """The picture in [0, 1]."""
        return self.picture.astype(np.float32) / np.float32(255)

    @cached_property
    def calibration(self) -> Calibration:
        """What reconstruction is told: camera, response, lights, and the distance within 15 mm."""
        told = scene_of(self.scene, self.row)[1].calibration()
        priors = replace(told.priors, distance_mm=Normal(DISTANCE_MM, DISTANCE_SD))
        return replace(told, priors=priors, saturation_level=1.0)

    def frame(self) -> Frame:
        """Return the picture as estimators see it."""
        return Frame(self.encoded, self.calibration, SMOOTHING_PX)


def hard_frames(scenes: Sequence[int], rows: Sequence[Row], folder: Path) -> Iterator[HardFrame]:
    """Yield the frames of scenes; what the folder does not hold is rendered and kept there.

    A row that a scene cannot show is told on stderr and left out.
    """
    make_folder(folder)
    for number in scenes:
        renderer: Frames | None = None
        for row in rows:
            file = folder / f"{number}_{row.name.replace(' ', '_')}.npz"
            if not file.exists():
                started, renderer = time.process_time(), renderer or Frames(number)
                made = _rendered(renderer, row)
                write_atomically(file, lambda part, made=made: _write(part, made))
                took = time.process_time() - started
                print(f"scene {number}, {row.name}: {took:.1f} s of processor time", file=sys.stderr, flush=True)
            with np.load(file, allow_pickle=False) as kept:
                if "why_not" in kept:
                    continue
                yield HardFrame(number, row, **{name: kept[name] for name in ARRAYS})


ARRAYS = ("picture", "normal_base", "depth", "peaks", "fine")


def _rendered(renderer: Frames, row: Row) -> dict[str, AnyArray]:
    """Render a row; return its arrays, or one text with the reason why the scene cannot show it."""
    number = renderer.number
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            view = renderer.view(row)
    except SimtestError as error:
        print(f"scene {number}, {row.name}: {error}", file=sys.stderr)
        return {"why_not": np.array(json.dumps(str(error)))}
    assert renderer.session is not None
    truth = renderer.session.truth()
    seen = view.frame(hashed(f"transfer {row.name} {number}") >> 1)
    picture = np.rint(255 * displayed(seen, view.scene.sensor)).astype(np.uint8)
    if picture.ndim == 2:
        raise InputError(f"scene {number}, {row.name}: a grey picture; networks see colour")
    spots = view.visible_highlights
    return {
        "picture": picture,
        "normal_base": truth.normal_base.astype(np.float16),
        "depth": truth.depth.astype(np.float32),
        "peaks": np.array([spot.peak_px for spot in spots], dtype=float).reshape(-1, 2),
        "fine": np.array([_fine(view, spot.glints) for spot in spots], dtype=float).reshape(-1, 3),
    }


def _fine(view: RenderedView, glints: Sequence[int]) -> Array:
    """Return the true normal at the only glint of a visible highlight; NaN where it is not the only one."""
    return view.highlights[glints[0]].normal if len(glints) == 1 else np.full(3, math.nan)


def _write(part: Path, arrays: dict[str, AnyArray]) -> None:
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
