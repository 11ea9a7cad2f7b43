"""The isophotes of one highlight together: where their centre goes and what shape they take as t goes to 1.

Near its peak the lobe is Gaussian to second order: -log(I / I0) = w^T H w / 2, w the tangent of the image angle. The
isophote at t is then an ellipse with second moments E(t) = -2 ln t / H, and the axis of its cone is the peak's
sightline. Terms of higher order in w make E(t) / (-2 ln t) and the axis run linearly with -ln t to leading order, so
both are followed to t -> 1 by a straight line (theory.md section 3, items 3 and 4; section 6).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.estimators.base import FittedIsophote, fit_isophotes
from simtest.estimators.top import Top, fit_top
from simtest.geometry import Camera, CirclePose, Patch, cone_axes
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2
from simtest.geometry.vectors import tangent_basis

Array = npt.NDArray[np.float64]

MIN_ISOPHOTES = 2
"""One isophote alone may be an accident of the background."""

DRIFT_CHI2 = 13.82
"""Squared Mahalanobis distance beyond which the axis' drift is more than noise: 0.1 % of a normal pair lies beyond."""

KERNEL_SIGMAS = 4.0
"""Half-width of the smoothing kernel over its standard deviation."""

STEP_PX = 0.1
"""Step of the central differences of sightlines."""


