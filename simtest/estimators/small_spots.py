"""Small highlights: below a radius of about 3 px isophotes carry no shape, and the spot's centre carries the normal.

Pixels, point spread, mosaic and coding then make the isophotes. A spot of a few pixels is the image of a highlight
through lens and pixels, whose point spread is nearly Gaussian: its centre is that of a Gaussian on a local background,
fitted to the unsmoothed pixels, which is the maximum-likelihood estimate of it under white noise. Clipped pixels are
censored, and many spots are fitted at once. Neither axis ratio nor curvature is stated.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget, clipped_pixels
from simtest.estimators.family import IsophoteFamily
from simtest.estimators.isophotes import FittedIsophote
from simtest.estimators.least_squares import Descent, Equations, minimise
from simtest.geometry import Array, Camera, Index, Mask, Patch
from simtest.geometry.vectors import basis_across
from simtest.runtime.fitted import fitted_number

OF_SPOTS = Descent(1e-2, 1e-9, 1e8, 40, 1e-9, ridge=(1e-12, 1e-30))

EXACT = 1e-20  # sum of squares, over the peak squared, that rounding alone leaves
LEAST_VARIANCE_PX2 = 0.1  # a spot is no narrower than its pixel, whose own variance is 1/12 px^2

BACKGROUND_SLOPE = 0.01
"""Standard deviation of the background's slope, share of the spot's height per px: it has a prior, because the flank of
a wide spot looks like a slope."""

PRIOR_RESIDUAL = 0.02  # residual, share of the height, against which that prior is weighed

HEIGHT, X, Y, XX, XY, YY, LEVEL, RIGHT, DOWN = range(9)
"""Parameters: height; centre, px; inverse covariance, 1/px^2; background at the window's centre, and its slope."""


@dataclass(frozen=True)
class SpotWindows:
    """The pixels of N spots, each in a square window around its peak's pixel, its m pixels in one row."""

    values: Array  # (N, m): unsmoothed intensities over the spot's height; 0 where not used
    # used, clipped: (N, m): pixels that are fitted, and those of them whose intensity is at least the value.
    used: Mask
    clipped: Mask
    offsets: Array  # (2, m): each pixel's centre from the centre of the window, px


@dataclass(frozen=True)
class SpotFits:
    """Fitted spots."""

    parameters: Array  # (N, 9): at the minimum; see `HEIGHT` and the others
    covariance: Array  # (N, 2, 2): of the centre, px^2, for residuals of variance 1; NaN where it is not determined
    residual: Array  # (N,): standard deviation of the residuals, in the values' unit
    sound: Mask  # (N,): whether the fit converged to a spot inside its window


def fit_spots(windows: SpotWindows, centres: Array, variances: Array, levels: Array) -> SpotFits:
    """Fit spots by Levenberg and Marquardt's method, all at once.

    `windows`: their pixels; `centres`, (N, 2): where to start, px from the centre of the window; `variances`, `levels`,
    (N,): variance of each spot, px^2, and level of its background to start with.
    """
    count = len(centres)
    p = np.zeros((count, 9))
    p[:, HEIGHT] = 1 - levels
    p[:, X], p[:, Y] = centres.T
    p[:, XX] = p[:, YY] = 1 / np.maximum(variances, 2 * LEAST_VARIANCE_PX2)
    p[:, LEVEL] = levels
    reach = float(np.abs(windows.offsets).max())

    def equations(p: Array, at: Index) -> Equations:
        part = SpotWindows(windows.values[at], windows.used[at], windows.clipped[at], windows.offsets)
        squares, normal, gradient = _equations(part, p)
        return squares, normal, gradient, np.isfinite(squares) & _is_spot(p, reach)

    # A step too far overflows, and is then not taken.
    with np.errstate(all="ignore"):
        p, squares, normal, has_ended = minimise(p, equations, np.add, OF_SPOTS, EXACT)
        return _stated(windows, p, squares, normal, has_ended & _is_spot(p, reach))


