"""The isophotes of one highlight together: their centre and shape, extrapolated to t -> 1.

Near its peak the lobe is Gaussian to second order: -log(I / I0) = w^T H w / 2, w the tangent of the image angle. The
isophote at t is then an ellipse with second moments E(t) = -2 ln t / H, and the axis of its cone is the peak's
sightline. Terms of higher order in w make E(t) / (-2 ln t) and the axis linear in -ln t to leading order, so both are
extrapolated to the peak by a straight line (theory.md section 3, items 3 and 4; section 6): the axis over the
isophote's area, and to the peak of the lobe before smoothing (`simtest.estimators.isophotes`).

The families of several highlights are fitted at once.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from simtest.conventions import HIGHLIGHT_ELLIPSE_RESIDUAL
from simtest.errors import Failure, Reason
from simtest.estimators.budget import (
    Budget,
    bend_variance,
    excess,
    gram,
    hidden_peak_moments,
    plateau_area_px,
)
from simtest.estimators.isophotes import (
    FittedIsophote,
    IsophotesAcross,
    PeakValue,
    fit_cut_isophote,
    fit_isophotes_of_each,
    fit_peak_value,
    weights_at_zero,
    weights_of_axes,
)
from simtest.geometry import Array, Camera, CirclePose, Mask, Patch, circle_poses, cone_axes
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.geometry.patch import share_of_noise, slope_divisor_px2
from simtest.geometry.vectors import basis_across
from simtest.runtime.fitted import fitted_number

DRIFT_CHI2, SUSPECT_CHI2 = 13.82, 3.22
"""Squared Mahalanobis distances beyond which the axis's drift is more than noise, or may be: 0.1 % and 20 % of normal
pairs lie beyond. On a surface of constant curvature the drift is noise alone; on a colon hardly a highlight is like
that, and where noise hides the drift it hides an error several times the mean axis's noise."""

MEAN_SHARE, MEAN_SIZE = fitted_number("drift.mean_share"), fitted_number("drift.mean_size")
DRIFT_SHARE, DRIFT_PX2 = fitted_number("drift.both_share"), fitted_number("drift.both_px2")


class AxisErrors(NamedTuple):
    """Fitted shares of one axis's errors: of its ripples and bends beyond noise, and of the grid of pixels, px^2."""

    ripples: float
    bends: float
    px2: float


OF_MEAN = AxisErrors(fitted_number("ripples.mean"), fitted_number("bends.mean"), fitted_number("drift.mean_grid_px2"))
OF_PEAK = AxisErrors(fitted_number("ripples.peak"), fitted_number("bends.peak"), fitted_number("drift.peak_grid_px2"))

OFF_PEAK_PX = fitted_number("off_peak.px")
NOISE_SIGMAS = 3.0  # of the gap between axis and peak are noise

STREAK_RATIO = 0.1  # an isophote with a smaller axis ratio is a streak
MIN_CLIPPED_PX = 3  # fewer clipped pixels change a smoothed peak by less than its noise

NOISE_FACTOR = 2.0
"""Standard deviations of a contour's noise that its distance from the ellipse may have on top, added in squares."""