@dataclass(frozen=True)
class Spot:
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
        axis = np.mean([pose.axis for pose in self.poses], axis=0)
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def axis_ratio(self) -> float:
        """Mean of the cones' axis ratios, as they are."""
        return float(np.mean([pose.axis_ratio for pose in self.poses]))

    @cached_property
    def basis(self) -> Array:
        """Two unit vectors across the axis, shape (2, 3): ``tangent_basis`` of the normal that is its reverse."""
        return np.stack([vector[0] for vector in tangent_basis(-self.axis[None])])

    @cached_property
    def levels(self) -> Array:
        """-ln t of each isophote, t over the lobe's peak, shape (K,).

        The highest pixel that isovalues are relative to is too high where the top is flat and noisy.
        """
        t = np.array([isophote.isovalue for isophote in self.isophotes])
        return -np.log(t * self.patch.peak_value / self._top.value)

    @cached_property
    def _top(self) -> Top:
        return fit_top(self.patch)

    @property
    def can_extrapolate(self) -> bool:
        """Whether a line through the isophotes is determined."""
        return len(self.isophotes) > 1

    @cached_property
    def drift(self) -> Array:
        """How far the axis at t -> 1 lies from the mean axis, in the basis, rad, shape (2,); 0 for one isophote."""
        places = np.array([pose.axis for pose in self.poses]) @ self.basis.T
        return _to_peak(self.levels) @ places if self.can_extrapolate else np.zeros(2)

    @property
    def peak_axis(self) -> Array:
        """The axis followed to t -> 1, unit, shape (3,), camera frame."""
        axis = self.axis + self.drift @ self.basis
        return np.asarray(axis / np.linalg.norm(axis))

    @cached_property
    def drift_is_real(self) -> bool:
        """Whether the drift is more than noise; not known, and taken as not, where the noise is not known."""
        covariance = self.covariance
        if covariance is None or not self.can_extrapolate:
            return False
        noise = covariance[2:4, 2:4]
        # Without noise any drift is real, but for rounding.
        return bool(self.drift @ self.drift > 1e-18) and bool(
            self.drift @ np.linalg.solve(noise + 1e-18 * np.eye(2), self.drift) > DRIFT_CHI2
        )

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
        each = np.array(self._tangent_moments) - self._added_px2(levels)[:, None, None] * self._px2
        return np.asarray(np.einsum("k,kij->ij", _to_peak(levels) / (2 * levels), each))

    @cached_property
    def _tangent_moments(self) -> list[Array]:
        """E(t) of each isophote in the basis, squared tangents, shape (2, 2) each."""
        made = []
        for isophote in self.isophotes:
            (l1, l2, l3), vectors = cone_axes(isophote.cone, isophote.sightline)
            e1, e2 = self.basis @ vectors[:, 0], self.basis @ vectors[:, 1]
            made.append(-l3 / l1 * np.outer(e1, e1) - l3 / l2 * np.outer(e2, e2))
        return made

    @cached_property
    def _px2(self) -> Array:
        """What 1 px^2 about the axis' pixel is in the basis, rad^2, shape (2, 2)."""
        place = self.camera.project(self.axis)
        steps = np.array([[0.5, 0.0], [0.0, 0.5]])
        ahead, behind = self.camera.unproject(place + steps), self.camera.unproject(place - steps)
        J = self.basis @ (ahead - behind).T
        return np.asarray(J @ J.T)

    @cached_property
    def covariance(self) -> Array | None:
        """Covariance by noise of (mean axis, drift, moments 11, 12, 22), shape (7, 7); None without known noise.

        Each crossing moves with the three pixels that it hangs on, two beside it and the peak's; the ellipse, and what
        is made of it, with its crossings. What is left is a sum over the smoothed pixels, so that the transpose of
        smoothing gives it as a sum over the raw ones, whose noise is independent.
        """
        noise = self.patch.noise
        if noise is None:
            return None
        width = self.patch.values.shape[1]
        column, row = self.patch.peak_pixel
        # The levels move with the top that was fitted, and against the peak's pixel.
        step = 1e-4
        by_shift = np.zeros(7)
        by_shift[4:] = ((self._moments_at(step) - self._moments_at(-step)) / (2 * step))[_UPPER]
        by_peak, pixels, shares = -by_shift / self.patch.peak_value, [], []
        for k, isophote in enumerate(self.isophotes):
            moved = self.patch.sensitivities(isophote.isovalue)
            assert not isinstance(moved, Failure)
            by_crossing = self._outputs(k) @ self._conic_by_crossing(k, isophote.points, moved.vertical)
            by_peak = by_peak + by_crossing @ moved.level * isophote.isovalue
            pixels.append((moved.pixels[..., 1] * width + moved.pixels[..., 0]).ravel())
            shares.append((by_crossing[:, :, None] * moved.weights).reshape(7, -1))
        pixels += [self._top.pixels, np.array([row * width + column])]
        moves = [*shares, np.outer(by_shift, self._top.weights), by_peak[:, None]]
        return self._carried(noise, np.concatenate(pixels), np.concatenate(moves, axis=1))

    def _carried(self, noise: Any, flat: npt.NDArray[np.intp], moves: Array) -> Array:
        """Carry the raw pixels' noise to values that move by `moves`, shape (p, N), with smoothed pixels; (p, p)."""
        images, box = _images(flat, moves, self.patch.values.shape[1])
        margin = int(np.ceil(KERNEL_SIGMAS * self.patch.smoothing_px))
        level = np.pad(noise[box], margin, mode="edge") if isinstance(noise, np.ndarray) else noise
        smoothed = [_transposed_smoothing(image, self.patch.smoothing_px, margin) * level for image in images]
        raw = np.stack(smoothed).reshape(len(smoothed), -1)
        return np.asarray(raw @ raw.T)

    def conic(self, k: int) -> Array:
        """Give (a, b, c, d, e) of an isophote in the basis: a x^2 + b x y + c y^2 + d x + e y = 1, shape (5,)."""
        return self._conics[k]

    def conic_covariance(self, k: int) -> Array:
        """Give its covariance by noise, shape (5, 5); the noise must be known."""
        isophote, (column, row) = self.isophotes[k], self.patch.peak_pixel
        width = self.patch.values.shape[1]
        moved = self.patch.sensitivities(isophote.isovalue)
        assert not isinstance(moved, Failure)
        by_crossing = self._conic_by_crossing(k, isophote.points, moved.vertical)
        by_peak = by_crossing @ moved.level * isophote.isovalue
        flat = (moved.pixels[..., 1] * width + moved.pixels[..., 0]).ravel()
        moves = np.column_stack([(by_crossing[:, :, None] * moved.weights).reshape(5, -1), by_peak])
        return self._carried(self.patch.noise, np.append(flat, row * width + column), moves)

    def widening(self, k: int = 0) -> Array:
        """Give what smoothing and linear interpolation add to an isophote's E(t), rad^2, in the basis, (2, 2)."""
        return self._added_px2(self.levels)[k] * self._px2

    def _added_px2(self, levels: Array) -> Array:
        """Give the same in px^2, for each level."""
        return np.asarray(2 * levels * self.patch.smoothing_px**2 + LINEAR_INTERPOLATION_PX2 * (2 * levels - 1))

    @property
    def axis_covariance(self) -> Array | None:
        """Covariance of the mean axis in the basis, rad^2, shape (2, 2): noise, and drift that is more than noise."""
        covariance = self.covariance
        if covariance is None:
            return None
        noise = covariance[:2, :2]
        if not self.drift_is_real:
            return noise
        # In which direction the peak really lies from here the drift tells only roughly.
        excess = float(self.drift @ self.drift - np.trace(covariance[2:4, 2:4]))
        return np.asarray(noise + max(excess, 0.0) * np.eye(2))

    @property
    def peak_covariance(self) -> Array | None:
        """Covariance of the axis at t -> 1 in the basis, rad^2, shape (2, 2)."""
        if self.covariance is None:
            return None
        both = np.hstack([np.eye(2), np.eye(2)])
        return np.asarray(both @ self.covariance[:4, :4] @ both.T)

    def _conic_by_crossing(self, k: int, points: Array, vertical: npt.NDArray[np.bool_]) -> Array:
        """Tell how the conic a x^2 + b x y + c y^2 + d x + e y = 1 in the basis moves with its crossings, shape (5, N).

        To first order a fit to points near an ellipse moves as the linear one does.
        """
        step = np.where(vertical[:, None], [0.0, STEP_PX], [STEP_PX, 0.0])
        x, y = self.tangents(points).T
        dx, dy = ((self.tangents(points + step) - self.tangents(points - step)) / (2 * STEP_PX)).T
        a, b, c, d, e = self._conics[k]
        misfit = (2 * a * x + b * y + d) * dx + (b * x + 2 * c * y + e) * dy
        design = np.stack([x * x, x * y, y * y, x, y], axis=1)
        design /= (scale := np.abs(design).max(axis=0))
        inverse = np.linalg.solve(design.T @ design, design.T) / scale[:, None]
        return np.asarray(-inverse * misfit)

    def tangents(self, points: Array) -> Array:
        """Give the tangents of pixels' angles from the axis, in the basis, shape (N, 2)."""
        rays = self.camera.unproject(points)
        return np.asarray((rays @ self.basis.T) / (rays @ self.axis)[:, None])

    @cached_property
    def _conics(self) -> list[Array]:
        """(a, b, c, d, e) of each isophote, the constant -1."""
        frame = np.concatenate([self.basis, self.axis[None]])
        made = []
        for isophote in self.isophotes:
            C = frame @ isophote.cone @ frame.T
            C = C / -C[2, 2]
            made.append(np.array([C[0, 0], 2 * C[0, 1], C[1, 1], 2 * C[0, 2], 2 * C[1, 2]]))
        return made

    def _outputs(self, k: int) -> Array:
        """Tell how mean axis, drift and moments move with the conic of an isophote, shape (7, 5)."""
        a, b, c = self._conics[k][:3]
        A = np.array([[a, b / 2], [b / 2, c]])
        E = np.linalg.inv(A)
        # The cone's axis is its third eigenvector, near the basis' own: -(A + I)^-1 (d, e) / 2.
        axis_by_linear = -np.linalg.inv(A + np.eye(2)) / 2
        count, to_peak = len(self.isophotes), _to_peak(self.levels)[k]
        made = np.zeros((7, 5))
        made[0:2, 3:] = axis_by_linear / count
        made[2:4, 3:] = axis_by_linear * (to_peak - 1 / count if self.can_extrapolate else 0.0)
        for column, change in enumerate(_QUADRATIC):
            dE = -E @ change @ E * to_peak / (2 * self.levels[k])
            made[4:, column] = dE[_UPPER]
        return made


