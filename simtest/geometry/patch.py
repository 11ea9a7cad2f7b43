"""A region of interest of a smoothed frame around one peak, and the isophotes in it.

Connected sets of pixels and their closing are OpenCV's: scipy.ndimage takes longer to load than a picture to
reconstruct.
"""

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.errors import Failure, InputError, Reason
from simtest.geometry.level_sets import Crossings, LevelSet, crossings, cut_level_set_around, level_set_around
from simtest.runtime.arrays import Array, Image, Index, Mask, short_repr

LEAST_SMOOTHING_PX = 0.5
"""What the parabola through three pixels amounts to, where a frame is not smoothed."""

_SQUARE = np.ones((3, 3), np.uint8)

CUT_SIGMAS = 1.5
"""Nearer than this to a cut, over the smoothing's standard deviation, an isophote is left out: smoothing moves it, at
the cut by 0.8 of that deviation, at this distance by 0.06."""

MIN_PLATEAU_PX = 12
"""Fewer clipped pixels leave a smoothed peak round; more leave it flat, and its highest pixel an accident."""


@dataclass(frozen=True, eq=False)
class _LevelSets:
    """The level sets around a peak that were found, and the values, view, peak and smoothing that they are of."""

    of: tuple[object, ...]
    closed: dict[float, LevelSet | Failure] = field(default_factory=dict)
    cut: dict[float, LevelSet] = field(default_factory=dict)
    crossings: dict[tuple[LevelSet, ...], Crossings] = field(default_factory=dict)

    def are_of(self, of: tuple[object, ...]) -> bool:
        """Return whether they are of the same arrays, not copies, with the same peak and smoothing."""
        pairs = zip(self.of, of, strict=True)
        return all(one is other or (isinstance(one, int | float | tuple) and one == other) for one, other in pairs)