def _equations(windows: SpotWindows, p: Array) -> tuple[Array, Array, Array]:
    """Return each spot's sum of squares, and its normal equations, shapes (N,), (N, 9, 9) and (N, 9)."""
    x, y = windows.offsets
    dx, dy = x - p[:, X, None], y - p[:, Y, None]
    xx, xy, yy = p[:, XX, None], p[:, XY, None], p[:, YY, None]
    along_x, along_y = xx * dx + xy * dy, xy * dx + yy * dy
    lobe = np.exp(-0.5 * (dx * along_x + dy * along_y))
    height = p[:, HEIGHT, None]
    raised = height * lobe
    model = raised + p[:, LEVEL, None] + p[:, RIGHT, None] * x + p[:, DOWN, None] * y
    residual = windows.values - model
    counted = windows.used & ~(windows.clipped & (residual < 0))
    residual = np.where(counted, residual, 0.0)
    J = np.empty((len(p), 9, len(x)))
    J[:, HEIGHT] = lobe
    J[:, X], J[:, Y] = raised * along_x, raised * along_y
    J[:, XX], J[:, XY], J[:, YY] = -0.5 * raised * dx * dx, -raised * dx * dy, -0.5 * raised * dy * dy
    J[:, LEVEL], J[:, RIGHT], J[:, DOWN] = 1.0, x, y
    J *= counted[:, None, :]
    normal, gradient = J @ J.transpose(0, 2, 1), (J @ residual[:, :, None])[:, :, 0]
    # prior of the background's slope
    weight = (PRIOR_RESIDUAL / BACKGROUND_SLOPE) ** 2
    squares = np.sum(residual * residual, axis=1) + weight * np.sum(p[:, RIGHT:] ** 2, axis=1)
    for k in (RIGHT, DOWN):
        normal[:, k, k] += weight
        gradient[:, k] -= weight * p[:, k]
    return squares, normal, gradient


def _is_spot(p: Array, reach: float) -> Mask:
    """Return whether parameters are those of a spot: raised, not narrower than a pixel, its centre in the window."""
    half, product = (p[:, XX] + p[:, YY]) / 2, p[:, XX] * p[:, YY] - p[:, XY] ** 2
    largest = half + np.sqrt(np.maximum(half * half - product, 0.0))
    narrow = largest > 1 / LEAST_VARIANCE_PX2
    wide = (product <= 0) | (half <= 0) | (product / largest < 1 / (4 * reach * reach))
    inside = (np.abs(p[:, X]) < reach) & (np.abs(p[:, Y]) < reach)
    return np.asarray((p[:, HEIGHT] > 0) & inside & ~narrow & ~wide)


def _stated(windows: SpotWindows, p: Array, squares: Array, normal: Array, sound: Mask) -> SpotFits:
    """Return the fits with the covariances of their centres."""
    free = np.count_nonzero(windows.used & ~windows.clipped, axis=1) - 7
    covariance = np.full((len(p), 2, 2), np.nan)
    diagonal = np.diagonal(normal, axis1=1, axis2=2)
    sound = sound & (free > 0) & (diagonal > 0).all(axis=1)
    for i in np.flatnonzero(sound):
        # scaled to a diagonal of 1, so that the condition does not depend on units
        scale = np.sqrt(diagonal[i])
        information = normal[i] / np.outer(scale, scale)
        if np.linalg.cond(information) > 1e12:
            sound[i] = False
            continue
        covariance[i] = (np.linalg.inv(information) / np.outer(scale, scale))[X : Y + 1, X : Y + 1]
    residual = np.sqrt(squares / np.maximum(free, 1))
    return SpotFits(p, covariance, residual, sound)


RESOLVED_PX = 3.0  # least radius at half height, before smoothing, of a highlight whose isophotes are used

SURROUNDINGS_SHARE = 0.2
"""The value that this share of a region's pixels stay below is that of its surroundings: the region is more than twice
as wide as its highlight."""

GAUSSIAN_RADIUS2 = 2 * math.log(2)  # squared radius of a Gaussian at half height, over its variance

WINDOW_RADII, WINDOW_PX = 1.3, 0.7
"""Pixels are fitted within so many radii of the smoothed spot, and so many px, of its peak."""

OTHER_ISOVALUES = (0.1, 0.2, 0.3, 0.5)
"""Pixels as bright as the first of these isophotes that closes, but outside of it, belong to something else."""

PIXEL_PX2, RADIUS_SHARE = fitted_number("small_spot.constant"), fitted_number("small_spot.radius")
MOMENTS_SHARE, RESIDUAL_SHARE = fitted_number("small_spot.moments"), fitted_number("small_spot.residual")
NEIGHBOUR_PX4 = fitted_number("small_spot.neighbour")

LEAST_GAP_PX = 4.0  # a neighbour that is nearer is part of the spot
UNRESOLVED = "unresolved"  # flag of estimates that state a small highlight's centre, and no shape