_QUADRATIC = (
    np.array([[1.0, 0.0], [0.0, 0.0]]),
    np.array([[0.0, 0.5], [0.5, 0.0]]),
    np.array([[0.0, 0.0], [0.0, 1.0]]),
)


_UPPER = (np.array([0, 0, 1]), np.array([0, 1, 1]))


def _to_peak(levels: Array) -> Array:
    """Give the weights of values at some levels in the value at level 0 of the straight line through them."""
    return np.asarray(np.linalg.pinv(np.stack([np.ones_like(levels), levels], axis=1))[0])


def _images(flat: npt.NDArray[np.intp], moves: Array, width: int) -> tuple[Array, tuple[slice, slice]]:
    """Sum weights, shape (p, N), at their pixels of a patch; gives the images, cut to where they are, and the cut."""
    rows, columns = np.divmod(flat, width)
    top, left, high, wide = rows.min(), columns.min(), np.ptp(rows) + 1, np.ptp(columns) + 1
    place = (rows - top) * wide + columns - left
    images = np.array([np.bincount(place, each, high * wide).reshape(high, wide) for each in moves], dtype=float)
    return images, (slice(top, top + high), slice(left, left + wide))


def _transposed_smoothing(image: Array, sigma_px: float, margin: int) -> Array:
    if sigma_px <= 0:
        return image
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0.0)
    side = 2 * margin + 1
    return np.asarray(cv2.GaussianBlur(padded, (side, side), sigma_px, borderType=cv2.BORDER_CONSTANT))


def fit_spot(patch: Patch, camera: Camera, isovalues: Sequence[float]) -> Spot | Failure:
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
        With fewer than 2 isophotes (1, where no more were asked for) the first one's Failure.
    """
    fitted, failures = fit_isophotes(patch, camera, isovalues)
    kept, poses = [], []
    for isophote in fitted:
        pose = isophote.pose()
        if isinstance(pose, Failure):
            failures.append(pose)
        else:
            kept.append(isophote)
            poses.append(pose)
    if len(poses) < min(MIN_ISOPHOTES, len(isovalues)):
        return failures[0]
    return Spot(patch, camera, tuple(kept), tuple(poses), tuple(failures))
