"""Scores of a detected mask against the true one: highlight by highlight, and pixel by pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import SPECULAR_MIN_AREA_PX
from studies.detection.truth import SpecularTruth

Mask = npt.NDArray[np.bool_]

MATCH_IOU = 0.5
"""A detection is that highlight with which it shares at least this part of their union: there is one at most."""


@dataclass(frozen=True)
class Scores:
    """Counts of one frame or of many; they add up.

    `hits`, `false`, `missed`: highlights; `pixel_hits`, `pixel_false`, `pixel_missed`: pixels.
    """

    hits: int = 0
    false: int = 0
    missed: int = 0
    pixel_hits: int = 0
    pixel_false: int = 0
    pixel_missed: int = 0

    def __add__(self, other: "Scores") -> "Scores":
        return Scores(*(getattr(self, name) + getattr(other, name) for name in self.__dataclass_fields__))

    @property
    def precision(self) -> float:
        """Share of the detected highlights that are true; NaN where there are none."""
        return _share(self.hits, self.hits + self.false)

    @property
    def recall(self) -> float:
        """Share of the true highlights that are detected; NaN where there are none."""
        return _share(self.hits, self.hits + self.missed)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return _share(2 * self.hits, 2 * self.hits + self.false + self.missed)

    @property
    def dice(self) -> float:
        """The same over pixels."""
        return _share(2 * self.pixel_hits, 2 * self.pixel_hits + self.pixel_false + self.pixel_missed)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def score(detected: Mask, truth: SpecularTruth) -> Scores:
    """Score a frame.

    `detected` (shape (H, W)): pixels told to be highlights. Connected ones are one highlight; `truth`: of the same
    frame. Detected pixels of what is unclear are not counted, nor detected highlights that touch it or have too few
    pixels to be a clear one, where they are on no clear one.
    """
    found, labels = cv2.connectedComponents(detected.astype(np.uint8), connectivity=8)
    count, true = found - 1, truth.count
    both = labels.ravel() * (true + 1) + truth.labels.ravel()
    shared = np.bincount(both, minlength=found * (true + 1)).reshape(found, true + 1)
    area, true_area = shared.sum(axis=1)[1:], shared.sum(axis=0)[1:]
    common = shared[1:, 1:]
    union = area[:, None] + true_area[None] - common
    hits = int(np.count_nonzero(common >= MATCH_IOU * union))
    on_unclear = np.bincount(labels.ravel(), weights=truth.unclear.ravel(), minlength=found)[1:] > 0
    free = (common.sum(axis=1) == 0) & (on_unclear | (area < SPECULAR_MIN_AREA_PX))
    pixel_hits = int(np.count_nonzero(detected & truth.mask))
    return Scores(
        hits,
        count - hits - int(np.count_nonzero(free)),
        true - hits,
        pixel_hits,
        int(np.count_nonzero(detected & ~truth.mask & ~truth.unclear)),
        int(np.count_nonzero(truth.mask)) - pixel_hits,
    )
