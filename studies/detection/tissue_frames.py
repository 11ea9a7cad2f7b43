"""Frames of the shipped tissue scenes with other seeds, and what can be seen in them; kept in a folder."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtest.rendering import Session
from simtest.runtime.files import make_folder, write_atomically
from simtest.simulation.frame import RenderedView, render_view
from simtest.simulation.sensor import displayed
from simtest.spec import load_scene
from studies.kept import of_this_code

TISSUES = ("colon", "stomach", "liver", "gallbladder")

SEEDS = {"tuning": 100, "figures": 920}
"""Where the seeds of relief, viewpoint and noise begin: no frame is in both splits."""


@dataclass(frozen=True)
class TissueFrame:
    """A tissue frame with its visible highlights (theory.md 7.1b).

    `name`: tissue and seed; `picture` (shape (H, W, 3)): RGB as encoded; `peaks` (shape (N, 2)): peaks of the
    visible highlights, px; `radii` (shape (N,)): their radii at half height, px; `clearness` (shape (N,)): peak
    over noise; `whole` (shape (N,)): whether they are clear of the frame's border; `clipped` (shape (N,)): share of
    their pixels that the sensor clips in the mean of the channels; `regions` (shape (H, W)): number of the visible
    highlight from 1, 0 elsewhere.
    """

    name: str
    picture: npt.NDArray[np.uint8]
    peaks: npt.NDArray[np.float64]
    radii: npt.NDArray[np.float64]
    clearness: npt.NDArray[np.float64]
    whole: npt.NDArray[np.bool_]
    clipped: npt.NDArray[np.float64]
    regions: npt.NDArray[np.int32]


def tissue_frames(split: str, count: int, folder: Path, tissues: tuple[str, ...] = TISSUES) -> Iterator[TissueFrame]:
    """Yield so many frames of each tissue; what the folder does not hold is rendered and kept there."""
    folder = of_this_code(folder)
    make_folder(folder)
    for tissue in tissues:
        session: Session | None = None
        for seed in range(SEEDS[split], SEEDS[split] + count):
            file = folder / f"{tissue}_{seed}.npz"
            if not file.exists():
                scene = load_scene(f"tissue_{tissue}", _settings(tissue, seed))
                session = session or Session(scene)
                made = _frame(f"{tissue} {seed}", render_view(session, scene), seed)
                write_atomically(file, lambda part, made=made: _write(part, made))
            with np.load(file) as kept:
                yield TissueFrame(f"{tissue} {seed}", **kept)


def _settings(tissue: str, seed: int) -> dict[str, int]:
    """Return what differs from the shipped scene: viewpoint, relief and noise."""
    viewpoint = {} if tissue == "gallbladder" else {"surface.viewpoint": seed}
    return {**viewpoint, "surface.relief.seed": seed, "sensor.seed": seed}


def _frame(name: str, view: RenderedView, seed: int) -> TissueFrame:
    from simtest.simulation.highlights import find_spots
    from simtest.simulation.sensor import collect

    picture = np.rint(255 * displayed(view.frame(seed), view.scene.sensor)).astype(np.uint8)
    light = view.light if view.light.ndim == 2 else view.light.mean(axis=2)
    specular = collect(view.radiance.specular, view.scene.sensor, view.calibration.camera)
    regions = find_spots(light, specular if specular.ndim == 2 else specular.mean(axis=2), view.calibration.camera.seen)
    spots = view.visible_highlights
    numbers = regions.regions.astype(np.int32)
    area = np.bincount(numbers.ravel(), minlength=len(spots) + 1)
    over = np.bincount(numbers.ravel(), weights=(light >= view.full_scale).ravel(), minlength=len(spots) + 1)
    return TissueFrame(
        name, picture,
        np.array([s.peak_px for s in spots]).reshape(-1, 2),
        np.array([s.radius_px for s in spots]),
        np.array([s.peak_snr for s in spots]),
        np.array([s.whole for s in spots], dtype=bool),
        over[1:] / np.maximum(area[1:], 1),
        numbers,
    )  # fmt: skip


def _write(part: Path, frame: TissueFrame) -> None:
    with part.open("wb") as file:
        np.savez_compressed(file, **{k: v for k, v in vars(frame).items() if k != "name"})
