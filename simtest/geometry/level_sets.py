"""The region above a level around a pixel, and where its outer border crosses the lines between pixel centres.

These are the points of marching squares, whose contours are the region's border. A fit needs no order among them, and
without it they are found several times faster than by tracing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from skimage.measure import find_contours

from simtest.runtime.arrays import AnyArray, Array, Image, Index, Mask

LINEAR_INTERPOLATION_PX2 = 1 / 6
"""Variance that linear interpolation between two pixels adds along their axis, px^2, averaged over the gap.

At share f of the way between neighbours it overestimates I by f (1 - f) I'' / 2, on average I'' / 12, as a convolution
of variance 1/6 does.
"""

_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
_AT_PIXEL = 0.5 - 1e-9
_ABOVE, _REGION, _OUTSIDE = 1, 2, 3


@dataclass(frozen=True)
class Crossings:
    """Where the borders of K level sets cross the lines between pixel centres, by linear interpolation.

    One set after the other; in each, row by row, first the points between horizontal neighbours, then those between
    vertical ones. A pixel whose value is the level, where several lines cross the border, counts once.
    """

    counts: Index  # (K,): points of each set
    first: Index  # (N, 2): column and row of each line's first pixel in the regions' array
    vertical: Mask  # (N,): whether the line is vertical; else it is horizontal
    share: Array  # (N,): distance of the crossing from the first pixel, px
    rise: Array  # (N,): intensity of the line's second pixel less that of its first

    @property
    def points(self) -> Array:
        """The points, shape (N, 2), integer-centred."""
        points = self.first.astype(float)
        points[:, 0] += self.share * ~self.vertical
        points[:, 1] += self.share * self.vertical
        return points

    @property
    def pixels(self) -> Index:
        """Column and row of each line's two pixels in the regions' array, shape (N, 2, 2)."""
        ends = np.empty((len(self.first), 2, 2), dtype=np.intp)
        ends[:, 0] = ends[:, 1] = self.first
        ends[:, 1, 0] += ~self.vertical
        ends[:, 1, 1] += self.vertical
        return ends

    @property
    def by_level(self) -> Array:
        """Derivative of each point along its line by the level, px per unit of intensity, shape (N,)."""
        return 1 / self.rise

    @property
    def by_pixels(self) -> Array:
        """Derivatives of each point along its line by the intensities of the line's two pixels, shape (N, 2)."""
        second = -self.share * self.by_level
        return np.array([-self.by_level - second, second]).T

    def each(self, table: AnyArray) -> list[AnyArray]:
        """Cut a table of all points, shape (N, ...), into those of the sets."""
        ends = np.cumsum(self.counts).tolist()
        return [table[start:end] for start, end in zip([0, *ends], ends, strict=False)]


@dataclass(frozen=True, eq=False)
class LevelSet:
    """A 4-connected region of pixels above a level, its holes filled, with one pixel of margin on all sides."""

    values: Image | Array  # (H, W): intensities of the array that the region was found in
    inside: Mask  # (h, w): the region; the outermost rows and columns are outside of it
    level: float
    corner: tuple[int, int]  # column and row of the region's first pixel in the array; -1 where the margin lies outside
    # (h, w): for a cut region: the pixels far enough from the cut, none of them in the margin. Only lines between
    # these count.
    sound: Mask | None = None

    @cached_property
    def polygon(self) -> Array:
        """The crossings in order, shape (N + 1, 2), the first repeated at the end, integer-centred.

        A pixel whose value is the level is passed each time that the border comes to it.
        """
        # Traced on the region itself: on the values, contours that meet at such a pixel would separate there.
        (middles,) = find_contours(self.inside.astype(float), 0.5)
        first, last = np.floor(middles).astype(int), np.ceil(middles).astype(int)
        x, y = self.corner
        start, end = (self.values[at[:, 0] + y, at[:, 1] + x].astype(float) for at in (first, last))
        points = first + (last - first) * ((self.level - start) / (end - start))[:, None]
        points = points[:, ::-1] + self.corner
        moved = (points[1:] != points[:-1]).any(axis=1)
        return np.asarray(points[np.append(True, moved)])


