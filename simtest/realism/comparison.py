"""Compares generated frames with real ones: measures both sets, and says what was found."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.realism.distance import LEAST_SCENES, StatisticDistance, by_scene, distances, quartiles
from simtest.realism.frame_sets import NamedFrame
from simtest.realism.frame_statistics import COLUMNS, STATISTICS, Measured, Statistic, measure
from simtest.runtime.arrays import Image, Picture
from simtest.runtime.files import Json

Progress = Callable[[int, int, str], None]
"""Called with frames measured, frames in all, and what is done; may raise to stop."""

Side = Literal["real", "generated"]

SHOWN, SHOWN_HEIGHT_PX = 8, 240
"""Frames of each side that a page shows, evenly spread, and their greatest height."""

Quartiles = tuple[float, float, float]
"""First quartile, median and third quartile."""


@dataclass(frozen=True)
class LeftOut:
    """A frame that could not be measured: its side, its name and why."""

    side: Side
    frame: str
    reason: str


@dataclass(frozen=True)
class SetOfFrames:
    """What was measured of one side.

    Parameters
    ----------
    scenes : dict
        Measured values by scene.
    frames, without_highlights : int
        How many frames were measured, and how many of them show no highlight.
    pictures : list of (str, ndarray)
        Name and small picture, RGB, of some frames.
    """

    scenes: dict[str, Measured]
    frames: int
    without_highlights: int
    pictures: list[tuple[str, Picture]]

    def quartiles(self, column: str) -> Quartiles | None:
        """Return the quartiles of a column, each scene with the same weight; None where no frame tells it."""
        return quartiles(self.scenes, column)

    @property
    def counts(self) -> dict[str, Json]:
        """How many scenes and frames were measured."""
        return {"scenes": len(self.scenes), "frames": self.frames, "without_highlights": self.without_highlights}


@dataclass(frozen=True)
class Comparison:
    """Two sets of frames and their distances, in the order of `STATISTICS`."""

    real: SetOfFrames
    generated: SetOfFrames
    distances: list[StatisticDistance]
    left_out: list[LeftOut]

    @property
    def verdict(self) -> str:
        """A sentence on all statistics together."""
        near, far, few = (sum(d.verdict == word for d in self.distances) for word in ("near", "far", "too few scenes"))
        judged = len(self.distances) - few
        if not judged:
            scenes = f"{len(self.real.scenes)} real and {len(self.generated.scenes)} generated"
            return f"too few scenes: {scenes}; a verdict needs {LEAST_SCENES} of each"
        text = f"{near} of {judged} statistics are near the real frames, {far} {'is' if far == 1 else 'are'} far"
        return text + (f"; {few} {'has' if few == 1 else 'have'} too few scenes" if few else "")

    def is_inside(self, column: str) -> bool | None:
        """Return whether the generated median lies between the real quartiles; None where a side has no value."""
        real, generated = self.real.quartiles(column), self.generated.quartiles(column)
        return None if real is None or generated is None else real[0] <= generated[1] <= real[2]

    def to_json(self) -> dict[str, Json]:
        """Return distances with their intervals, and quartiles of both sides by column."""
        left_out: list[Json] = [vars(frame) for frame in self.left_out]
        return {
            "verdict": self.verdict,
            "sets": {"real": self.real.counts, "generated": self.generated.counts},
            "statistics": [self._row(d) for d in self.distances],
            "real": {name: self.real.quartiles(name) for name in COLUMNS},
            "generated": {name: self.generated.quartiles(name) for name in COLUMNS},
            "left_out": left_out,
        }

    def _row(self, d: StatisticDistance) -> Json:
        return {
            "statistic": d.statistic.name,
            "distance": plain(d.distance),
            "ci95": [plain(v) for v in d.interval],
            "verdict": d.verdict,
            "real_scenes": d.n_real,
            "generated_scenes": d.n_generated,
            "median_inside_real_quartiles": {name: self.is_inside(name) for name in d.statistic.columns},
        }


def compare(
    real: Sequence[NamedFrame], generated: Sequence[NamedFrame], progress: Progress | None = None, seed: int = 0
) -> Comparison:
    """Measure both sets and compare them; frames that cannot be measured are left out with their reason."""
    total, done = len(real) + len(generated) + 1, 0
    left_out: list[LeftOut] = []
    sides = []
    names: tuple[Side, Side] = ("real", "generated")
    for side, frames in zip(names, (real, generated), strict=True):
        measured: list[tuple[str, Measured]] = []
        pictures = []
        shown = {int(i) for i in np.linspace(0, len(frames) - 1, min(SHOWN, len(frames)))}
        for number, frame in enumerate(frames):
            if progress:
                progress(done, total, f"measuring {frame.name}")
            try:
                picture = frame.read()
                measured.append((frame.scene, measure(picture)))
                if number in shown:
                    pictures.append((frame.name, small(picture, SHOWN_HEIGHT_PX)))
            except InputError as error:
                left_out.append(LeftOut(side, frame.name, str(error)))
            done += 1
        if not measured:
            reason = left_out[-1].reason if left_out else "the set is empty"
            raise InputError(f"realism: no {side} frame can be measured ({reason})")
        bare = sum(not values["per_frame"].any() for _, values in measured)
        sides.append(SetOfFrames(by_scene(measured), len(measured), bare, pictures))
    if progress:
        progress(done, total, "comparing the distributions")
    found = Comparison(sides[0], sides[1], distances(sides[0].scenes, sides[1].scenes, seed), left_out)
    if progress:
        progress(total, total, "compared")
    return found


def small(picture: Image, height: int) -> Picture:
    """Return a picture of values in [0, 1], RGB, as bytes and at most so high."""
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    share = height / values.shape[0]
    if share >= 1:
        return values
    return np.asarray(cv2.resize(values, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8)


def statistic_of(column: str) -> tuple[Statistic, str]:
    """Return the statistic that a column belongs to, and what the column's axis says."""
    return next((s, axis) for s in STATISTICS for name, axis in zip(s.columns, s.axes, strict=True) if name == column)


def plain(value: float) -> float | None:
    """Return what JSON holds of a number: None where it is not finite."""
    return value if math.isfinite(value) else None
