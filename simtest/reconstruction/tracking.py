"""Follows the same specularity from frame to frame by where it is."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

Array = npt.NDArray[np.float64]

REACH_SHARE = 0.03
"""How far a specularity may move between frames from where it is expected, as a share of the picture's longer side."""

LOST_FRAMES = 3
"""A track that was not seen in so many frames ends."""

DAMPING = 0.5
"""Share of the last step that is expected again."""


@dataclass
class _Track:
    number: int
    place: Array
    step: Array = field(default_factory=lambda: np.zeros(2))
    unseen: int = 0

    @property
    def expected(self) -> Array:
        return self.place + DAMPING * self.step


class Tracker:
    """Numbers specularities alike over the frames of a sequence.

    Each is given to the track nearest to it, all together by the least sum of distances; the rest begin new tracks.

    Parameters
    ----------
    size : tuple of int
        Width and height of the frames, px.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.reach = REACH_SHARE * max(size)
        self._tracks: list[_Track] = []
        self._count = 0

    def update(self, places: Sequence[Sequence[float]]) -> list[int]:
        """Give the track of each specularity of the next frame, by their positions, px."""
        points = np.asarray(places, dtype=float).reshape(-1, 2)
        numbers = [-1] * len(points)
        if len(points) and self._tracks:
            expected = np.array([track.expected for track in self._tracks])
            gaps = np.linalg.norm(points[:, None] - expected[None], axis=2)
            # Beyond its reach a pairing is worth no more than none.
            for i, j in zip(*linear_sum_assignment(np.minimum(gaps, self.reach)), strict=True):
                if gaps[i, j] < self.reach:
                    track = self._tracks[j]
                    track.step, track.place, track.unseen = points[i] - track.place, points[i], -1
                    numbers[i] = track.number
        for track in self._tracks:
            track.unseen += 1
        self._tracks = [track for track in self._tracks if track.unseen <= LOST_FRAMES]
        for i, number in enumerate(numbers):
            if number < 0:
                numbers[i] = self._count
                self._tracks.append(_Track(self._count, points[i]))
                self._count += 1
        return numbers