@dataclass(frozen=True)
class SmallSpot:
    """The fitted centre of a small highlight; it stands in where an `IsophoteFamily` is asked for its axis."""

    patch: Patch
    camera: Camera
    centre_px: Array
    variance_px2: Array  # (2, 2): second moments of the fitted spot as its pixels show it, px^2
    # by_noise_px2, by_shape_px2: (2, 2): covariance of the centre by noise, and by everything that makes the spot no
    # Gaussian, px^2.
    by_noise_px2: Array
    by_shape_px2: Array

    isophotes: tuple[FittedIsophote, ...] = ()
    axis_ratio: None = None
    flags: tuple[str, ...] = (UNRESOLVED,)

    @cached_property
    def axis(self) -> Array:
        """The sightline of the centre, unit, shape (3,), camera frame."""
        return np.asarray(self.camera.unproject(self.centre_px))

    @property
    def peak_axis(self) -> Array:
        """The same: there is no isophote to follow."""
        return self.axis

    @cached_property
    def basis(self) -> Array:
        """Two unit vectors across the axis, shape (2, 3): ``tangent_basis`` of the normal that is its reverse."""
        return basis_across(-self.axis)

    @cached_property
    def _by_pixel(self) -> Array:
        """Derivative of the axis, in the basis, by the centre's pixel coordinates, rad / px, shape (2, 2)."""
        return np.asarray(self.basis @ self.camera.step_of_pixels(self.centre_px).T)

    @cached_property
    def moments(self) -> Array:
        """1/H, the lobe's second moments as the pixels show them, rad^2, in the basis, shape (2, 2)."""
        return np.asarray(self._by_pixel @ self.variance_px2 @ self._by_pixel.T)

    @property
    def seen_moments(self) -> Array:
        """The same: no smoothing is taken off them (`IsophoteFamily.seen_moments`)."""
        return self.moments

    @property
    def axis_budget(self) -> Budget | None:
        """Budget of the axis in the basis: noise and resolution; None where the noise is not known."""
        if self.patch.noise is None:
            return None
        parts = {"noise": self.by_noise_px2, "resolution": self.by_shape_px2}
        return {name: np.asarray(self._by_pixel @ part @ self._by_pixel.T) for name, part in parts.items()}

    peak_budget = axis_budget

    @property
    def no_shape(self) -> Failure:
        """Why an estimator that needs the shape has no result."""
        radius = math.sqrt(GAUSSIAN_RADIUS2 * math.sqrt(max(float(np.linalg.det(self.variance_px2)), 0.0)))
        return Failure(
            Reason.UNRESOLVED, f"a radius of {radius:.1f} px; isophotes carry shape above {RESOLVED_PX:g} px"
        )

    def tangents(self, points: Array) -> Array:
        """Return the tangents of pixels' angles from the axis, in the basis, shape (N, 2)."""
        rays = self.camera.unproject(points)
        return np.asarray((rays @ self.basis.T) / (rays @ self.axis)[:, None])


HighlightAxis = IsophoteFamily | SmallSpot  # what states a highlight's axis, with its moments and its budget


def radius_before_smoothing_px(patch: Patch) -> float | None:
    """Measure the radius of a highlight at half height, before smoothing, px; None where its isophote does not close.

    That of the circle with the area that the smoothed spot has at half its height above the surroundings, less what
    smoothing adds to a Gaussian's.
    """
    found = smoothed_radius(patch)
    if found is None:
        return None
    return math.sqrt(max(found[0] ** 2 - GAUSSIAN_RADIUS2 * patch.smoothing_px**2, 0.0))


def smoothed_radius(patch: Patch) -> tuple[float, float] | None:
    """Return the radius of the smoothed spot at half height, px, and the level of its surroundings over the peak."""
    values = patch.values if patch.seen is None else patch.values[patch.seen]
    # the value of that rank, without the sorting and interpolation of a percentile
    rank = int(SURROUNDINGS_SHARE * (values.size - 1))
    base = min(max(float(np.partition(values, rank, axis=None)[rank]) / patch.peak_value, 0.0), 0.98)
    area = patch.area_px((1 + base) / 2)
    return None if area is None else (math.sqrt(area / math.pi), base)


def is_small(patch: Patch) -> bool:
    """Return whether a highlight is too small for its isophotes to carry its shape."""
    radius = radius_before_smoothing_px(patch)
    return radius is not None and radius < RESOLVED_PX


