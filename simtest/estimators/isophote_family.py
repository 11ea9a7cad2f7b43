"""The isophotes of one highlight together: where their centre goes and what shape they take as t goes to 1.

Near its peak the lobe is Gaussian to second order: -log(I / I0) = w^T H w / 2, w the tangent of the image angle. The
isophote at t is then an ellipse with second moments E(t) = -2 ln t / H, and the axis of its cone is the peak's
sightline. Terms of higher order in w make E(t) / (-2 ln t) and the axis run linearly with -ln t to leading order, so
both are followed to the peak by a straight line (theory.md section 3, items 3 and 4; section 6). The axis is followed
over the isophote's area, and to the peak of the lobe as it was before smoothing (`simtest.estimators.extrapolation`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.conventions import HIGHLIGHT_ELLIPSE_RESIDUAL
from simtest.errors import Failure
from simtest.estimators.extrapolation import weights_at_zero, weights_of_axes
from simtest.estimators.family_crossings import FamilyCrossings
from simtest.estimators.peak_value import PeakValue, fit_peak_value
from simtest.estimators.propagation import gram
from simtest.estimators.protocol import FittedIsophote, fit_cut_isophote, fit_isophotes
from simtest.geometry import Camera, CirclePose, Patch, circle_poses, cone_axes
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.geometry.vectors import tangent_basis

Array = npt.NDArray[np.float64]

MIN_ISOPHOTES = 2
"""One isophote alone may be an accident of the background."""

DRIFT_CHI2, SUSPECT_CHI2 = 13.82, 3.22
"""Squared Mahalanobis distances beyond which the axis' drift is more than noise, and may be: 0.1 % and 20 % of normal
pairs lie beyond. A surface whose curvature does not change drifts by noise alone; on a colon hardly a highlight does,
and where noise hides the drift, it hides an error several times the mean axis' noise."""

MEAN_SHARE = 0.5
"""Variance of the mean axis along the drift, over the squared drift: the peak lies there, by 0.8 to 1.7 times it."""

PEAK_SHARE, PEAK_PX2 = 0.02, 0.008
"""Variance of the axis at the peak over the squared drift, and what is added to it, px^2, where there is a drift: terms
of higher order, pixels and, in renders of meshes, triangles. These and MEAN_SHARE are what 614 highlights of the
generated colon showed, on viewpoints that no figure of the page is from."""

NOISE_FACTOR = 2.0
"""How many standard deviations of a contour's noise its distance from the ellipse may have on top, in squares."""


