"""The isophotes of one highlight: contours, ellipses and cones, and how they lie and move across a common axis.

From a patch's contours to ellipses and the cones of their sightlines; the peak value from all pixels around the peak
instead of the highest one alone; the weights that extrapolate to the peak; the crossings in a basis across the axis,
their conics there, and how noise moves them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from simtest.errors import Failure, Reason
from simtest.estimators.budget import Rows, conics_by_crossings, raw_moves, ripples
from simtest.geometry import (
    Array,
    Camera,
    CirclePose,
    FittedConic,
    Index,
    Mask,
    Patch,
    circle_pose,
    cone_of_conic,
    cone_rays,
    fit_arc,
    fit_ellipses,
)
from simtest.geometry.cones import FORWARD, fitting_planes
from simtest.geometry.ellipse_fit import MIN_ARC_RAD, MIN_POINTS, angular_extent
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2, Crossings
from simtest.runtime.arrays import AnyArray, short_repr

MAX_ARC_RESIDUAL = 0.1  # an arc that misses its ellipse by more, RMS over the radius, noise included, is no part of one


@dataclass(frozen=True)
class FittedIsophote:
    """An isophote with its ellipse.

    Parameters
    ----------
    isovalue : float
        t.
    points : ndarray, shape (N, 2)
        Where the contour crosses the lines between pixel centres, px, in no order.
    conic : FittedConic or None
        Ellipse, px; None where the lens distorts, since the fitted curve is then no ellipse in the image.
    cone : ndarray, shape (3, 3)
        C', the cone of sightlines through the fitted curve, camera frame.
    sightline : ndarray, shape (3,)
        A direction inside the cone, which tells its two sides apart.
    cut : bool
        Whether only a part of the contour is seen.
    """

    isovalue: float
    points: Array
    conic: FittedConic | None
    cone: Array
    sightline: Array = field(default_factory=lambda: FORWARD)
    cut: bool = False

    __repr__ = short_repr

    def pose(self) -> CirclePose | Failure:
        """Compute the poses of a circle with this cone (see `simtest.geometry.circle_pose`)."""
        return circle_pose(self.cone, self.sightline)

    def rays(self) -> Array:
        """Return sightlines along the fitted curve, shape (N, 3), closed."""
        return cone_rays(self.cone, self.sightline)

    def ellipse_px(self, camera: Camera) -> Array:
        """Return the fitted curve as the camera images it, shape (N, 2), px, closed: for drawing."""
        return camera.project(self.rays())


def fit_isophotes(
    patch: Patch, camera: Camera, isovalues: Sequence[float]
) -> tuple[list[FittedIsophote], list[Failure]]:
    """Trace and fit a patch's isophotes, for other packages' estimators (see `fit_isophotes_of_each`)."""
    return fit_isophotes_of_each([patch], camera, isovalues)[0]


def fit_isophotes_of_each(
    patches: Sequence[Patch], camera: Camera, isovalues: Sequence[float]
) -> list[tuple[list[FittedIsophote], list[Failure]]]:
    """Trace isophotes at t in (0, 1) and fit their ellipses, all at once [MB, section 2.3, steps 1 to 3].

    Returns those of each patch that succeeded, and the failures of its others.
    """
    contours = [contour for patch in patches for contour in patch.crossings_of(isovalues)]
    results = iter(_fit([*isovalues] * len(patches), contours, camera))
    fitted: list[tuple[list[FittedIsophote], list[Failure]]] = []
    for _ in patches:
        own = [next(results) for _ in isovalues]
        kept = [result for result in own if isinstance(result, FittedIsophote)]
        fitted.append((kept, [result for result in own if isinstance(result, Failure)]))
    return fitted


def fit_isophote_of_each(
    patches: Sequence[Patch | Failure], camera: Camera, isovalue: float
) -> list[FittedIsophote | Failure]:
    """Fit the isophote at the same value of several patches."""
    contours = [patch if isinstance(patch, Failure) else patch.crossings(isovalue) for patch in patches]
    return _fit([isovalue] * len(patches), contours, camera)


def fit_cut_isophote(patch: Patch, camera: Camera, isovalue: float) -> FittedIsophote | Failure:
    """Fit the seen part of an isophote at t in (0, 1) that the border or the view cuts (see `geometry.fit_arc`).

    Also a Failure where the seen part is no arc of an ellipse around the peak: where the region of interest lies on a
    slope, for example, or a wide isophote shows in one corner of the frame alone.
    """
    points = patch.arc(isovalue)
    if len(points) < MIN_POINTS:
        return Failure(Reason.TOO_FEW_POINTS, f"{len(points)} points of the arc; at least {MIN_POINTS} are needed")
    planes = fitting_planes([points], camera)
    fitted = planes.failures.get(0) or fit_arc(planes.points[0])
    if isinstance(fitted, Failure):
        return fitted
    # reject: no ellipse, not around the peak, or too short an arc as seen from the peak
    if fitted.residual > MAX_ARC_RESIDUAL:
        return Failure(Reason.NOT_AN_ELLIPSE, f"the arc misses its ellipse by {fitted.residual:.2g} of the radius")
    plane_from_camera = planes.plane_from_camera if planes.plane_from_camera.ndim == 2 else planes.plane_from_camera[0]
    cone = cone_of_conic(fitted.conic, plane_from_camera)
    peak = camera.unproject(patch.peak_px)
    # Inside the cone, s^T C s has the sign of the one eigenvalue that differs from the other two.
    if not float(peak @ cone @ peak) * float(np.linalg.det(cone)) > 0:
        return Failure(Reason.NOT_AN_ELLIPSE, "the arc's ellipse does not enclose the peak")
    if (seen := angular_extent(points - patch.peak_px)) < MIN_ARC_RAD:
        return Failure(Reason.TOO_FEW_POINTS, f"an arc of {np.degrees(seen):.0f} deg around the peak")
    in_image = fitted.conic if camera.distortion is None else None
    return FittedIsophote(isovalue, points, in_image, cone, planes.sightlines[0], cut=True)


def _fit(
    isovalues: Sequence[float], contours: Sequence[Array | Failure], camera: Camera
) -> list[FittedIsophote | Failure]:
    """Fit ellipses to contours at their isovalues, each in its fitting plane; failures are passed on."""
    traced = {i: contour for i, contour in enumerate(contours) if not isinstance(contour, Failure)}
    planes = fitting_planes(list(traced.values()), camera)
    conics = fit_ellipses(planes.points)
    cones = cone_of_conic(conics, planes.plane_from_camera)
    # back into the order of the contours
    results: dict[int, FittedIsophote | Failure] = {i: c for i, c in enumerate(contours) if isinstance(c, Failure)}
    for row, (i, points) in enumerate(traced.items()):
        conic = planes.failures.get(row) or conics[row]
        if isinstance(conic, Failure):
            results[i] = conic
        else:
            in_image = conic if camera.distortion is None else None
            results[i] = FittedIsophote(isovalues[i], points, in_image, cones[row], planes.sightlines[row])
    return [results[i] for i in range(len(contours))]


LEAST_VARIANCE_PX2 = 4.0
"""A lobe's variance is not trusted below this: little but the widths of pixel and smoothing is then left of it."""