def fit_small_spots(patches: Sequence[Patch], camera: Camera) -> list[SmallSpot]:
    """Fit the centres of small highlights, all at once."""
    if not patches:
        return []
    # the pixels around each peak
    shapes = [smoothed_radius(patch) or (RESOLVED_PX, 0.0) for patch in patches]
    reaches = [WINDOW_RADII * radius + WINDOW_PX for radius, _ in shapes]
    # All windows are as large as that of the largest small spot, so that no spot's last bits depend on the others.
    widest = max(math.sqrt(RESOLVED_PX**2 + GAUSSIAN_RADIUS2 * patch.smoothing_px**2) for patch in patches)
    half = math.ceil(WINDOW_RADII * widest + WINDOW_PX)
    down, right = np.mgrid[-half : half + 1, -half : half + 1]
    offsets = np.array([right.ravel(), down.ravel()], dtype=float)
    cut = [_window(patch, half, reach, offsets) for patch, reach in zip(patches, reaches, strict=True)]
    values, used, clipped = (np.array(each) for each in zip(*cut, strict=True))
    windows = SpotWindows(values, used, clipped, offsets)
    # start from the smoothed peak
    centres = np.array([p.peak_px - np.array(p.origin_px) - np.array(p.peak_pixel) - PIXEL_CENTRE for p in patches])
    radii, bases = np.array(shapes).T
    smoothing = np.array([patch.smoothing_px for patch in patches])
    variances = np.maximum(radii**2 / GAUSSIAN_RADIUS2 - smoothing**2, 2 * LEAST_VARIANCE_PX2)
    fits = fit_spots(windows, centres, variances, bases)
    return [_spot(i, patch, camera, windows, fits, float(radii[i])) for i, patch in enumerate(patches)]


def _window(patch: Patch, half: int, reach: float, offsets: Array) -> tuple[Array, Mask, Mask]:
    """Return the pixels of a window around a peak: values over the peak, which are used, and which are clipped."""
    (column, row), (height, width) = patch.peak_pixel, patch.values.shape
    side = 2 * half + 1
    top, left = max(row - half, 0), max(column - half, 0)
    bottom, end = min(row + half + 1, height), min(column + half + 1, width)
    inner = np.s_[top - row + half : bottom - row + half, left - column + half : end - column + half]
    crop = np.s_[top:bottom, left:end]
    raw = (patch.values if patch.raw is None else patch.raw)[crop]
    values, used = np.zeros((side, side)), np.zeros((side, side), dtype=bool)
    clipped = np.zeros((side, side), dtype=bool)
    values[inner] = raw / patch.peak_value
    # candidates: seen pixels near the peak, and not of something else as bright
    used[inner] = np.isfinite(raw) if patch.seen is None else np.isfinite(raw) & patch.seen[crop]
    used[inner] &= ~_of_others(patch, crop)
    near = np.sum(offsets**2, axis=0).reshape(side, side) <= reach**2
    for x, y in patch.neighbours_px - patch.peak_px:
        if x * x + y * y < (2 * reach) ** 2:
            # nearer to the neighbour's peak than to this one
            near &= (x * offsets[0] + y * offsets[1] < (x * x + y * y) / 2).reshape(side, side)
    used &= near
    values[~used] = 0.0
    if (shown := clipped_pixels(patch, crop)) is not None:
        clipped[inner] = shown
    return values.ravel(), used.ravel(), (clipped & used).ravel()


def _of_others(patch: Patch, box: tuple[slice, slice]) -> Mask:
    """Return the pixels of a box outside the lowest isophote that closes that are as bright as it."""
    values = patch.values[box]
    for isovalue in OTHER_ISOVALUES:
        if patch.area_px(isovalue) is not None:
            return np.asarray((values > isovalue * patch.peak_value) & ~patch.inside(isovalue)[box])
    return np.zeros(values.shape, dtype=bool)


def _spot(i: int, patch: Patch, camera: Camera, windows: SpotWindows, fits: SpotFits, radius: float) -> SmallSpot:
    """Return the spot of a fit, or the smoothed peak with the spot's size for its error where there is none."""
    corner = np.array(patch.origin_px) + np.array(patch.peak_pixel) + PIXEL_CENTRE
    if not fits.sound[i]:
        anywhere = np.eye(2) * radius**2 / 4  # a point of a disc
        variance = np.eye(2) * radius**2 / GAUSSIAN_RADIUS2
        return SmallSpot(patch, camera, patch.peak_px, variance, np.zeros((2, 2)), anywhere)
    p = fits.parameters[i]
    variance = np.linalg.inv(np.array([[p[XX], p[XY]], [p[XY], p[YY]]]))
    by_noise = fits.covariance[i] * ((patch.noise_at_peak or 0.0) / patch.peak_value) ** 2
    own = max(radius**2 - GAUSSIAN_RADIUS2 * patch.smoothing_px**2, 0.0)
    gaps = np.linalg.norm(patch.neighbours_px - patch.peak_px, axis=1)
    near = NEIGHBOUR_PX4 / max(float(gaps.min(initial=np.inf)), LEAST_GAP_PX) ** 4
    by_shape = (PIXEL_PX2 + RADIUS_SHARE * own**2) * np.eye(2) + MOMENTS_SHARE * variance @ variance + near * variance
    by_shape += RESIDUAL_SHARE * fits.covariance[i] * float(fits.residual[i]) ** 2
    return SmallSpot(patch, camera, corner + p[[X, Y]], variance, by_noise, by_shape)