@dataclass(frozen=True)
class IsophoteFamily:
    """The fitted isophotes of one highlight.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isophotes : tuple of FittedIsophote
        At least one; each the cone of an ellipse.
    poses : tuple of CirclePose
        Of each isophote.
    failures : tuple of Failure
        Of the other isovalues.
    """

    patch: Patch
    camera: Camera
    isophotes: tuple[FittedIsophote, ...]
    poses: tuple[CirclePose, ...]
    failures: tuple[Failure, ...]

    @cached_property
    def axis(self) -> Array:
        """Mean of the cones' axes, unit, shape (3,), camera frame."""
        axis = sum(pose.axis for pose in self.poses)
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def axis_ratio(self) -> float:
        """Mean of the cones' axis ratios, as they are."""
        return sum(pose.axis_ratio for pose in self.poses) / len(self.poses)

    @cached_property
    def basis(self) -> Array:
        """Two unit vectors across the axis, shape (2, 3): ``tangent_basis`` of the normal that is its reverse."""
        return np.concatenate(tangent_basis(-self.axis[None]))

    @cached_property
    def _crossings(self) -> FamilyCrossings:
        return FamilyCrossings(self.patch, self.camera, self.isophotes, np.concatenate([self.basis, self.axis[None]]))

    @cached_property
    def levels(self) -> Array:
        """-ln t of each isophote, t over the lobe's peak, shape (K,).

        The highest pixel that isovalues are relative to is too high where the top is flat and noisy.
        """
        return np.asarray(-np.log(self._crossings.isovalues * self.patch.peak_value / self._top.value))

    @cached_property
    def _top(self) -> PeakValue:
        return fit_peak_value(self.patch)

    @cached_property
    def _level_weights(self) -> Array:
        return weights_at_zero(self.levels)

    @cached_property
    def _weights(self) -> Array:
        """Weights of the cones' axes in the axis at the peak, shape (K,)."""
        crossings = self._crossings
        return weights_of_axes(crossings.conics, crossings.isovalues, self._px2, self.patch.smoothing_px)

    @property
    def can_extrapolate(self) -> bool:
        """Whether a line through the isophotes is determined."""
        return len(self.isophotes) > 1

    @cached_property
    def drift(self) -> Array:
        """How far the axis at the peak lies from the mean axis, in the basis, rad, shape (2,); 0 for one isophote."""
        places = np.array([pose.axis for pose in self.poses]) @ self.basis.T
        return self._weights @ places if self.can_extrapolate else np.zeros(2)

    @property
    def peak_axis(self) -> Array:
        """The axis followed to the lobe's peak before smoothing, unit, shape (3,), camera frame."""
        axis = self.axis + self.drift @ self.basis
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def drift_is_real(self) -> bool:
        """Whether the drift is more than noise; not known, and taken as not, where the noise is not known."""
        return self._drift_chi2 > DRIFT_CHI2

    @cached_property
    def _drift_chi2(self) -> float:
        """Squared Mahalanobis distance of the drift from 0; 0 where the noise is not known."""
        covariance = self.axes_covariance
        # Without noise any drift is real, but for rounding.
        if covariance is None or not self.can_extrapolate or not self.drift @ self.drift > 1e-18:
            return 0.0
        return float(self.drift @ np.linalg.solve(covariance[2:4, 2:4] + 1e-18 * np.eye(2), self.drift))

    @cached_property
    def moments(self) -> Array:
        """1/H, the lobe's second moments at its peak, rad^2, in the basis, shape (2, 2).

        Corrected for smoothing, which adds s^2 I px^2 to the moments of the lobe, and for the contour's linear
        interpolation, which adds v I to them but takes v I off the isophote's, the peak being a pixel's value.
        """
        return self._moments_at(0.0)

    def _moments_at(self, shift: float) -> Array:
        """Give the moments with the levels moved by a shift."""
        levels = self.levels + shift
        return np.asarray(np.einsum("k,kij->ij", weights_at_zero(levels) / (2 * levels), self._narrowed(levels)))

    @property
    def mean_moments(self) -> Array:
        """The same without the way to t -> 1, shape (2, 2): of less noise, and of the same principal directions."""
        return np.asarray(self._narrowed(self.levels).sum(axis=0) / (2 * self.levels.sum()))

    def _narrowed(self, levels: Array) -> Array:
        """Give E(t) of each isophote less what smoothing and interpolation add to it, shape (K, 2, 2)."""
        return np.asarray(self._tangent_moments - self._added_px2(levels)[:, None, None] * self._px2)

    @cached_property
    def _tangent_moments(self) -> Array:
        """E(t) of each isophote in the basis, squared tangents, shape (K, 2, 2)."""
        cones = np.array([isophote.cone for isophote in self.isophotes])
        values, vectors = cone_axes(cones, np.array([isophote.sightline for isophote in self.isophotes]))
        across = self.basis @ vectors[:, :, :2]
        squares = -values[:, 2:] / values[:, :2]
        return np.asarray((across * squares[:, None]) @ across.transpose(0, 2, 1))

    @cached_property
    def _px2(self) -> Array:
        """What 1 px^2 about the axis' pixel is in the basis, rad^2, shape (2, 2)."""
        place = self.camera.project(self.axis)
        steps = np.array([[0.5, 0.0], [0.0, 0.5]])
        ahead, behind = self.camera.unproject(place + steps), self.camera.unproject(place - steps)
        J = self.basis @ (ahead - behind).T
        return np.asarray(J @ J.T)

    @cached_property
    def axes_covariance(self) -> Array | None:
        """Covariance by noise of mean axis and drift, shape (4, 4); None without known noise."""
        if self.patch.noise is None:
            return None
        by_linear = self._by_linear
        by_conic = np.zeros((len(by_linear), 4, 5))
        by_conic[:, :2, 3:] = by_linear / len(by_linear)
        if self.can_extrapolate:
            by_conic[:, 2:, 3:] = by_linear * (self._weights - 1 / len(by_linear))[:, None, None]
        return gram(self._crossings.moved_by_noise(by_conic))

    @cached_property
    def moments_covariance(self) -> Array | None:
        """Covariance by noise of the moments 11, 12, 22, shape (3, 3); None without known noise."""
        if self.patch.noise is None:
            return None
        step = 1e-4
        by_shift = (self._moments_at(step) - self._moments_at(-step))[_UPPER] / (2 * step)
        return gram(self._crossings.moved_by_noise(self._moments_by_conic, (by_shift, self._top)))

    def conic(self, k: int) -> Array:
        """Give (a, b, c, d, e) of an isophote in the basis: a x^2 + b x y + c y^2 + d x + e y = 1, shape (5,)."""
        return self._crossings.conics[k]

    def conic_covariance(self, k: int) -> Array:
        """Give its covariance by noise, shape (5, 5); the noise must be known."""
        alone = replace(self._crossings, isophotes=self.isophotes[k : k + 1])
        return gram(alone.moved_by_noise(np.eye(5)[None]))

    def widening(self, k: int = 0) -> Array:
        """Give what smoothing and linear interpolation add to an isophote's E(t), rad^2, in the basis, (2, 2)."""
        return self._added_px2(self.levels)[k] * self._px2

    def _added_px2(self, levels: Array) -> Array:
        """Give the same in px^2, for each level."""
        return np.asarray(2 * levels * self.patch.smoothing_px**2 + LINEAR_INTERPOLATION_PX2 * (2 * levels - 1))

    @property
    def axis_covariance(self) -> Array | None:
        """Covariance of the mean axis in the basis, rad^2, shape (2, 2): noise, and drift that may be more than it."""
        covariance = self.axes_covariance
        if covariance is None:
            return None
        if self._drift_chi2 <= SUSPECT_CHI2:
            return covariance[:2, :2]
        return np.asarray(covariance[:2, :2] + MEAN_SHARE * np.outer(self.drift, self.drift) + self._left_open)

    @property
    def drift_excess(self) -> float:
        """Squared drift beyond noise, rad^2; 0 where it is hardly more than noise, or the noise is not known."""
        covariance = self.axes_covariance
        if covariance is None or self._drift_chi2 <= SUSPECT_CHI2:
            return 0.0
        return max(float(self.drift @ self.drift - np.trace(covariance[2:4, 2:4])), 0.0)

    @property
    def peak_covariance(self) -> Array | None:
        """Covariance of the axis at the peak in the basis, rad^2, shape (2, 2): noise, and what a line leaves open."""
        covariance = self.axes_covariance
        if covariance is None:
            return None
        both = np.hstack([np.eye(2), np.eye(2)])
        noise = np.asarray(both @ covariance @ both.T)
        # Noise that drifts far has moved this axis far: more for a mere suspicion would be for such noise.
        return noise + self._left_open if self.drift_is_real else noise

    @property
    def _left_open(self) -> Array:
        """What a lopsided highlight leaves open about its peak, rad^2, shape (2, 2)."""
        return np.asarray(PEAK_SHARE * self.drift_excess * np.eye(2) + PEAK_PX2 * self._px2)

    def tangents(self, points: Array) -> Array:
        """Give the tangents of pixels' angles from the axis, in the basis, shape (N, 2)."""
        return self._crossings.tangents(points).T

    @cached_property
    def is_bent(self) -> bool:
        """Whether an isophote is no ellipse by more than that of a point highlight may differ, and noise allows for."""
        noise = self.patch.noise
        at_peak = float(noise[self.patch.peak_pixel[::-1]]) if isinstance(noise, np.ndarray) else noise or 0.0
        left = at_peak / np.sqrt(1 + 4 * np.pi * self.patch.smoothing_px**2) / self.patch.peak_value
        # Of a Gaussian lobe: noise over t |d log I / d log r| moves the contour by that share of its radius.
        isovalues = self._crossings.isovalues
        by_noise = left / (-2 * isovalues * np.log(isovalues))
        return bool((self._crossings.residuals > np.hypot(HIGHLIGHT_ELLIPSE_RESIDUAL, NOISE_FACTOR * by_noise)).any())

    @property
    def _by_linear(self) -> Array:
        """Tell how each cone's axis moves with (d, e) of its conic, shape (K, 2, 2)."""
        # The cone's axis is its third eigenvector, near the basis' own: -(A + I)^-1 (d, e) / 2.
        a, b, c = self._crossings.conics.T[:3]
        determinant = (a + 1) * (c + 1) - b * b / 4
        return np.asarray((np.array([[c + 1, -b / 2], [-b / 2, a + 1]]) / (-2 * determinant)).transpose(2, 0, 1))

    @property
    def _moments_by_conic(self) -> Array:
        """Tell how the moments move with the conic of each isophote, shape (K, 3, 5)."""
        a, b, c = self._crossings.conics.T[:3]
        made = np.zeros((len(self.isophotes), 3, 5))
        # E = A^-1 = [[p, q], [q, r]] moves by -E dA E.
        p, q, r = np.array([c, -b / 2, a]) / (a * c - b * b / 4)
        dE = -np.array([[p * p, p * q, q * q], [p * q, (p * r + q * q) / 2, q * r], [q * q, q * r, r * r]])
        made[:, :, :3] = (dE * (self._level_weights / (2 * self.levels))).transpose(2, 0, 1)
        return made


