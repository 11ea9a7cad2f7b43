"""The crossings of a highlight's isophotes in a basis across its axis, their conics there, and how noise moves them.

All isophotes are processed at once: a call for each would cost more than the work.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from simtest.estimators.isophote_fit import FittedIsophote
from simtest.estimators.peak_value import PeakValue
from simtest.estimators.propagation import Rows, conics_by_crossings, raw_moves
from simtest.estimators.ripples import ripples
from simtest.geometry import Array, Camera, Index, Mask, Patch
from simtest.geometry.level_sets import Crossings
from simtest.runtime.arrays import AnyArray

STEP_PX = 0.1
"""Step of the central differences of a distorting lens's sightlines."""

_OUTLINE = 2 * np.pi * np.arange(24) / 24
_CIRCLE = np.array([np.cos(_OUTLINE), np.sin(_OUTLINE)])
"""Directions in which an isophote is imaged: the centroid is exact for an ellipse, whatever their number."""


@dataclass(frozen=True)
class FamilyCrossings:
    """The points of K isophotes, N in all, one isophote after the other.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isophotes : tuple of FittedIsophote
        Each the cone of an ellipse.
    frame : ndarray, shape (3, 3)
        Two unit vectors across the axis, and the axis.
    """

    patch: Patch
    camera: Camera
    isophotes: tuple[FittedIsophote, ...]
    frame: Array

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

    def tangents(self, points: Array) -> Array:
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
        return np.asarray(self.tangents((moments / (3 * doubled.sum(axis=1))).T + middle).T)

    @cached_property
    def ripples(self) -> AnyArray:
        """Harmonics of each isophote's radius about its ellipse, shape (K, 3), complex (`ripples.ripples`)."""
        return ripples(self._point_tangents, self.conics, self._counts)

    def moved_by_noise(self, by_conic: Array, by_level: tuple[Array, PeakValue] | None = None) -> Rows:
        """Return how far one standard deviation of noise in each raw pixel moves Q quantities, shape (Q, P).

        A crossing depends on three pixels, the two beside it and the peak's; the ellipse and what follows from it
        depend on its crossings. All is summed by smoothed pixel, then carried to the raw ones. The noise must be known.

        Parameters
        ----------
        by_conic : ndarray, shape (K, Q, 5)
            Derivatives of the quantities by each isophote's conic.
        by_level : tuple of ndarray, shape (Q,), and PeakValue, optional
            Their derivatives by a common shift of all -ln t, and the peak value that t is relative to: it moves the
            levels one way, the peak's pixel the other.
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
        return self.tangents(self._points)

    def _steps(self, vertical: Mask) -> Array:
        """Return how the tangents change as each point moves along its line, per px, shape (2, N)."""
        if self.camera.distortion is None:
            tangents, depth = self._pinhole(self._points)
            along = self._from_image.take(vertical.astype(np.intp), axis=1)
            return np.asarray((along[:2] - tangents * along[2]) / depth)
        step, count = STEP_PX * np.array([~vertical, vertical]).T, len(vertical)
        moved = self.tangents(np.concatenate([self._points + step, self._points - step]))
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
