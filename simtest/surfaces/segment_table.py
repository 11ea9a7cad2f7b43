"""Finds the vessels near a point: a hash table of the cells of space that hold their segments.

A cell's slot lists every segment that is seen in it. Cells that share a slot share a list: a segment that is far away
adds nothing, so no slot has to be checked for whose it is. Renderer and NumPy read the same table.
"""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, IntArray

if TYPE_CHECKING:
    from simtest.surfaces.vessels import Segments

PRIMES = (73856093, 19349663, 83492791)
"""Factors of the hash of a cell's three numbers (Teschner et al. 2003)."""

LOAD = 0.5
"""Entries of lists over slots, at most: then few cells share a slot."""

SEGMENTS = 2**15
"""Segments that are sorted together: they bound the memory."""

MARGIN_MM = 0.02
"""Rounding of a point in single precision, and how far a mesh lies beside its smooth surface."""

CELL_PER_WIDTH = 3.0
"""Side of a cell over the median half-width of what is seen of a vessel."""

STEPS = 4
"""Points of a segment whose distance to a cell is taken."""

ENDLESS = 1e9
"""mm: farther than any point of a surface."""

SLACK = 0.5
"""How far a surface may leave the tangent plane of a vessel within its reach, over that reach."""


@dataclass(frozen=True)
class SegmentTable:
    """Segments by the cell in which they are seen.

    Parameters
    ----------
    cell_mm : float
        Side of a cell.
    first : ndarray of uint32, shape (slots + 1,)
        Where each slot's list starts in `rows`; the number of slots is a power of two.
    rows : ndarray of float32, shape (R, 8)
        Segments of the lists: start (3), half-width that is seen, end minus start (3), peak of the chord, mm; the last
        is negative for a vein.
    half_mm : ndarray, shape (3,)
        Along each axis of the model, how far from its origin the segments reach; beyond, they are mirrored over and
        over. `ENDLESS` where they are not.
    """

    cell_mm: float
    first: npt.NDArray[np.uint32]
    rows: npt.NDArray[np.float32]
    half_mm: Array = field(default_factory=lambda: np.full(3, ENDLESS))

    @property
    def mask(self) -> int:
        """What of a hash is the slot."""
        return len(self.first) - 2

    def mirrored(self, points: Array) -> Array:
        """Return the points among the segments that stand for points, shape (N, 3), mm."""
        number = np.round(points / (2 * self.half_mm))
        return np.asarray((points - 2 * number * self.half_mm) * np.where(number % 2, -1.0, 1.0))

    def slots(self, points: Array) -> IntArray:
        """Return the slots of points, shape (N, 3), mm."""
        return _hash(np.floor(points / self.cell_mm).astype(np.int64)) & self.mask

    def chords(self, points: Array) -> Array:
        """Return the chords, mm, through arteries and veins below points, shape (N, 3), mm; shape (N, 2).

        Of several segments the longest chord counts: neighbours along a vessel overlap.
        """
        points = self.mirrored(points)
        slot = self.slots(points)
        first, last = self.first[slot], self.first[slot + 1]
        found = np.zeros((len(points), 2))
        active = np.flatnonzero(last > first)
        row = first.astype(np.int64)
        while len(active):
            chord, vein = _chord(points[active], self.rows[row[active]].astype(np.float64))
            found[active, vein] = np.maximum(found[active, vein], chord)
            row[active] += 1
            active = active[row[active] < last[active]]
        return found


NO_VESSELS = SegmentTable(1.0, np.zeros(3, dtype=np.uint32), np.zeros((1, 8), dtype=np.float32))
"""The table of a surface without vessels."""