@dataclass(frozen=True)
class Patch:
    """A region of interest of a smoothed frame around one peak.

    Parameters
    ----------
    values : ndarray, shape (h, w)
        Smoothed intensities of the region.
    origin_px : tuple of int
        Column and row of the region's first pixel in the frame.
    peak_px : ndarray, shape (2,)
        Sub-pixel position of the peak in the frame, px (pixel centres at + 0.5).
    peak_value : float
        Smoothed intensity of the peak's pixel: isovalues are relative to it.
    peak_pixel : tuple of int
        Column and row of the peak's pixel in the region.
    saturated : ndarray of bool, shape (h, w), optional
        Where the sensor is clipped; None where that is not known.
    seen : ndarray of bool, shape (h, w), optional
        The pixels inside the camera's view mask; default all. An isophote that leaves them is not closed.
    raw : ndarray, shape (h, w), optional
        Intensities before smoothing, whose noise is independent from pixel to pixel.
    noise : float, or ndarray of float32, shape (h, w), optional
        Standard deviation of the noise before smoothing, independent from pixel to pixel; None: not known.
    smoothing_px : float
        Standard deviation of the Gaussian that the frame was smoothed with, px.
    others_px : tuple of tuple of float, optional
        Peaks of the frame's other specularities, px; None: not known, empty: there are none.
    others_value : tuple of float
        Smoothed intensities of those, 0 where one has no patch; empty: not known.
    diffuse : float
        The body's light beside the highlight that is not in `values`: what its strongest channel has more, where these
        are the mean of a colour frame's channels, or all of it, where they are the specular part.
    clipped_share : float
        Share of the frame's highlights that are clipped.
    score : float, optional
        How sure it is that this is a highlight, in [0, 1] (`simtest.detection.score`); None: not known.
    found : optional
        The level sets found so far: those of the patch that this one is a copy of, where it has the same.
    kept : dict
        What estimators have fitted to this patch, by a name, each with the camera; a copy starts without.

    Examples
    --------
    >>> import numpy as np, simtest
    >>> y, x = np.mgrid[:40, :40] + 0.5
    >>> lobe = np.exp(-((x - 20) ** 2 + (y - 18) ** 2) / 50)
    >>> patch = simtest.Patch.cut(lobe, (5, 5, 30, 30))
    >>> patch.peak_px.round(1)
    array([20., 18.])
    """

    values: Image | Array
    origin_px: tuple[int, int]
    peak_px: Array
    peak_value: float
    peak_pixel: tuple[int, int]
    saturated: Mask | None = None
    seen: Mask | None = None
    raw: Image | Array | None = None
    noise: float | Image | None = None
    smoothing_px: float = 0.0
    others_px: tuple[tuple[float, float], ...] | None = None
    others_value: tuple[float, ...] = ()
    diffuse: float = 0.0
    clipped_share: float = 0.0
    score: float | None = None
    found: _LevelSets | None = field(default=None, compare=False, repr=False)
    kept: dict[Hashable, tuple[object, object]] = field(default_factory=dict, init=False, compare=False, repr=False)

    __repr__ = short_repr

    def __post_init__(self) -> None:
        # A copy with other neighbours or noise keeps its level sets; one with other values or another peak does not.
        of = (self.values, self.seen, self.peak_pixel, self.peak_value, self.smoothing_px)
        if self.found is None or not self.found.are_of(of):
            object.__setattr__(self, "found", _LevelSets(of))

    @classmethod
    def cut(
        cls,
        smoothed: Image | Array,
        box: tuple[int, int, int, int],
        peak: tuple[int, int] | None = None,
        origin_px: tuple[int, int] = (0, 0),
        saturated: Mask | None = None,
        seen: Mask | None = None,
        raw: Image | Array | None = None,
        noise: float | Image | None = None,
        smoothing_px: float = 0.0,
        others_px: tuple[tuple[float, float], ...] | None = None,
    ) -> "Patch | Failure":
        """Cut a region out of a smoothed frame; masks, raw frame and noise are those of the frame, shape (H, W).

        Parameters
        ----------
        smoothed : ndarray, shape (H, W)
            The frame.
        box : tuple of int
            Column, row, width, height of the region; inside the frame.
        peak : tuple of int, optional
            Column and row of the peak's pixel; default the brightest of the region. A peak on a clipped plateau of 12
            px and more of its highlight at half height lies at the plateau's centroid.
        origin_px : tuple of int
            Column and row of the first pixel of `smoothed` in the frame, where it is only a part of it.
        others_px : tuple of tuple of float, optional
            Peaks of the frame's other specularities, px; empty: there are none.

        Returns
        -------
        Patch or Failure
            A Failure if the region holds values that are not finite, or no positive one above the others.

        Raises
        ------
        InputError
            If the box is empty or leaves the frame, or the peak leaves the box.
        """
        x, y, width, height = box
        rows, columns = smoothed.shape
        if width < 1 or height < 1 or x < 0 or y < 0 or x + width > columns or y + height > rows:
            raise InputError(f"roi = {x},{y},{width},{height}: must be x,y,w,h inside the {columns} x {rows} frame")
        if peak is not None and not (x <= peak[0] < x + width and y <= peak[1] < y + height):
            raise InputError(
                f"peak = {peak[0]},{peak[1]}: must lie inside its region x,y,w,h = {x},{y},{width},{height}"
            )
        crop = np.s_[y : y + height, x : x + width]
        values, corner = smoothed[crop], (x + origin_px[0], y + origin_px[1])
        # NaN and infinity show at either end of the range, which costs less than a test of every value.
        lowest, highest = float(values.min()), float(values.max())
        if not (np.isfinite(lowest) and np.isfinite(highest)):
            return Failure(Reason.NOT_FINITE, "the region holds NaN or infinity")
        saturated, seen = (None if mask is None else mask[crop] for mask in (saturated, seen))
        if seen is not None:
            lowest = float(values.min(where=seen, initial=np.inf))
        # candidate: the given pixel or the brightest; refined by a parabola or, on a clipped plateau, by its centroid
        row, column = divmod(int(values.argmax()), width) if peak is None else (peak[1] - y, peak[0] - x)
        unsmoothed = None if raw is None else raw[crop]
        shown = values if unsmoothed is None else unsmoothed
        plateau = None if saturated is None else _plateau(shown, saturated, row, column)
        if saturated is None or plateau is None:
            position = _parabolic_peak(values, row, column)
        else:
            position = np.argwhere(plateau)[:, ::-1].mean(axis=0)
            # The clipped pixel nearest to the centroid: where falloff was divided away the plateau is slanted and
            # highest at its rim, and its holes may be dark.
            pixels = np.argwhere(plateau & saturated)[:, ::-1]
            column, row = pixels[np.argmin(np.sum((pixels - position) ** 2, axis=1))]
        # reject a region without a peak
        value = float(values[row, column])
        if value <= 0 or value <= lowest:
            return Failure(Reason.NO_PEAK, f"peak {value:g}, least value {lowest:g}")
        return cls(
            values, corner, position + PIXEL_CENTRE + corner, value, (int(column), int(row)), saturated, seen,
            unsmoothed, noise[crop] if isinstance(noise, np.ndarray) else noise, smoothing_px, others_px,
        )  # fmt: skip

    @property
    def neighbours_px(self) -> Array:
        """The frame's other peaks, shape (N, 2), px; none where they are not known."""
        return np.reshape(np.array(self.others_px or (), dtype=float), (-1, 2))

    def crossings(self, isovalue: float) -> Array | Failure:
        """Return the isophote's points by marching squares [MB, section 2.3, step 1], shape (N, 2), px, in no order.

        The isophote at t in (0, 1) of the smoothed peak is the outer border of the region above that level that holds
        the peak. Its points lie where it crosses the lines between the centres of neighbouring pixels. A pixel whose
        value is the level, where several lines cross, counts once. A Failure where it does not close.

        Raises
        ------
        InputError
            If t is outside (0, 1).
        """
        return self.crossings_of([isovalue])[0]

    def crossings_of(self, isovalues: Sequence[float]) -> list[Array | Failure]:
        """Return the points of several isophotes (see `crossings`), at little more than the cost of one."""
        found = [self._closed(t) for t in isovalues]
        closed = [each for each in found if not isinstance(each, Failure)]
        if not closed:
            return [each for each in found if isinstance(each, Failure)]
        traced = self._crossings(closed)
        points = iter(traced.each(traced.points + self._first_centre))
        return [each if isinstance(each, Failure) else next(points) for each in found]

    def arc(self, isovalue: float) -> Array:
        """Return the seen part of an isophote that the region's border or the view cuts, shape (N, 2), in no order.

        Points nearer to the cut than 1.5 times the smoothing's width are left out.
        """
        return self._crossings([self._cut(isovalue)]).points + self._first_centre

    def traced(self, isovalues: Sequence[float], cut: Sequence[bool]) -> Crossings:
        """Return the points of `crossings`, or of `arc` where `cut` is true, and how they move with the values.

        The isophotes must have been found; pixels and points are those of the region.
        """
        found = [self._cut(t) if arc else self._closed(t) for t, arc in zip(isovalues, cut, strict=True)]
        return self._crossings([each for each in found if isinstance(each, LevelSet)])

    def isophote(self, isovalue: float) -> Array | Failure:
        """Return the points of `crossings` as a closed polygon, shape (N + 1, 2), the first repeated at the end.

        Where the border meets itself, at a pixel whose value is the level, a point is passed more than once.
        """
        found = self._closed(isovalue)
        return found if isinstance(found, Failure) else found.polygon + PIXEL_CENTRE + self.origin_px

    def contours(self, isovalues: Iterable[float]) -> list[tuple[float, Array]]:
        """Return isovalue and polygon of each isophote that closes."""
        traced = [(isovalue, self.isophote(isovalue)) for isovalue in isovalues]
        return [(isovalue, points) for isovalue, points in traced if not isinstance(points, Failure)]

    @property
    def _level_sets(self) -> _LevelSets:
        assert self.found is not None
        return self.found

    def _closed(self, isovalue: float) -> LevelSet | Failure:
        """Return the region above t times the peak; a Failure where its border does not close."""
        found = self._level_sets.closed
        if isovalue not in found:
            level = _checked(isovalue) * self.peak_value
            found[isovalue] = level_set_around(self.values, self.peak_pixel, level, self.seen) or Failure(
                Reason.NO_CLOSED_ISOPHOTE, f"none around the peak at t = {isovalue:g}"
            )
        return found[isovalue]

    def _cut(self, isovalue: float) -> LevelSet:
        """Return the same region where the border or the view may cut it, its border open there."""
        found = self._level_sets.cut
        if isovalue not in found:
            margin = max(int(np.ceil(CUT_SIGMAS * self.smoothing_px)), 1)
            level = _checked(isovalue) * self.peak_value
            found[isovalue] = cut_level_set_around(self.values, self.peak_pixel, level, margin, self.seen)
        return found[isovalue]

    def _crossings(self, sets: list[LevelSet]) -> Crossings:
        """Return where the borders of level sets cross the lines between pixel centres."""
        # Usually the points are used first, then how they move.
        found, key = self._level_sets.crossings, tuple(sets)
        if key not in found:
            found[key] = crossings(sets)
        return found[key]

    @property
    def _first_centre(self) -> Array:
        """Centre of the region's first pixel, shape (2,), px."""
        return np.array(self.origin_px) + PIXEL_CENTRE

    def inside(self, isovalue: float, cut: bool = False) -> Mask:
        """Return which of the region's pixels an isophote encloses, shape (h, w).

        Where it does not close: all seen pixels, or with `cut` those that it encloses together with the cut.
        """
        found = self._closed(isovalue)
        if isinstance(found, Failure):
            if cut:
                return np.asarray(self._cut(isovalue).inside[1:-1, 1:-1])
            return np.ones(self.values.shape, dtype=bool) if self.seen is None else self.seen
        mask = np.zeros(self.values.shape, dtype=bool)
        height, width = found.inside.shape
        x, y = found.corner
        mask[y : y + height, x : x + width] = found.inside
        return mask

    def area_px(self, isovalue: float) -> int | None:
        """Return how many pixels an isophote encloses; None where it does not close."""
        found = self._closed(isovalue)
        return None if isinstance(found, Failure) else int(np.count_nonzero(found.inside))

    @property
    def noise_at_peak(self) -> float | None:
        """Standard deviation of the noise before smoothing at the peak's pixel; None where it is not known."""
        if isinstance(self.noise, np.ndarray):
            return float(self.noise[self.peak_pixel[::-1]])
        return None if self.noise is None else float(self.noise)

    def saturated_share(self, isovalue: float) -> float | None:
        """Return the share of the pixels inside an isophote that are clipped; None where that is not known."""
        if self.saturated is None:
            return None
        inside = self.inside(isovalue)
        return float(np.mean(self.saturated[inside])) if inside.any() else 0.0


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