_UPPER = (np.array([0, 0, 1]), np.array([0, 1, 1]))


def fit_isophote_family(patch: Patch, camera: Camera, isovalues: Sequence[float]) -> IsophoteFamily | Failure:
    """Fit the isophotes of one highlight.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isovalues : sequence of float
        Each t in (0, 1).

    Returns
    -------
    Spot or Failure
        Where fewer than 2 isophotes (1, where no more were asked for) are whole, those that are cut are fitted to what
        is seen of them; with fewer than 2 of either kind the first one's Failure.
    """
    fitted, failures = fit_isophotes(patch, camera, isovalues)
    kept, poses, failures = _with_poses(fitted, failures)
    least = min(MIN_ISOPHOTES, len(isovalues))
    if len(poses) < least:
        whole = {isophote.isovalue for isophote in kept}
        arcs = [fit_cut_isophote(patch, camera, t) for t in isovalues if t not in whole]
        cut = [arc for arc in arcs if isinstance(arc, FittedIsophote)]
        if len(kept) + len(cut) < least:
            return failures[0]
        failed = [arc for arc in arcs if isinstance(arc, Failure)]
        kept, poses, failed = _with_poses(sorted([*kept, *cut], key=lambda i: i.isovalue), failed)
        if len(poses) < least:
            return failures[0]
        failures = failed
    return IsophoteFamily(patch, camera, tuple(kept), tuple(poses), tuple(failures))


def _with_poses(
    fitted: list[FittedIsophote], failures: list[Failure]
) -> tuple[list[FittedIsophote], list[CirclePose], list[Failure]]:
    """Give the isophotes whose cones have a pose, their poses, and the failures, those of the others added."""
    if not fitted:
        return [], [], failures
    found = circle_poses(
        np.array([isophote.cone for isophote in fitted]), np.array([isophote.sightline for isophote in fitted])
    )
    kept, poses = [], []
    for isophote, pose in zip(fitted, (found[i] for i in range(len(fitted))), strict=True):
        if isinstance(pose, Failure):
            failures = [*failures, pose]
        else:
            kept.append(isophote)
            poses.append(pose)
    return kept, poses, failures
