"""The region above a level around a pixel, and where its outer border crosses the lines between pixel centres.

These are the points of marching squares, whose contours are the region's border; a fit needs no order among them,
and without it they are found several times faster than by tracing.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
from skimage.measure import find_contours

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

LINEAR_INTERPOLATION_PX2 = 1 / 6
"""Variance that linear interpolation between two pixels adds along their axis, px^2, averaged over the place between.

Between neighbours a distance 1 apart it overestimates I by f (1 - f) I'' / 2, on average I'' / 12, as a convolution of
variance 1/6 would.
"""

_NEIGHBOURS = np.ones((3, 3), dtype=np.uint8)
_AT_PIXEL = 0.5 - 1e-9
_ABOVE, _REGION, _OUTSIDE = 1, 2, 3


@dataclass(frozen=True)
class Sensitivities:
    """How the crossings of a level set move along the lines that they lie on, to first order.

    Crossing i moves by w1_i dI(first) + w2_i dI(second) + wl_i dlevel px along its line.

    Parameters
    ----------
    vertical : ndarray of bool, shape (N,)
        Whether the line is vertical; else it is horizontal.
    pixels : ndarray of int, shape (N, 2, 2)
        Column and row of the line's first and second pixel in the array that the region was found in.
    weights : ndarray, shape (N, 2)
        w1 and w2, px per unit of intensity.
    level : ndarray, shape (N,)
        wl, px per unit of intensity.
    """

    vertical: Mask
    pixels: npt.NDArray[np.intp]
    weights: Array
    level: Array


@dataclass(frozen=True)
class LevelSet:
    """A 4-connected region of pixels above a level, its holes filled, with one pixel of margin on all sides.

    Parameters
    ----------
    values : ndarray, shape (h, w)
        Intensities.
    inside : ndarray of bool, shape (h, w)
        The region; the outermost rows and columns are outside of it.
    level : float
        The level.
    corner : tuple of int
        Column and row of the first pixel in the array that the region was found in.
    sound : ndarray of bool, shape (h, w), optional
        Of a region that something cuts: the pixels far enough from the cut. Only lines between these are crossed.
    """

    values: Image | Array
    inside: Mask
    level: float
    corner: tuple[int, int]
    sound: Mask | None = None

    def crossings(self) -> Array:
        """Give the border's points by linear interpolation between pixel centres, shape (N, 2), integer-centred.

        Those between horizontal neighbours first, row by row, then those between vertical ones; each point once, though
        several lines cross the border at a pixel whose value is the level.
        """
        across, pixels, start, end = self._lines
        share = (self.level - start) / (end - start)
        points = np.empty((len(share), 2))
        points[:, 1], points[:, 0] = np.divmod(pixels, self.inside.shape[1])
        points[:across, 0] += share[:across]
        points[across:, 1] += share[across:]
        points += self.corner
        # Rounding too can put a crossing onto a pixel.
        at_pixel = np.abs(share - 0.5) > _AT_PIXEL
        return points[_first_of_each(points, at_pixel)] if at_pixel.any() else points

    def sensitivities(self) -> Sensitivities:
        """Tell how the points of `crossings` move with the intensities, in the same order."""
        across, pixels, start, end = self._lines
        share, rise = (self.level - start) / (end - start), end - start
        vertical = np.arange(len(pixels)) >= across
        ends: npt.NDArray[np.intp] = np.empty((len(pixels), 2, 2), dtype=np.intp)
        ends[:, 0, 1], ends[:, 0, 0] = np.divmod(pixels, self.inside.shape[1])
        ends[:, 0] += self.corner
        ends[:, 1] = ends[:, 0]
        ends[:across, 1, 0] += 1
        ends[across:, 1, 1] += 1
        weights = np.empty((len(pixels), 2))
        weights[:, 0], weights[:, 1] = (share - 1) / rise, -share / rise
        at_pixel = np.abs(share - 0.5) > _AT_PIXEL
        if not at_pixel.any():
            return Sensitivities(vertical, ends, weights, 1 / rise)
        kept = _first_of_each(ends[:, 0] + (ends[:, 1] - ends[:, 0]) * share[:, None], at_pixel)
        return Sensitivities(vertical[kept], ends[kept], weights[kept], 1 / rise[kept])

    @cached_property
    def _lines(self) -> tuple[int, npt.NDArray[np.intp], Array, Array]:
        """Give how many crossed lines are horizontal; of all lines the first pixel and the values at both ends."""
        width = self.inside.shape[1]
        across, down = self.inside[:, 1:] != self.inside[:, :-1], self.inside[1:] != self.inside[:-1]
        if self.sound is not None:
            across &= self.sound[:, 1:] & self.sound[:, :-1]
            down &= self.sound[1:] & self.sound[:-1]
        rows, columns = np.divmod(np.flatnonzero(across), width - 1)
        first = rows * width + columns
        below = np.flatnonzero(down)
        values = np.ravel(self.values)
        pixels = np.concatenate([first, below])
        start = values[pixels].astype(float)
        end = values[np.concatenate([first + 1, below + width])].astype(float)
        return len(first), pixels, start, end

    def polygon(self) -> Array:
        """Give the same points in order, shape (N + 1, 2), the first repeated at the end, integer-centred.

        A pixel whose value is the level is passed once for each time that the border comes to it.
        """
        # Traced on the region itself: on the values, contours that meet at such a pixel would fall apart there.
        (middles,) = find_contours(self.inside.astype(float), 0.5)
        first, last = np.floor(middles).astype(int), np.ceil(middles).astype(int)
        start, end = (self.values[at[:, 0], at[:, 1]].astype(float) for at in (first, last))
        points = first + (last - first) * ((self.level - start) / (end - start))[:, None]
        points = points[:, ::-1] + self.corner
        moved = (points[1:] != points[:-1]).any(axis=1)
        return np.asarray(points[np.append(True, moved)])


def level_set_around(
    values: Image | Array, pixel: tuple[int, int], level: float, seen: Mask | None = None
) -> LevelSet | None:
    """Find the region above a level that holds a pixel.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        Finite intensities.
    pixel : tuple of int
        Column and row; its value lies above the level.
    level : float
        The level.
    seen : ndarray of bool, shape (H, W), optional
        Where the values are known; default everywhere.

    Returns
    -------
    LevelSet or None
        None where the region reaches the array's border or a pixel that is not seen, across a corner too: its own
        border is not closed then.
    """
    marks = (values > level if seen is None else (values > level) & seen).view(np.uint8)
    # Low values are connected across corners, high ones are not, as in marching squares for an ambiguous cell.
    _, _, _, (x, y, width, height) = cv2.floodFill(marks, None, pixel, _REGION, flags=4)
    rows, columns = marks.shape
    if x == 0 or y == 0 or x + width == columns or y + height == rows:
        return None
    box = np.s_[y - 1 : y + height + 1, x - 1 : x + width + 1]
    around = np.where(marks[box] == _REGION, np.uint8(_REGION), np.uint8(0))
    if seen is not None and (cv2.dilate(around, _NEIGHBOURS) > 0)[~seen[box]].any():
        return None
    cv2.floodFill(around, None, (0, 0), _OUTSIDE, flags=8)
    return LevelSet(values[box], around != _OUTSIDE, level, (x - 1, y - 1))


def cut_level_set_around(
    values: Image | Array, pixel: tuple[int, int], level: float, margin_px: int, seen: Mask | None = None
) -> LevelSet:
    """Find the region above a level that holds a pixel, where the array's border or the view cuts it.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        Finite intensities.
    pixel : tuple of int
        Column and row; its value lies above the level.
    level : float
        The level.
    margin_px : int
        Where the border is crossed nearer than this to the cut, smoothing has drawn it aside: it is left out.
    seen : ndarray of bool, shape (H, W), optional
        Where the values are known; default everywhere.

    Returns
    -------
    LevelSet
        Its border is open at the cut.
    """
    known = np.ones(values.shape, dtype=bool) if seen is None else seen
    marks = ((values > level) & known).view(np.uint8)
    cv2.floodFill(marks, None, pixel, _REGION, flags=4)
    around = np.pad(np.where(marks == _REGION, np.uint8(_REGION), np.uint8(0)), 1)
    cv2.floodFill(around, None, (0, 0), _OUTSIDE, flags=8)
    side = 2 * margin_px + 1
    sound = cv2.erode(np.pad(known, 1).astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0) > 0
    framed = np.asarray(np.pad(values, 1, mode="edge"), dtype=np.float64)
    return LevelSet(framed, around != _OUTSIDE, level, (-1, -1), np.asarray(sound))


def _first_of_each(points: Array, suspects: Mask) -> Mask:
    """Tell which points, shape (N, 2), are the first of equal ones among the suspects."""
    places = np.flatnonzero(suspects)
    _, first = np.unique(points[places], axis=0, return_index=True)
    keep = ~suspects
    keep[places[first]] = True
    return np.asarray(keep)