@dataclass(frozen=True)
class IsophoteFamily(IsophotesAcross):
    """The fitted isophotes of one highlight together: the axis of their cones, and what leads from it to the peak."""

    poses: tuple[CirclePose, ...]  # of each isophote
    failures: tuple[Failure, ...]  # of the other isovalues
    least: float = 0.0  # isovalue below which the isophotes hold other highlights too

    @staticmethod
    def of(
        patch: Patch,
        camera: Camera,
        isophotes: Iterable[FittedIsophote],
        poses: Iterable[CirclePose],
        failures: Iterable[Failure] = (),
        least: float = 0.0,
    ) -> "IsophoteFamily":
        """Return the family of isophotes with their poses, about the mean of their axes."""
        poses = tuple(poses)
        axis = sum(pose.axis for pose in poses)
        axis = np.asarray(axis / np.linalg.norm(axis))
        frame = np.concatenate([basis_across(-axis), axis[None]])
        return IsophoteFamily(patch, camera, tuple(isophotes), frame, poses, tuple(failures), least)

    @property
    def axis(self) -> Array:
        """Mean of the cones' axes, unit, shape (3,), camera frame."""
        return self.frame[2]

    @property
    def basis(self) -> Array:
        """Two unit vectors across the axis, shape (2, 3): ``tangent_basis`` of the normal that is its reverse."""
        return self.frame[:2]

    @property
    def axis_ratio(self) -> float:
        """Mean of the cones' axis ratios, as they are."""
        return sum(pose.axis_ratio for pose in self.poses) / len(self.poses)

    @cached_property
    def levels(self) -> Array:
        """-ln t of each isophote, t over the lobe's peak, shape (K,).

        The highest pixel, which isovalues are relative to, is too high where the peak is flat and noisy.
        """
        return np.asarray(-np.log(self.isovalues * self.patch.peak_value / self._peak.value))

    @cached_property
    def _peak(self) -> PeakValue:
        return fit_peak_value(self.patch)

    @cached_property
    def _level_weights(self) -> Array:
        return weights_at_zero(self.levels)

    @cached_property
    def _weights(self) -> Array:
        """Weights of the cones' axes in the axis at the peak, shape (K,)."""
        return weights_of_axes(self.conics, self.isovalues, self.px2, self.patch.smoothing_px)

    @property
    def can_extrapolate(self) -> bool:
        """Whether a line through the isophotes is determined."""
        return len(self.isophotes) > 1

    @cached_property
    def drift(self) -> Array:
        """Offset of the axis at the peak from the mean axis, in the basis, rad, shape (2,); 0 for one isophote.

        The sightlines through the isophotes' centres in the picture are followed: to area 0 they lead where the axes
        do, and beyond it, since the picture was smoothed, they alone lead to the peak before smoothing.
        """
        return self._weights @ self.picture_centres if self.can_extrapolate else np.zeros(2)

    @property
    def peak_axis(self) -> Array:
        """The axis extrapolated to the lobe's peak before smoothing, unit, shape (3,), camera frame."""
        axis = self.axis + self.drift @ self.basis
        return np.asarray(axis / np.linalg.norm(axis))

    @cached_property
    def gap(self) -> Array:
        """Offset of the axis at the peak from the sightline of the peak's pixels, in the basis, rad, shape (2,)."""
        return np.asarray(self.basis @ (self.peak_axis - self.camera.unproject(self.patch.peak_px)))

    def off_peak(self, share: float) -> float:
        """Return the gap over what the size, the grid of pixels and noise allow; above 1 the axis is not the peak's.

        Isophotes of one lobe lead to its peak. Those that follow the shading of a body, or hold several maxima, lead
        elsewhere, the further the broader they are: so what is allowed is `share` of the highlight's size.
        """
        size2 = float(np.sqrt(max(np.linalg.det(self.seen_moments), 0.0)))
        pixel2 = float(np.sqrt(np.linalg.det(self.px2)))
        noise = self.peak_noise if self.axes_covariance is None else _summed(self.axes_covariance) + self.peak_noise
        allowed2 = share**2 * size2 + OFF_PEAK_PX**2 * pixel2 + NOISE_SIGMAS**2 * float(np.trace(noise))
        # A clipped peak lies anywhere on its plateau.
        return float(np.sqrt(self.gap @ self.gap / (allowed2 + np.trace(self.clipping))))

    @property
    def peak_noise(self) -> Array:
        """Covariance of the highest pixel's place by the sensor's noise, shape (2, 2), rad^2.

        The peak lies where the smoothed noise's slope balances that of the lobe, I0 / V, with V the second moments of
        the smoothed lobe.
        """
        patch, lobe = self.patch, self.seen_moments
        slope = (patch.noise_at_peak or 0.0) / (slope_divisor_px2(patch.smoothing_px) * patch.peak_value)
        return np.asarray(slope**2 * lobe @ np.linalg.solve(self.px2, lobe))

    @property
    def drift_is_real(self) -> bool:
        """Whether the drift is more than noise; False where the noise is not known."""
        return self._drift_chi2 > DRIFT_CHI2

    @property
    def drift_is_suspect(self) -> bool:
        """Whether the drift may be more than noise."""
        return self._drift_chi2 > SUSPECT_CHI2

    @cached_property
    def _drift_chi2(self) -> float:
        """Squared Mahalanobis distance of the drift from 0; 0 where the noise is not known."""
        covariance = self.axes_covariance
        # Without noise any drift but rounding is real.
        if covariance is None or not self.can_extrapolate or not self.drift @ self.drift > 1e-18:
            return 0.0
        return float(self.drift @ np.linalg.solve(covariance[2:4, 2:4] + 1e-18 * np.eye(2), self.drift))

    @cached_property
    def moments(self) -> Array:
        """1/H, the lobe's second moments at its peak, rad^2, in the basis, shape (2, 2).

        Corrected for smoothing, which adds s^2 I px^2 to the moments of the lobe, and for the contour's linear
        interpolation, which adds v I to them but subtracts v I from the isophote's, since the peak is a pixel's value.
        """
        return self._moments_at(0.0)

    def _moments_at(self, shift: float) -> Array:
        """Return the moments with all levels shifted."""
        levels = self.levels + shift
        weights = weights_at_zero(levels) / (2 * levels)
        return (weights @ self._narrowed(levels).reshape(-1, 4)).reshape(2, 2)

    @cached_property
    def mean_moments(self) -> Array:
        """The same without extrapolation, shape (2, 2): less noisy, with the same principal directions."""
        return np.asarray(self._narrowed(self.levels).sum(axis=0) / (2 * self.levels.sum()))

    @cached_property
    def seen_moments(self) -> Array:
        """The lobe's second moments as seen, with what smoothing adds, rad^2, in the basis, shape (2, 2).

        Without a fit of the peak's value, which takes as long as all else: for shifts that need no precision.
        """
        levels = -np.log([isophote.isovalue for isophote in self.isophotes])
        return np.asarray(self._tangent_moments.sum(axis=0) / (2 * levels.sum()))

    def _narrowed(self, levels: Array) -> Array:
        """Return E(t) of each isophote without the widening by smoothing and interpolation, shape (K, 2, 2)."""
        return np.asarray(self._tangent_moments - self.added_px2(levels)[:, None, None] * self.px2)

    @cached_property
    def _tangent_moments(self) -> Array:
        """E(t) of each isophote in the basis, squared tangents, shape (K, 2, 2)."""
        # half-axes of each ellipse from its cone's eigenvalues
        cones = np.array([isophote.cone for isophote in self.isophotes])
        values, vectors = cone_axes(cones, np.array([isophote.sightline for isophote in self.isophotes]))
        across = self.basis @ vectors[:, :, :2]
        squares = -values[:, 2:] / values[:, :2]
        return np.asarray((across * squares[:, None]) @ across.transpose(0, 2, 1))

    @cached_property
    def px2(self) -> Array:
        """1 px^2 about the axis's pixel in the basis, rad^2, shape (2, 2)."""
        J = self.basis @ self.camera.step_of_pixels(self.camera.project(self.axis)).T
        return np.asarray(J @ J.T)

    @cached_property
    def axes_covariance(self) -> Array | None:
        """Covariance by noise of mean axis and drift, shape (4, 4); None without known noise."""
        if self.patch.noise is None:
            return None
        # derivatives of the mean of the axes, and of the drift, by each isophote's (d, e)
        by_linear = self._by_linear
        by_conic = np.zeros((len(by_linear), 4, 5))
        by_conic[:, :2, 3:] = by_linear / len(by_linear)
        if self.can_extrapolate:
            by_conic[:, 2:, 3:] = by_linear * (self._weights - 1 / len(by_linear))[:, None, None]
        return gram(self.moved_by_noise(by_conic))

    @cached_property
    def moments_covariance(self) -> Array | None:
        """Covariance by noise of the moments 11, 12, 22, shape (3, 3); None without known noise."""
        if self.patch.noise is None:
            return None
        # derivative by a common shift of the levels, which the peak value causes
        step = 1e-4
        by_shift = (self._moments_at(step) - self._moments_at(-step))[_UPPER] / (2 * step)
        return gram(self.moved_by_noise(self._moments_by_conic, (by_shift, self._peak)))

    def added_px2(self, levels: Array) -> Array:
        """Return what smoothing and linear interpolation add to E(t) at each level, px^2."""
        return np.asarray(2 * levels * self.patch.smoothing_px**2 + LINEAR_INTERPOLATION_PX2 * (2 * levels - 1))

    @cached_property
    def ripple_error(self) -> Array:
        """Covariance of a centre that ripples as the isophotes do beyond noise, shape (2, 2), rad^2.

        The isophotes are combined as in the axis at the peak, which weights what differs between them; the noise must
        be known.
        """
        covariance, ellipse = self.axes_covariance, np.asarray(self._tangent_moments.mean(axis=0))
        assert covariance is not None
        size_px2 = float(np.sqrt(np.linalg.det(ellipse) / np.linalg.det(self.px2)))
        by_noise = float(np.trace(np.linalg.solve(ellipse, _summed(covariance)))) / 2
        weights = self._weights if self.can_extrapolate else np.ones(1)
        beyond = excess(self.ripples, weights, self.levels, by_noise, size_px2, self.patch.smoothing_px)
        return np.asarray(beyond * ellipse)

    @property
    def axis_budget(self) -> Budget | None:
        """Budget of the mean axis in the basis, with what a drift that may be more than noise adds to shape."""
        if self.axes_covariance is None:
            return None
        drifted: list[Array] = []
        if self.drift_is_suspect:
            by_size = MEAN_SIZE * np.sqrt(max(float(np.linalg.det(self.mean_moments)), 0.0)) * np.eye(2)
            drifted = [MEAN_SHARE * np.outer(self.drift, self.drift), by_size]
        return self.budget(self.axes_covariance[:2, :2], OF_MEAN, *drifted)

    @property
    def peak_budget(self) -> Budget | None:
        """Budget of the axis at the peak in the basis: shape is what a straight line misses.

        Noise that makes a large drift is already in this axis's noise: of one that may be noise the excess counts.
        """
        return None if self.axes_covariance is None else self.budget(_summed(self.axes_covariance), OF_PEAK)

    def budget(self, noise: Array, errors: AxisErrors, *shapes: Array) -> Budget:
        """Return the budget of an axis in the basis, whose noise is known, with more covariances that are of shape.

        Resolution: the grid of pixels, a clipped peak, and ripples of the isophotes beyond noise. Shape: the bend of an
        isophote, and a drift beyond noise.
        """
        resolution = errors.ripples * self.ripple_error + self.clipping + errors.px2 * self.px2
        shape = sum(shapes, self.bend_error(errors.bends) + self.drift_error)
        parts = {"noise": noise, "resolution": resolution, "shape": shape}
        # Noise is always stated.
        return {name: part for name, part in parts.items() if name == "noise" or part.any()}

    @cached_property
    def drift_excess(self) -> float:
        """Squared drift beyond noise, rad^2; 0 where it may be noise, or the noise is not known."""
        covariance = self.axes_covariance
        if covariance is None or not self.drift_is_suspect:
            return 0.0
        return max(float(self.drift @ self.drift - np.trace(covariance[2:4, 2:4])), 0.0)

    def bend_error(self, slope: float = OF_MEAN.bends) -> Array:
        """Covariance of the centre by the bend of the isophotes, rad^2, shape (2, 2) (`simtest.estimators.budget`)."""
        return bend_variance(self.residuals, self._residuals_by_noise, self.mean_moments, slope) * np.eye(2)

    @cached_property
    def clipping(self) -> Array:
        """Covariance for a clipped peak, which the isophotes below do not show; 0 where none is clipped."""
        area = plateau_area_px(self.patch, float(self.isovalues.min()))
        if area < MIN_CLIPPED_PX:
            return np.zeros((2, 2))
        innermost = float(self.residuals[-1])
        return hidden_peak_moments(area, self._tangent_moments.sum(axis=0), self.px2, innermost)

    @cached_property
    def drift_error(self) -> Array:
        """Covariance of the peak of a lopsided highlight, which lies on no straight line, rad^2, shape (2, 2)."""
        constant = DRIFT_PX2 * self.px2 if self.drift_is_real else np.zeros((2, 2))
        return np.asarray(DRIFT_SHARE * self.drift_excess * np.eye(2) + constant)

    def tangents(self, points: Array) -> Array:
        """Return the tangents of pixels' angles from the axis, in the basis, shape (N, 2)."""
        return self._across(points).T

    @cached_property
    def _residuals_by_noise(self) -> Array:
        """What of the residuals may be noise, shape (K,)."""
        at_peak = self.patch.noise_at_peak or 0.0
        left = at_peak * share_of_noise(self.patch.smoothing_px) / self.patch.peak_value
        # For a Gaussian lobe, noise over t |d log I / d log r| is the share of its radius that the contour moves by.
        return np.asarray(NOISE_FACTOR * left / (-2 * self.isovalues * np.log(self.isovalues)))

    @cached_property
    def is_bent(self) -> Mask:
        """Whether each isophote differs from an ellipse by more than a point highlight's does, noise included, (K,)."""
        return np.asarray(self.residuals > np.hypot(HIGHLIGHT_ELLIPSE_RESIDUAL, self._residuals_by_noise))

    @property
    def flags(self) -> tuple[str, ...]:
        """Warnings about the isophotes.

        ``missing_isovalues``: some isovalues have no ellipse. ``partial_arc``: some isophotes run into the border of
        the region, the frame or the view, so the highlight may be cut there; they are left out, or fitted to what is
        seen. ``streak``: ten times as long as wide or more, so that the centre is hardly determined along it.
        ``not_elliptic``: an isophote is no ellipse, as where two highlights touch or the curvature changes under one.
        """
        missing = any(failure.reason == Reason.NO_CLOSED_ISOPHOTE for failure in self.failures)
        conditions = {
            "missing_isovalues": bool(self.failures),
            "partial_arc": missing or any(isophote.cut for isophote in self.isophotes),
            "streak": self.axis_ratio < STREAK_RATIO,
            "not_elliptic": bool(self.is_bent.any()),
        }
        return tuple(flag for flag, holds in conditions.items() if holds)

    def flags_at(self, isovalue: float) -> tuple[str, ...] | None:
        """Return the flags of one of the isophotes alone; None if it is not among the whole ones."""
        for isophote, pose, bent in zip(self.isophotes, self.poses, self.is_bent, strict=True):
            if isophote.isovalue == isovalue and not isophote.cut:
                conditions = {"streak": pose.axis_ratio < STREAK_RATIO, "not_elliptic": bool(bent)}
                return tuple(flag for flag, holds in conditions.items() if holds)
        return None

    @property
    def _by_linear(self) -> Array:
        """Derivative of each cone's axis by (d, e) of its conic, shape (K, 2, 2)."""
        # The cone's axis is its third eigenvector, near that of the basis: -(A + I)^-1 (d, e) / 2.
        a, b, c = self.conics.T[:3]
        determinant = (a + 1) * (c + 1) - b * b / 4
        return np.asarray((np.array([[c + 1, -b / 2], [-b / 2, a + 1]]) / (-2 * determinant)).transpose(2, 0, 1))

    @property
    def _moments_by_conic(self) -> Array:
        """Derivative of the moments by the conic of each isophote, shape (K, 3, 5)."""
        a, b, c = self.conics.T[:3]
        made = np.zeros((len(self.isophotes), 3, 5))  # the moments do not depend on d and e
        # E = A^-1 = [[p, q], [q, r]] moves by -E dA E.
        p, q, r = np.array([c, -b / 2, a]) / (a * c - b * b / 4)
        dE = -np.array([[p * p, p * q, q * q], [p * q, (p * r + q * q) / 2, q * r], [q * q, q * r, r * r]])
        made[:, :, :3] = (dE * (self._level_weights / (2 * self.levels))).transpose(2, 0, 1)
        return made