def _plateau(shown: Image | Array, clipped: Mask, row: int, column: int) -> Mask | None:
    """Return the connected clipped pixels around a peak's pixel, small holes closed; None where they are few.

    They are those of its own highlight at half height: a channel of pale tissue may be clipped from one to the next.
    """
    if np.count_nonzero(clipped) < MIN_PLATEAU_PX:
        return None
    high = connected(shown >= HIGHLIGHT_ISOVALUE * shown[row, column])
    whole = closed(clipped & (high == high[row, column]))
    if not whole[row, column]:
        return None
    labels = connected(whole, diagonally=True)
    plateau = np.asarray(labels == labels[row, column])
    return plateau if np.count_nonzero(plateau) >= MIN_PLATEAU_PX and (plateau & clipped).any() else None


def _parabolic_peak(values: Image | Array, row: int, column: int) -> Array:
    """Refine a peak's pixel (column, row) by a parabola along each axis; at the border the pixel itself is kept."""
    position = [float(column), float(row)]
    for axis, (index, line) in enumerate(((column, values[row, :]), (row, values[:, column]))):
        if 0 < index < len(line) - 1:
            before, here, after = (float(v) for v in line[index - 1 : index + 2])
            bend = before - 2 * here + after
            if bend < 0:
                position[axis] += min(max(0.5 * (before - after) / bend, -0.5), 0.5)
    return np.array(position)


