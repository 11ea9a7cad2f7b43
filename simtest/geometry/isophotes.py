"""Isophotes around a peak: the border of the region above a share of the peak that holds the peak."""

from dataclasses import dataclass, field

import numpy as np

from simtest.errors import Failure, InputError, Reason
from simtest.geometry.level_sets import Crossings, LevelSet, crossings, cut_level_set_around, level_set_around
from simtest.runtime.arrays import Array, Image, Mask

CUT_SIGMAS = 1.5
"""Nearer than this to a cut, over the smoothing's standard deviation, an isophote is left out: smoothing moves it, at
the cut by 0.8 of that deviation, at this distance by 0.06."""


@dataclass(frozen=True, eq=False)
class IsophoteTracer:
    """The level sets around one peak, each found once; the fields are those of `simtest.geometry.Patch`.

    What it holds depends on its fields alone, so nobody needs to clear it.
    """

    values: Image | Array
    peak_pixel: tuple[int, int]
    peak_value: float
    seen: Mask | None
    smoothing_px: float
    _closed: dict[float, LevelSet | Failure] = field(default_factory=dict, init=False, repr=False)
    _cut: dict[float, LevelSet] = field(default_factory=dict, init=False, repr=False)
    _crossings: dict[tuple[LevelSet, ...], Crossings] = field(default_factory=dict, init=False, repr=False)

    def finds_the_same_as(self, other: "IsophoteTracer") -> bool:
        """Return whether another tracer works on the same arrays, not copies, with the same peak and smoothing."""
        arrays = self.values is other.values and self.seen is other.seen
        peaks = self.peak_pixel == other.peak_pixel and self.peak_value == other.peak_value
        return arrays and peaks and self.smoothing_px == other.smoothing_px

    def closed(self, isovalue: float) -> LevelSet | Failure:
        """Return the region above t times the peak; a Failure where its border does not close."""
        if isovalue not in self._closed:
            level = _checked(isovalue) * self.peak_value
            self._closed[isovalue] = level_set_around(self.values, self.peak_pixel, level, self.seen) or Failure(
                Reason.NO_CLOSED_ISOPHOTE, f"none around the peak at t = {isovalue:g}"
            )
        return self._closed[isovalue]

    def cut(self, isovalue: float) -> LevelSet:
        """Return the same region where the border or the view may cut it, its border open there."""
        if isovalue not in self._cut:
            margin = max(int(np.ceil(CUT_SIGMAS * self.smoothing_px)), 1)
            level = _checked(isovalue) * self.peak_value
            self._cut[isovalue] = cut_level_set_around(self.values, self.peak_pixel, level, margin, self.seen)
        return self._cut[isovalue]

    def crossings(self, sets: list[LevelSet]) -> Crossings:
        """Return where the borders of level sets cross the lines between pixel centres."""
        # Usually the points are used first, then how they move.
        key = tuple(sets)
        if key not in self._crossings:
            self._crossings[key] = crossings(sets)
        return self._crossings[key]


def _checked(isovalue: float) -> float:
    if not 0 < isovalue < 1:
        raise InputError(f"isovalue t = {isovalue!r}: must be inside (0, 1)")
    return isovalue


def encloses(points: Array, point: Array) -> bool:
    """Return whether a closed polygon, shape (N, 2), encloses a point, shape (2,), by the even-odd rule."""
    x, y = (points - point).T
    crosses = (y[:-1] > 0) != (y[1:] > 0)
    x0, y0, x1, y1 = x[:-1][crosses], y[:-1][crosses], x[1:][crosses], y[1:][crosses]
    return bool(np.count_nonzero(x0 - y0 * (x1 - x0) / (y1 - y0) > 0) % 2)