_UPPER = (np.array([0, 0, 1]), np.array([0, 1, 1]))


def _summed(covariance: Array) -> Array:
    """Return the covariance of the sum of two pairs from that of both, shape (4, 4)."""
    both = np.hstack([np.eye(2), np.eye(2)])
    return np.asarray(both @ covariance @ both.T)


MIN_ISOPHOTES = 2  # one isophote alone may be an accident of the background

OTHERS_RESIDUAL, OTHERS_RATIO = 0.1, 2.5
"""A lower isophote that differs from its ellipse by more than this share of its radius, and so many times more than the
innermost one does, holds other highlights too."""


def fit_isophote_family(patch: Patch, camera: Camera, isovalues: Sequence[float]) -> IsophoteFamily | Failure:
    """Fit the isophotes of one highlight (see `fit_isophote_families`)."""
    return fit_isophote_families([patch], camera, isovalues)[0]


def fit_isophote_families(
    patches: Sequence[Patch], camera: Camera, isovalues: Sequence[float]
) -> list[IsophoteFamily | Failure]:
    """Fit the isophotes of several highlights, all ellipses and poses at once, isovalues in any order.

    Where fewer than 2 isophotes (1, if only one isovalue is given) are whole, the seen parts of those that are cut are
    fitted too; with fewer than 2 of either kind the result is the first one's Failure.
    """
    if not patches:
        return []
    # A family begins with the lowest isophote, from which neighbours are left out, and ends with the innermost.
    isovalues = sorted(set(isovalues))
    # whole isophotes
    posed = _with_poses(fit_isophotes_of_each(patches, camera, isovalues))
    least = min(MIN_ISOPHOTES, len(isovalues))
    made: list[IsophoteFamily | Failure] = []
    for patch, (kept, poses, failures) in zip(patches, posed, strict=True):
        if len(poses) < least:
            made.append(_with_arcs(patch, camera, isovalues, kept, failures))
        else:
            family = _of_ellipses(IsophoteFamily.of(patch, camera, kept, poses, failures), least)
            made.append(family if isinstance(family, Failure) else _of_one(family, least))
    return made