def crossings(sets: Sequence[LevelSet]) -> Crossings:
    """Compute the crossings of one or more level sets of one array, in their order.

    All at once: a call for each would cost more than the work.
    """
    # candidates: lines with one end inside, as flat indices into (set, direction, row, column)
    (x, y), crossed = _crossed_lines(sets)
    height, width = crossed.shape[2:]
    indices = np.flatnonzero(crossed)
    # Floor division by one number is several times faster than divmod.
    rows = indices // width
    planes = rows // height
    number, vertical = planes >> 1, (planes & 1).astype(bool)
    first = np.array([indices - rows * width + x, rows - planes * height + y]).T
    # interpolate; only the sets' part of the array is copied, since it may be a whole frame's. The margin is never
    # crossed.
    part = sets[0].values[max(y, 0) : y + height, max(x, 0) : x + width]
    flat = (first[:, 1] - max(y, 0)) * part.shape[1] + first[:, 0] - max(x, 0)
    values = part.ravel()
    start, end = values.take([flat, flat + np.where(vertical, part.shape[1], 1)]).astype(float)
    rise = end - start
    share = (np.array([each.level for each in sets]).take(number) - start) / rise
    # reject repeated crossings at a pixel; rounding too can put one there
    at_pixel = np.abs(share - 0.5) > _AT_PIXEL
    if at_pixel.any():
        along = share[:, None] * np.array([~vertical, vertical]).T
        kept = _first_of_each(np.column_stack([first + along, number]), at_pixel)
        number, first, vertical, share, rise = (table[kept] for table in (number, first, vertical, share, rise))
    return Crossings(np.bincount(number, minlength=len(sets)), first, vertical, share, rise)


def _crossed_lines(sets: Sequence[LevelSet]) -> tuple[tuple[int, int], Mask]:
    """Return which lines right and down from the pixels of a box are crossed, (K, 2, h, w), and the box's corner."""
    x, y = (min(each.corner[axis] for each in sets) for axis in (0, 1))
    width, height = (max(each.corner[axis] + each.inside.shape[1 - axis] for each in sets) for axis in (0, 1))
    inside = np.zeros((len(sets), height - y, width - x), dtype=bool)
    boxes = [np.s_[each.corner[1] - y :, each.corner[0] - x :] for each in sets]
    for each, layer, box in zip(sets, inside, boxes, strict=True):
        rows, columns = each.inside.shape
        layer[box][:rows, :columns] = each.inside
    crossed = np.zeros((len(sets), 2, height - y, width - x), dtype=bool)
    np.not_equal(inside[:, :, 1:], inside[:, :, :-1], out=crossed[:, 0, :, :-1])
    np.not_equal(inside[:, 1:], inside[:, :-1], out=crossed[:, 1, :-1])
    for each, (right, down), box in zip(sets, crossed, boxes, strict=True):
        if each.sound is not None:
            rows, columns = each.sound.shape
            right[box][:rows, : columns - 1] &= each.sound[:, 1:] & each.sound[:, :-1]
            down[box][: rows - 1, :columns] &= each.sound[1:] & each.sound[:-1]
    return (x, y), crossed


def level_set_around(
    values: Image | Array, pixel: tuple[int, int], level: float, seen: Mask | None = None
) -> LevelSet | None:
    """Find the region above a level that holds a pixel (column, row) whose value lies above it.

    The values, shape (H, W), are finite; `seen` tells where they are known, default everywhere. None where the region
    touches the array's border or, across a corner too, an unseen pixel: its border is open.
    """
    marks = (values > level if seen is None else (values > level) & seen).view(np.uint8)
    # High values are 4-connected, low ones 8-connected: marching squares' choice for an ambiguous cell.
    _, _, _, (x, y, width, height) = cv2.floodFill(marks, None, pixel, _REGION, flags=4)
    rows, columns = marks.shape
    if x == 0 or y == 0 or x + width == columns or y + height == rows:
        return None
    box = np.s_[y - 1 : y + height + 1, x - 1 : x + width + 1]
    # reject what touches unseen pixels, then fill the holes
    around = (marks[box] == _REGION).view(np.uint8)
    if seen is not None and not (known := seen[box]).all() and (cv2.dilate(around, _NEIGHBOURS) > 0)[~known].any():
        return None
    cv2.floodFill(around, None, (0, 0), _OUTSIDE, flags=8)
    return LevelSet(values, around != _OUTSIDE, level, (x - 1, y - 1))


def cut_level_set_around(
    values: Image | Array, pixel: tuple[int, int], level: float, margin_px: int, seen: Mask | None = None
) -> LevelSet:
    """Find the same region where the array's border or the view may cut it; its border is open there.

    Crossings nearer than `margin_px` to the cut are left out: smoothing has moved the border there.
    """
    known = np.ones(values.shape, dtype=bool) if seen is None else seen
    marks = ((values > level) & known).view(np.uint8)
    cv2.floodFill(marks, None, pixel, _REGION, flags=4)
    around = np.pad((marks == _REGION).view(np.uint8), 1)
    cv2.floodFill(around, None, (0, 0), _OUTSIDE, flags=8)
    side = 2 * margin_px + 1
    sound = cv2.erode(np.pad(known, 1).astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0) > 0
    return LevelSet(values, around != _OUTSIDE, level, (-1, -1), np.asarray(sound))


def _first_of_each(points: Array, suspects: Mask) -> Mask:
    """Return a mask that drops repeated points, shape (N, 2), among the suspects."""
    indices = np.flatnonzero(suspects)
    _, first = np.unique(points[indices], axis=0, return_index=True)
    keep = ~suspects
    keep[indices[first]] = True
    return np.asarray(keep)