def weights_at_zero(levels: Array) -> Array:
    """Return the weights of values at some levels in the value at level 0 of the straight line through them."""
    gaps = levels - levels.mean()
    spread = float(gaps @ gaps)
    # One level alone, or several equal ones, do not determine the slope: it is taken as 0.
    slope = gaps / spread if spread > 0 else np.zeros_like(levels)
    return np.asarray(1 / len(levels) - levels.mean() * slope)


def weights_of_axes(conics: Array, isovalues: Array, px2: Array, smoothing_px: float) -> Array:
    """Return the weights of the cones' axes in the axis of the peak before smoothing, shape (K,); their sum is 1.

    The axis moves linearly with the isophote's area: without a base that is as with -ln t, but it also holds where the
    lobe stands on a base. Let log I have terms of third order in w. Smoothing by s then moves the peak as far as the
    isophotes' centres move while -ln t grows by 2 s^2 / V, V the lobe's variance before smoothing; where V differs
    between the lobe's axes, by an amount between both, usually near that of the longer axis. The line is therefore
    followed that far beyond area 0.

    `conics`, (K, 5): (a, b, c, d, e) of each isophote's a x^2 + b x y + c y^2 + d x + e y = 1, tangents across the
    axis; `isovalues`, (K,): t of each; `px2`, (2, 2): 1 px^2 in squared tangents; `smoothing_px`: s, px.
    """
    a, b, c = conics.T[:3]
    smoothing = smoothing_px**2 + LINEAR_INTERPOLATION_PX2
    # area of each isophote from its second moments 11, 12, 22, to which the loss by interpolation is added back
    added = LINEAR_INTERPOLATION_PX2 * np.array([[px2[0, 0]], [px2[0, 1]], [px2[1, 1]]])
    p, q, r = np.array([c, -b / 2, a]) / (a * c - b * b / 4) + added
    areas = np.sqrt(np.maximum(p * r - q * q, 0.0))
    # variance of the smoothed lobe, px^2; the highest pixel is accurate enough for its peak
    sums = np.array([[p.sum(), q.sum()], [q.sum(), r.sum()]]) / float(-2 * np.log(isovalues).sum())
    lobe = np.linalg.solve(px2, sums)
    # how far beyond area 0, from the lobe's longer axis
    half, product = float(np.trace(lobe)) / 2, float(np.linalg.det(lobe))
    longer = half + np.sqrt(max(half * half - product, 0.0)) - smoothing
    beyond = 4 * smoothing * np.sqrt(max(product, 0.0) * np.linalg.det(px2)) / max(longer, LEAST_VARIANCE_PX2)
    return weights_at_zero(areas + float(beyond))