def _of_ellipses(family: IsophoteFamily, least: int) -> IsophoteFamily | Failure:
    """Leave out isophotes that are no ellipses across the mean axis; a Failure where too few are left."""
    while not (whole := family.are_ellipses).all():
        # Without them the mean axis is another one.
        failed = [Failure(Reason.NOT_AN_ELLIPSE, f"t = {i.isovalue:g} reaches too far off the mean axis")
                  for i, good in zip(family.isophotes, whole, strict=True) if not good]  # fmt: skip
        if whole.sum() < least:
            return failed[0]
        kept = np.flatnonzero(whole)
        isophotes, poses = tuple(family.isophotes[i] for i in kept), tuple(family.poses[i] for i in kept)
        family = IsophoteFamily.of(family.patch, family.camera, isophotes, poses, (*family.failures, *failed))
    return family


def _of_one(family: IsophoteFamily, least: int) -> IsophoteFamily:
    """Leave out the lower isophotes of a highlight that hold others too, as long as enough are left."""
    residuals = family.residuals
    allowed = max(OTHERS_RESIDUAL, OTHERS_RATIO * float(residuals[-1]))
    first = int(np.max(np.flatnonzero(residuals > allowed), initial=-1)) + 1
    if first == 0 or len(residuals) - first < least:
        return family
    held = [
        Failure(Reason.NOT_AN_ELLIPSE, f"t = {i.isovalue:g} holds other highlights") for i in family.isophotes[:first]
    ]
    kept, poses = family.isophotes[first:], family.poses[first:]
    failures = (*family.failures, *held)
    return IsophoteFamily.of(family.patch, family.camera, kept, poses, failures, kept[0].isovalue)


