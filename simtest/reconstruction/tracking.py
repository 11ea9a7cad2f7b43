"""The specularities of a sequence: what is kept of each frame, and which of them are the same from frame to frame."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject

REACH_SHARE = 0.03
"""How far a specularity may move between frames from where it is expected, as a share of the picture's longer side."""

LOST_FRAMES = 3
"""A track that was not seen in so many frames ends."""

DAMPING = 0.5
"""Share of the last step that is expected again."""


@dataclass(frozen=True)
class DoneFrame:
    """A frame that has its files: its number, its file's name or the film's with the number, and its specularities."""

    index: int
    name: str
    time_s: float | None
    count: int


@dataclass(frozen=True)
class Track:
    """The same specularity over frames: where it was seen, its best normals, and what motion tells of its shape."""

    track: int
    frames: list[int] = field(default_factory=list)
    times_s: list[float | None] = field(default_factory=list)
    peaks_px: list[list[float] | None] = field(default_factory=list)
    normals: list[list[float] | None] = field(default_factory=list)
    shapes: list[str] = field(default_factory=list)

    @property
    def shape(self) -> str:
        """What motion tells most often of the highlight's surface, and in how many of the frames."""
        (shape, count), *_ = Counter(self.shapes).most_common(1)
        return f"{shape}, {count} of {len(self.shapes)}"

    def to_json(self) -> JsonObject:
        """Return an entry of tracks.json; shapes only where poses are known."""
        return {key: value for key, value in vars(self).items() if key != "shapes" or value}


@dataclass
class _Moving:
    number: int
    position: Array
    size: tuple[int, int]
    step: Array = field(default_factory=lambda: np.zeros(2))
    unseen: int = 0


class Tracker:
    """Assigns the specularities of each frame to tracks; frames of another width and height, px, have other tracks.

    All are assigned together, by the least sum of distances to where tracks are expected; the rest begin new tracks.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self._tracks: list[_Moving] = []
        self._count = 0
        self._next = 0

    def update(
        self, positions_px: Sequence[npt.ArrayLike], index: int, size: tuple[int, int] | None = None
    ) -> list[int]:
        """Return the track of each specularity of the next frame that was read, by their positions, px.

        The frame is of the tracker's size, unless another is given.
        """
        # Imported here: slow to load, and single pictures have no tracks.
        from scipy.optimize import linear_sum_assignment

        size = size or self.size
        reach = REACH_SHARE * max(size)
        points = np.asarray(positions_px, dtype=float).reshape(-1, 2)
        numbers = [-1] * len(points)
        # In a frame that could not be read nothing was seen.
        for track in self._tracks:
            track.unseen += index - self._next
        self._tracks = [track for track in self._tracks if track.unseen <= LOST_FRAMES]
        self._next = index + 1
        # continue tracks
        tracks = [track for track in self._tracks if track.size == size]
        if len(points) and tracks:
            expected = np.array([track.position + DAMPING * track.step for track in tracks])
            gaps = np.linalg.norm(points[:, None] - expected[None], axis=2)
            # Beyond its reach a pairing is worth no more than none.
            for i, j in zip(*linear_sum_assignment(np.minimum(gaps, reach)), strict=True):
                if gaps[i, j] < reach:
                    track = tracks[j]
                    track.step = (points[i] - track.position) / (track.unseen + 1)
                    track.position, track.unseen = points[i], -1
                    numbers[i] = track.number
        # end those that were lost
        for track in self._tracks:
            track.unseen += 1
        self._tracks = [track for track in self._tracks if track.unseen <= LOST_FRAMES]
        # begin new ones
        for i, number in enumerate(numbers):
            if number < 0:
                numbers[i] = self._count
                self._tracks.append(_Moving(self._count, points[i], size))
                self._count += 1
        return numbers