def _chord(points: Array, rows: Array) -> tuple[Array, IntArray]:
    """Return the chord through one segment below each point, and 1 for a vein."""
    start, width, along, peak = rows[:, :3], rows[:, 3], rows[:, 4:7], rows[:, 7]
    gap = points - start
    t = np.clip(np.sum(gap * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
    squared = np.sum((gap - t[:, None] * along) ** 2, axis=1)
    inside = np.maximum(1 - squared / width**2, 0)
    return np.abs(peak) * inside * np.sqrt(inside), (peak < 0).astype(np.int64)


def seen_profile(radius: Array, blur_mm: float) -> tuple[Array, Array]:
    """Return half-width R and peak, mm, of the chord L(x) = peak (1 - x^2/R^2)^(3/2) that is seen of a vessel.

    The chord through a cylinder is 2 sqrt(r^2 - x^2): area pi r^2, variance r^2/4. Scattering above it adds the blur's
    variance and leaves the area; this profile has both, is 0 from R on, and has no crease.
    """
    variance = radius**2 / 4 + blur_mm**2
    width = np.sqrt(6 * variance)
    return width, 8 * radius**2 / (3 * width)


def make_table(segments: "Segments", blur_mm: float, half_mm: Array) -> SegmentTable:
    """Sort segments into the cells in which they are seen, through a depth that blurs by a standard deviation, mm.

    For `half_mm` see `SegmentTable`.
    """
    width, peak = seen_profile(segments.radius, blur_mm)
    if not len(width):
        return NO_VESSELS
    cell_mm = CELL_PER_WIDTH * float(np.median(width))
    owner, cell = _cells(segments, width, cell_mm)
    slots = 1 << max(1, math.ceil(math.log2(len(owner) / LOAD)))
    slot = _hash(cell) & (slots - 1)
    first = np.zeros(slots + 1, dtype=np.uint32)
    first[1:] = np.cumsum(np.bincount(slot, minlength=slots))
    rows = np.column_stack([segments.start, width, segments.end - segments.start, np.where(segments.vein, -peak, peak)])
    sorted_rows = rows.astype(np.float32)[owner[np.argsort(slot, kind="stable")]]
    return SegmentTable(cell_mm, first, sorted_rows, half_mm)


def _cells(segments: "Segments", width: Array, cell_mm: float) -> tuple[IntArray, IntArray]:
    """Return pairs of a segment and a cell, shapes (P,) and (P, 3), in which it is seen on the surface."""
    parts = [
        _cells_of(segments, width, cell_mm, slice(start, start + SEGMENTS)) for start in range(0, len(width), SEGMENTS)
    ]
    owner, cell = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return owner, cell


def _cells_of(segments: "Segments", width: Array, cell_mm: float, some: slice) -> tuple[IntArray, IntArray]:
    """Return the pairs of some segments. Lengths are in cells, in single precision: `MARGIN_MM` covers its rounding."""
    start, end = segments.start[some] / cell_mm, segments.end[some] / cell_mm
    reach = ((width[some] + MARGIN_MM) / cell_mm)[:, None]
    low = np.floor(np.minimum(start, end) - reach).astype(np.int32)
    size = np.floor(np.maximum(start, end) + reach).astype(np.int32) - low + 1
    count = size.prod(axis=1)
    owner = np.repeat(np.arange(len(count), dtype=np.int32), count)
    index = np.arange(len(owner), dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    # Number of the cell in the segment's box: along z, y and x.
    rest, z = np.divmod(index, size[owner, 2])
    x, y = np.divmod(rest, size[owner, 1])
    steps = (x, y, z)
    near = (low + 0.5 - start).astype(np.float32)
    along, normal = (end - start).astype(np.float32), segments.normal[some].astype(np.float32)
    gap = [near[owner, axis] + steps[axis] for axis in range(3)]
    # Only cells that the surface can pass through, which leaves its tangent plane by less than the slack.
    slack = SLACK * (reach[:, 0] + np.linalg.norm(along, axis=1)) + np.abs(normal).sum(axis=1) / 2
    height = sum(gap[axis] * normal[owner, axis] for axis in range(3))
    kept = np.flatnonzero(np.abs(height) < slack.astype(np.float32)[owner])
    owner, gaps = owner[kept], np.stack([part[kept] for part in gap], axis=1)
    # Only cells that the vessel reaches: the distance from the cell to a few points of the segment, and half of the way
    # between these.
    nearest = np.full(len(owner), np.inf, dtype=np.float32)
    for i in range(STEPS):
        outside = np.maximum(np.abs(gaps - ((i + 0.5) / STEPS) * along[owner]) - 0.5, 0)
        np.minimum(nearest, np.einsum("ni,ni->n", outside, outside), out=nearest)
    reached = nearest < ((reach[:, 0] + np.linalg.norm(along, axis=1) / (2 * STEPS)) ** 2)[owner]
    owner, kept = owner[reached], kept[reached]
    cell = low[owner] + np.stack([step[kept] for step in steps], axis=1)
    return owner.astype(np.int64) + some.start, cell.astype(np.int64)


def _hash(cell: IntArray) -> IntArray:
    """Return a number below 2^32 for each cell, shape (N, 3)."""
    parts = [(cell[:, axis] * prime) & 0xFFFFFFFF for axis, prime in enumerate(PRIMES)]
    return parts[0] ^ parts[1] ^ parts[2]