def smooth(frame: npt.ArrayLike, sigma_px: float, seen: Mask | None = None) -> Image:
    """Smooth a frame, shape (H, W) or (H, W, C), with a Gaussian of a standard deviation in px; 0 leaves it as it is.

    With `seen`, shape (H, W), the pixels inside a camera's view mask, each smoothed value is the weighted mean of those
    alone, so that the dark outside does not lower the values at the mask's border; pixels outside become 0.
    """
    image = np.ascontiguousarray(frame, dtype=np.float32)
    if seen is None:
        return _blurred(image, sigma_px)
    inside = seen if image.ndim == 2 else seen[:, :, None]
    weights = _blurred(seen.astype(np.float32), sigma_px).reshape(inside.shape)
    blurred = _blurred(np.where(inside, image, np.float32(0)), sigma_px)
    return np.asarray(np.divide(blurred, weights, where=inside, out=np.zeros_like(image)))


def share_of_noise(sigma_px: float) -> float:
    """Return the share of white noise that smoothing leaves: 1 / (2 sqrt(pi) s) for a wide Gaussian."""
    return 1 / math.sqrt(1 + 4 * math.pi * sigma_px**2)


def slope_divisor_px2(sigma_px: npt.ArrayLike) -> Array:
    """Return what divides the standard deviation of white noise for that of the smoothed noise's slope an axis, px^2.

    The slope has the variance sigma^2 / (8 pi s^4).
    """
    return np.asarray(np.sqrt(8 * np.pi) * np.maximum(sigma_px, LEAST_SMOOTHING_PX) ** 2)