TOP_ISOVALUE = 0.8  # above it the logarithm of a glossy lobe is quadratic to a part in a thousand

CLIPPED_ISOVALUE = 0.5
"""The same where the top is clipped: the rest must be wide enough to show the paraboloid's curvature."""

CLIPPED_NEAR = 0.05
"""Largest share of clipped pixels around a fitted one: with more, clipping has lowered its smoothed value."""

MIN_PIXELS = 12  # twice the number of the paraboloid's coefficients


@dataclass(frozen=True)
class PeakValue:
    """The peak value of a lobe and how it moves with the patch's pixels."""

    value: float  # intensity
    pixels: Index  # (N,): indices in the flattened patch
    weights: Array  # (N,): change of log(value) per unit of intensity of each


def fit_peak_value(patch: Patch) -> PeakValue:
    """Return the apex of a patch, fitted once (see `_fit_apex`)."""
    _, kept = patch.kept.get("peak value", (None, None))
    if not isinstance(kept, PeakValue):
        kept = _fit_apex(patch)
        patch.kept["peak value"] = (None, kept)
    return kept


def _fit_apex(patch: Patch) -> PeakValue:
    """Fit a paraboloid to the logarithm of a patch above t = 0.8 and return its apex.

    Where pixels there are clipped, the ring around them down to t = 0.5 is fitted. Where the region does not close, is
    small, or is no dome, the peak's own pixel is used.
    """
    # candidates: the pixels of the region, their coordinates centred and scaled
    column, row = patch.peak_pixel
    own = np.array([row * patch.values.shape[1] + column])
    fallback = PeakValue(patch.peak_value, own, np.array([1 / patch.peak_value]))
    inside = _region(patch)
    pixels = np.flatnonzero(inside)
    values = patch.values.ravel()[pixels].astype(float)
    if len(pixels) < MIN_PIXELS or values.min() <= 0 or len(pixels) == inside.size:
        return fallback
    rows = pixels // patch.values.shape[1]
    x, y = _centred(pixels - rows * patch.values.shape[1]), _centred(rows)
    # least squares by the normal equations
    design = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])
    normal = design @ design.T
    # The eigenvalues show the condition and, with the vectors, solve for both right sides.
    spread, vectors = np.linalg.eigh(normal)
    if not spread[0] * 1e12 > spread[-1]:
        return fallback
    inverse = (vectors / spread) @ vectors.T
    f, d, e, a, b, c = (inverse @ (design @ np.log(values))).tolist()
    if not (a < 0 and 4 * a * c > b * b):
        return fallback
    # apex; rejected outside of the pixels
    determinant = 4 * a * c - b * b
    u, v = (b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant
    apex = np.array([1.0, u, v, u * u, u * v, v * v])
    value = float(np.exp(apex @ [f, d, e, a, b, c]))
    if u * u + v * v > 1:
        return fallback
    # At the apex the value's derivative by position is 0, so only the fit's coefficients move it.
    return PeakValue(value, pixels, (inverse @ apex) @ design / values)


def _centred(indices: Index) -> Array:
    """Return indices relative to their mean, over their range."""
    return np.asarray((indices - indices.mean()) / max(indices.max() - indices.min(), 1))


def _region(patch: Patch) -> Mask:
    """Return the pixels that the paraboloid is fitted to, shape (h, w)."""
    inside = patch.inside(TOP_ISOVALUE, cut=True)
    if patch.saturated is None or not (patch.saturated & inside).any():
        return inside
    side = 2 * int(np.ceil(2 * patch.smoothing_px)) + 1
    near = cv2.blur(patch.saturated.astype(np.float32), (side, side), borderType=cv2.BORDER_REFLECT)
    return np.asarray(patch.inside(CLIPPED_ISOVALUE, cut=True) & (near < CLIPPED_NEAR))


STEP_PX = 0.1  # step of the central differences of a distorting lens's sightlines

_OUTLINE = 2 * np.pi * np.arange(24) / 24
_CIRCLE = np.array([np.cos(_OUTLINE), np.sin(_OUTLINE)])
"""Directions in which an isophote is imaged: the centroid is exact for an ellipse, whatever their number."""


@dataclass(frozen=True)
class IsophotesAcross:
    """K isophotes of one patch, at least one and each the cone of an ellipse, in a basis across their axis.

    All are processed at once, their N points one isophote after the other: a call for each would cost more than the
    work.
    """

    patch: Patch
    camera: Camera
    isophotes: tuple[FittedIsophote, ...]
    frame: Array  # (3, 3): two unit vectors across the axis, and the axis

    @cached_property
    def isovalues(self) -> Array:
        """Isovalue of each isophote, shape (K,)."""
        return np.array([isophote.isovalue for isophote in self.isophotes])

    @cached_property
    def conics(self) -> Array:
        """(a, b, c, d, e) of each isophote's a x^2 + b x y + c y^2 + d x + e y = 1 in the basis, shape (K, 5)."""
        C = self.frame @ np.array([isophote.cone for isophote in self.isophotes]) @ self.frame.T
        C = C / -C[:, 2:, 2:]
        return np.array([C[:, 0, 0], 2 * C[:, 0, 1], C[:, 1, 1], 2 * C[:, 0, 2], 2 * C[:, 1, 2]]).T

    @cached_property
    def are_ellipses(self) -> Mask:
        """Whether each isophote's conic is an ellipse across the axis, shape (K,).

        A cone so wide that it reaches the plane at right angles to the mean axis is none, though its ellipse in the
        picture is one.
        """
        a, b, c, d, e = self.conics.T
        determinant = a * c - b * b / 4
        size = determinant + (a * e * e - b * d * e + c * d * d) / 4
        # a x^2 + ... = 1 is a real ellipse where det A > 0, and A has the sign of the right side about its centre.
        return np.asarray((determinant > 0) & (a * size > 0))

    def _across(self, points: Array) -> Array:
        """Return the tangents of pixels' angles from the axis, in the basis, shapes (M, 2) and (2, M)."""
        if self.camera.distortion is None:
            return self._pinhole(points)[0]
        along = self.frame @ self.camera.unproject(points).T
        return np.asarray(along[:2] / along[2])

    def _pinhole(self, points: Array) -> tuple[Array, Array]:
        """Return the tangents of a pinhole's pixels and the depth they are ratios over: a homography of the image."""
        H = self._from_image
        along = H[:, :2] @ points.T
        along += H[:, 2:]
        return along[:2] / along[2], along[2]

    @cached_property
    def _from_image(self) -> Array:
        return np.asarray(self.frame @ np.linalg.inv(self.camera.K))

    @cached_property
    def residuals(self) -> Array:
        """RMS distance of each isophote's points from its conic, over its mean radius, shape (K,)."""
        F, (by_x, by_y) = self._misses
        squares = F * F / (by_x * by_x + by_y * by_y)
        mean = np.add.reduceat(squares, [part.start for part in self._parts]) / self._counts
        a, b, c = self.conics.T[:3]
        return np.asarray(np.sqrt(mean) * np.maximum(a * c - b * b / 4, 0.0) ** 0.25)

    @cached_property
    def picture_centres(self) -> Array:
        """Where the isophotes' centres in the picture lie, tangents in the basis, shape (K, 2).

        A picture is smoothed in pixels, so that smoothing moves these centres, not the cones' axes. They differ by the
        perspective, and by the lens, in proportion to the isophote's area: a cone through a circle about its axis is
        imaged as an ellipse about another point.
        """
        # points of each ellipse x^T A x + b^T x = 1: its centre and L^-T e, A / size = L L^T
        a, b, c, d, e = self.conics.T
        A = np.array([[a, b / 2], [b / 2, c]]).transpose(2, 0, 1)
        linear = np.array([d, e]).T[:, :, None]
        centres = -np.linalg.solve(A, linear) / 2
        size = 1 - (linear * centres).sum(axis=1) / 2
        lower = np.linalg.cholesky(A / size[:, :, None])
        tangents = (centres + np.linalg.inv(lower).transpose(0, 2, 1) @ _CIRCLE).transpose(0, 2, 1)
        rays = np.concatenate([tangents, np.ones((*tangents.shape[:2], 1))], axis=2) @ self.frame
        # centroid of each curve in the picture
        outline = self.camera.project(rays.reshape(-1, 3)).reshape(tangents.shape)
        middle = outline.mean(axis=1)
        x, y = (outline - middle[:, None]).transpose(2, 0, 1)
        x1, y1 = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
        doubled = x * y1 - x1 * y
        moments = np.array([((x + x1) * doubled).sum(axis=1), ((y + y1) * doubled).sum(axis=1)])
        return np.asarray(self._across((moments / (3 * doubled.sum(axis=1))).T + middle).T)

    @cached_property
    def ripples(self) -> AnyArray:
        """Harmonics of each isophote's radius about its ellipse, shape (K, 3), complex (`ripples.ripples`)."""
        return ripples(self._point_tangents, self.conics, self._counts)

    def moved_by_noise(self, by_conic: Array, by_level: tuple[Array, PeakValue] | None = None) -> Rows:
        """Return how far one standard deviation of noise in each raw pixel moves Q quantities, shape (Q, P).

        A crossing depends on three pixels, the two beside it and the peak's; the ellipse and what follows from it
        depend on its crossings. All is summed by smoothed pixel, then carried to the raw ones. The noise must be known.

        `by_conic`, (K, Q, 5): derivatives of the quantities by each isophote's conic; `by_level`, (Q,), and PeakValue,
        optional: their derivatives by a common shift of all -ln t, and the peak value that t is relative to: it moves
        the levels one way, the peak's pixel the other.
        """
        noise, crossings = self.patch.noise, self._crossings
        assert noise is not None
        # by crossing, through the conics
        by_moment, moments = self._conics_by_crossings
        by_crossing = np.concatenate(
            [each @ moments[:, part] for each, part in zip(by_conic @ by_moment, self._parts, strict=True)], axis=1
        )
        # by smoothed pixel: the two beside each crossing, and the peak's, which sets the level
        by_peak = by_crossing @ (crossings.by_level * np.repeat(self.isovalues, self._counts))
        moves, pixels = [(by_crossing[:, :, None] * crossings.by_pixels).reshape(len(by_peak), -1)], [self._pixels]
        if by_level is not None:
            by_shift, peak = by_level
            by_peak = by_peak - by_shift / self.patch.peak_value
            moves.append(by_shift[:, None] * peak.weights)
            pixels.append(peak.pixels)
        width, (column, row) = self.patch.values.shape[1], self.patch.peak_pixel
        flat = np.concatenate([*pixels, np.array([row * width + column])])
        return raw_moves(
            flat, np.concatenate([*moves, by_peak[:, None]], axis=1), width, noise, self.patch.smoothing_px
        )

    @cached_property
    def _counts(self) -> Index:
        """Points of each isophote, shape (K,)."""
        return np.array([len(isophote.points) for isophote in self.isophotes])

    @cached_property
    def _parts(self) -> list[slice]:
        """The slice of each isophote's points among those of all."""
        ends = np.cumsum(self._counts).tolist()
        return [slice(end - count, end) for end, count in zip(ends, self._counts.tolist(), strict=True)]

    @cached_property
    def _points(self) -> Array:
        """Points of all isophotes, shape (N, 2), px."""
        return np.concatenate([isophote.points for isophote in self.isophotes])

    @cached_property
    def _point_tangents(self) -> Array:
        """Their tangents, shape (2, N)."""
        return self._across(self._points)

    def _steps(self, vertical: Mask) -> Array:
        """Return how the tangents change as each point moves along its line, per px, shape (2, N)."""
        if self.camera.distortion is None:
            tangents, depth = self._pinhole(self._points)
            along = self._from_image.take(vertical.astype(np.intp), axis=1)
            return np.asarray((along[:2] - tangents * along[2]) / depth)
        step, count = STEP_PX * np.array([~vertical, vertical]).T, len(vertical)
        moved = self._across(np.concatenate([self._points + step, self._points - step]))
        return np.asarray((moved[:, :count] - moved[:, count:]) / (2 * STEP_PX))

    @cached_property
    def _misses(self) -> tuple[Array, Array]:
        """Left side less 1 of its conic's equation at each point, shape (N,), and its gradient, shape (2, N)."""
        x, y = self._point_tangents
        a, b, c, d, e = np.repeat(self.conics.T, self._counts, axis=1)
        ax, by, bx, cy = a * x, b * y, b * x, c * y
        return (ax + by + d) * x + (cy + e) * y - 1, np.array([2 * ax + by + d, bx + 2 * cy + e])

    @cached_property
    def _crossings(self) -> Crossings:
        """The points as crossings of lines between pixels, with how they move along these."""
        return self.patch.traced(self.isovalues.tolist(), [isophote.cut for isophote in self.isophotes])

    @cached_property
    def _pixels(self) -> Index:
        """Indices in the flattened patch of the two pixels beside each point, shape (2 N,)."""
        pixels = self._crossings.pixels
        return np.asarray(pixels[..., 1] * self.patch.values.shape[1] + pixels[..., 0]).ravel()

    @cached_property
    def _conics_by_crossings(self) -> tuple[Array, Array]:
        """Derivatives of the conics by their crossings (see `conics_by_crossings`)."""
        moves = self._steps(self._crossings.vertical)
        cut = [isophote.cut for isophote in self.isophotes]
        return conics_by_crossings(self._point_tangents, self._misses[1], moves, self._parts, cut)
