"""Frames of three organs whose relief is scaled to a slope, with the normals of their base; kept on disk."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration
from simtest.errors import SimtestError
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Image, IntArray
from simtest.simulation.frame import render_picture
from simtest.spec import scene_from_dict
from studies.clouds.frames import tissue_scene
from studies.kept import write_arrays

ORGANS = ("colon", "liver", "gallbladder")
SLOPES_DEG = (3.0, 6.0, 10.0, 17.0)
HEIGHTS_MM = {"colon": 0.226, "liver": 0.226, "gallbladder": 0.138}
"""Of the shipped relief."""

HIGHEST_MM = 0.27
"""Steeper relief is drawn finer, so that it stays below this."""

STRIDE = 4
"""Of the pixels whose base normal is kept, px."""


@dataclass(frozen=True)
class BaseFrame:
    """A rendered picture, shape (H, W, 3), with its base.

    `normals`, (H / STRIDE, W / STRIDE, 3), NaN or zero off the surface; of the lit highlight points of the base
    `lights`, (K,), `points_px`, (K, 2), `point_normals`, (K, 3), and `distances`, (K,), mm.
    """

    data: Mapping[str, object]
    picture: Image
    normals: Array
    lights: IntArray
    points_px: Array
    point_normals: Array
    distances: Array

    @property
    def calibration(self) -> Calibration:
        """What reconstruction is told."""
        scene = scene_from_dict(dict(self.data))
        return scene.calibration(float(self.distances.min()) if len(self.distances) else None)

    def normal_at(self, pixel: Array) -> Array | None:
        """Return the base's normal at a pixel, none off the surface."""
        column, row = (int(v // STRIDE) for v in pixel)
        if not (0 <= row < self.normals.shape[0] and 0 <= column < self.normals.shape[1]):
            return None
        normal = self.normals[row, column]
        return np.asarray(normal, dtype=float) if np.abs(normal).sum() > 0.5 else None


def organ_scene(organ: str, slope_deg: float, seed: int) -> dict[str, object]:
    """Return a shipped tissue scene with its own rig, its relief scaled to a slope along one direction."""
    data = tissue_scene(organ, seed)
    bands = data["surface"]["relief"]["bands"]
    scale = slope_deg / float(np.sqrt(sum(band["slope_deg"] ** 2 for band in bands)))
    finer = min(1.0, HIGHEST_MM / (HEIGHTS_MM[organ] * scale))
    for band in bands:
        band["slope_deg"] *= scale
        band["wavelength_mm"] *= finer
    return data


def frames(first: int, many: int, folder: Path) -> Iterator[tuple[str, float, int, BaseFrame]]:
    """Yield organ, slope, deg, seed and frame; `many` of each organ and slope, seeds from `first` on."""
    yield from loaded(
        (
            (organ, slope, first + 1000 * o + len(SLOPES_DEG) * i + s)
            for o, organ in enumerate(ORGANS)
            for i in range(many)
            for s, slope in enumerate(SLOPES_DEG)
        ),
        folder,
    )


def loaded(cases: Iterable[tuple[str, float, int]], folder: Path) -> Iterator[tuple[str, float, int, BaseFrame]]:
    """Yield organ, slope, deg, seed and frame of each case, organs one after the other; say which cannot be made."""
    session, of = None, ""
    for organ, slope, seed in cases:
        session, of = (session if organ == of else None), organ
        try:
            frame, session = load(organ_scene(organ, slope, seed), folder / f"{organ}_{slope:g}_{seed}.npz", session)
        except SimtestError as error:
            print(f"{organ}, {slope:g} deg, seed {seed}: {error}")
            continue
        yield organ, slope, seed, frame


def load(data: dict[str, object], file: Path, session: Session | None) -> tuple[BaseFrame, Session | None]:
    """Return a frame from a file, or render it there; with the session, for the next one."""
    if not file.exists():
        arrays, session = _render(data, session)
        text = np.frombuffer(json.dumps(data).encode(), dtype=np.uint8)
        write_arrays(file, {**arrays, "data": text})
    with np.load(file) as kept:
        arrays = {name: kept[name] for name in kept.files}
    return BaseFrame(json.loads(arrays.pop("data").tobytes()), **arrays), session


def _render(data: dict[str, object], session: Session | None) -> tuple[dict[str, Array], Session]:
    scene = scene_from_dict(data)
    session = session or Session(scene)
    session.update(scene)
    radiance = session.radiance()
    points = [point for point in session.base_highlights(radiance) if point.lit]
    normals = np.asarray(session.truth(STRIDE).normal_base)
    return {
        "picture": np.asarray(render_picture(session, scene, radiance), dtype=np.float32),
        "normals": normals.astype(np.float32),
        "lights": np.array([point.light for point in points], dtype=np.int64),
        "points_px": np.array([point.bp_px for point in points]).reshape(-1, 2),
        "point_normals": np.array([point.normal_base for point in points]).reshape(-1, 3),
        "distances": np.array([point.distance for point in points]),
    }, session