def _blurred(image: Image, sigma_px: float) -> Image:
    if sigma_px <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))


def connected(mask: Mask, diagonally: bool = False) -> npt.NDArray[np.int32]:
    """Return the number of each pixel's connected set, shape (H, W), 0 outside the mask, of shape (H, W).

    Pixels are neighbours along the axes, and with `diagonally` at corners too.
    """
    _, labels = cv2.connectedComponents(_bytes(mask), connectivity=8 if diagonally else 4)
    return np.asarray(labels, dtype=np.int32)


def dilated(mask: Mask, by_px: int = 1) -> Mask:
    """Return a mask, shape (H, W), with the square of so many pixels to each side around each of its pixels."""
    return np.asarray(cv2.dilate(_bytes(mask), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8)), dtype=bool)


def closed(mask: Mask) -> Mask:
    """Return a mask, shape (H, W), with its narrow gaps closed: the union with its closing by a square of 3 pixels.

    Nothing is set outside the picture, so the closing adds nothing along its border.
    """
    grown = cv2.dilate(_bytes(mask), _SQUARE)
    shrunk = cv2.erode(grown, _SQUARE, borderType=cv2.BORDER_CONSTANT, borderValue=(0,))
    return np.asarray(mask | shrunk.astype(bool))


def rows_and_columns(mask: Mask) -> tuple[Index, Index]:
    """Return rows and columns of a mask's pixels, of shape (H, W), row by row, as `np.nonzero` does.

    Ten times as fast where few pixels are set.
    """
    indices = np.flatnonzero(mask)
    rows = indices // mask.shape[1]
    return rows, indices - rows * mask.shape[1]


def _bytes(mask: Mask) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(mask).view(np.uint8)