def _with_arcs(
    patch: Patch, camera: Camera, isovalues: Sequence[float], whole: list[FittedIsophote], failures: list[Failure]
) -> IsophoteFamily | Failure:
    """Fit the arcs of isophotes that the border or the view cuts, where too few are whole."""
    least = min(MIN_ISOPHOTES, len(isovalues))
    closed = {isophote.isovalue for isophote in whole}
    arcs = [fit_cut_isophote(patch, camera, t) for t in isovalues if t not in closed]
    cut = [arc for arc in arcs if isinstance(arc, FittedIsophote)]
    if len(whole) + len(cut) < least:
        return failures[0]
    failed = [arc for arc in arcs if isinstance(arc, Failure)]
    ((kept, poses, failed),) = _with_poses([(sorted([*whole, *cut], key=lambda i: i.isovalue), failed)])
    if len(poses) < least:
        return failures[0]
    return _of_ellipses(IsophoteFamily.of(patch, camera, kept, poses, failed), least)


Posed = tuple[list[FittedIsophote], list[CirclePose], list[Failure]]


def _with_poses(fitted: Sequence[tuple[list[FittedIsophote], list[Failure]]]) -> list[Posed]:
    """Return each highlight's isophotes whose cones have a pose, their poses, and all failures."""
    every = [isophote for isophotes, _ in fitted for isophote in isophotes]
    if not every:
        return [([], [], failures) for _, failures in fitted]
    found = circle_poses(
        np.array([isophote.cone for isophote in every]), np.array([isophote.sightline for isophote in every])
    )
    poses = (found[i] for i in range(len(every)))
    made: list[Posed] = []
    for isophotes, failures in fitted:
        kept, own, failed = [], [], [*failures]
        for isophote in isophotes:
            if isinstance(pose := next(poses), Failure):
                failed.append(pose)
            else:
                kept.append(isophote)
                own.append(pose)
        made.append((kept, own, failed))
    return made
