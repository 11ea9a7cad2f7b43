"""Cones of sightlines through ellipses, the poses of the circles that these may be [F91; MB, section 2.3, step 4].

A cone of sightlines is an ellipse in any plane across it: `fitting_planes` says in which plane each contour's ellipse
is fitted. `PoseRegion` holds the normals for which a noisy isophote is the image of a circle.
"""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.geometry.camera import Camera
from simtest.geometry.ellipse_fit import FittedConic, FittedConics
from simtest.geometry.vectors import tangent_basis
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.statistics import CONFIDENCE

_ROUND = np.diag([1.0, 1.0, -1.0])

_HUGE = 1e100

FORWARD: Array = np.array([0.0, 0.0, 1.0])

FORWARD.flags.writeable = False


@dataclass(frozen=True)
class CirclePose:
    """The two poses of a circle whose sightlines form a cone.

    Parameters
    ----------
    normals : ndarray, shape (2, 3)
        N+ and N-, unit, facing the camera; each makes the same angle with the cone's axis.
    axis : ndarray, shape (3,)
        e3, unit, pointing into the scene.
    axis_ratio : float
        sqrt(l2 / l1) = b / a, the smaller over the larger tangent of the cone's half-angles.
    centres : ndarray, shape (2, 3)
        Directions of the circles' centres for N+ and N-, unit, camera frame: C'^-1 N.
    """

    normals: Array
    axis: Array
    axis_ratio: float
    centres: Array


@dataclass(frozen=True)
class CirclePoses:
    """The poses of the circles of N cones (see `CirclePose`).

    Parameters
    ----------
    normals : ndarray, shape (N, 2, 3)
    axes : ndarray, shape (N, 3)
    axis_ratios : ndarray, shape (N,)
    centres : ndarray, shape (N, 2, 3)
    failures : mapping
        Failure by the cone's index; the other entries of such a cone mean nothing.
    narrow : ndarray, shape (N, 3)
        Unit e1, times the tangent of the half-angle along it: the narrower one, along which the centres lie.
    """

    normals: Array
    axes: Array
    axis_ratios: Array
    centres: Array
    failures: Mapping[int, Failure]
    narrow: Array

    def __len__(self) -> int:
        return len(self.normals)

    def __getitem__(self, index: int) -> CirclePose | Failure:
        # A negative index must find its failure too.
        index = range(len(self))[operator.index(index)]
        ratio = float(self.axis_ratios[index])
        return self.failures.get(index) or CirclePose(self.normals[index], self.axes[index], ratio, self.centres[index])


def cone_axes(cones: npt.ArrayLike, sightlines: npt.ArrayLike | None = None) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of cones in the order of circle pose: l1 >= l2 > 0 > l3.

    Parameters
    ----------
    cones : array_like, shape (..., 3, 3)
        Symmetric matrices of signature (2, 1) or (1, 2).
    sightlines : array_like, shape (3,) or (..., 3), optional
        Any direction on the wanted side of the cone; default forward. A fisheye also sees cones whose axis points
        backwards.

    Returns
    -------
    values, vectors : ndarray, shapes (..., 3) and (..., 3, 3)
        l1, l2, l3, the sign of each matrix chosen so that det C' < 0, and columns e1, e2, e3, right-handed, e3 on the
        sightline's side (the cone's axis, pointing into the scene).
    """
    values, vectors = _ordered(np.asarray(cones, dtype=float), sightlines)
    hand = np.sign(np.linalg.det(vectors))[..., None]
    vectors[..., 0] *= hand
    return values, vectors


def _ordered(cones: Array, sightlines: npt.ArrayLike | None) -> tuple[Array, Array]:
    """Return what `cone_axes` returns, with eigenvectors of either handedness."""
    values, vectors = np.linalg.eigh(cones)
    # Two eigenvalues share a sign; eigh sorts upwards, so the middle one has it.
    flipped = values[..., 1] < 0
    values = np.where(flipped[..., None], -values, values[..., ::-1])
    vectors = np.where(flipped[..., None, None], vectors, vectors[..., ::-1])
    side = vectors[..., 2, 2] if sightlines is None else np.sum(vectors[..., 2] * np.asarray(sightlines), axis=-1)
    vectors *= np.where(side < 0, -1.0, 1.0)[..., None, None]
    return values, vectors


def circle_pose(cone: npt.ArrayLike, sightline: npt.ArrayLike | None = None) -> CirclePose | Failure:
    """Return the two poses of a circle seen as a conic (see `circle_poses`), shapes (3, 3) and (3,)."""
    return circle_poses(np.asarray(cone, dtype=float)[None], sightline)[0]


def circle_poses(cones: npt.ArrayLike, sightlines: npt.ArrayLike | None = None) -> CirclePoses:
    """Compute the two poses of each circle seen as a conic [MB, section 2.3; F91], from C' = K^T C K, shape (N, 3, 3).

    g = sqrt((l1 - l2)/(l1 - l3)), h = sqrt((l2 - l3)/(l1 - l3)), N+- = -(+-g e1 + h e3). The circle's radius, hence its
    distance, is not observable. C' has any scale and sign; a sightline, shape (N, 3) or (3,), is any direction on the
    wanted side of its cone, default forward. A Failure for each C' that is not finite or not the cone of an ellipse.
    """
    # candidates: finite cones of a size whose squares stay in range; a round cone stands in for the others
    C = np.asarray(cones, dtype=float)
    finite = np.isfinite(C).all(axis=(1, 2))
    if not finite.all():
        C = np.where(finite[:, None, None], C, _ROUND)
    size = np.abs(C).max(axis=(1, 2), keepdims=True)
    extreme = (size > _HUGE) | (size < 1 / _HUGE)
    if extreme.any():
        C = C / np.where(extreme, size + (size == 0), 1.0)
    # reject what is no cone of an ellipse
    values, vectors = _ordered(C, sightlines)
    l1, l2, l3 = values.T
    sound = (l1 >= l2) & (l2 > 0) & (l3 < 0)
    failures = {}
    for index in np.flatnonzero(~(finite & sound)).tolist():
        detail = f"eigenvalues {l1[index]:.3g}, {l2[index]:.3g}, {l3[index]:.3g} are not those of a cone"
        cone = Failure(Reason.DEGENERATE_CONIC, detail)
        failures[index] = cone if finite[index] else Failure(Reason.NOT_FINITE, "C' holds NaN or infinity")
    if failures:
        l1, l2, l3 = (np.where(sound, value, own) for value, own in zip((l1, l2, l3), (1.0, 1.0, -1.0), strict=True))
    # pose [MB, section 2.3, step 4]
    e1, e3 = vectors[:, :, 0], vectors[:, :, 2]
    g, h = np.sqrt((l1 - l2) / (l1 - l3)), np.sqrt((l2 - l3) / (l1 - l3))
    normals = _pair(e1 * g[:, None], e3 * h[:, None])
    # C'^-1 N in the eigenbasis; the centre lies in front of the camera, on the axis' side.
    centres = _pair(e1 * (g / l1)[:, None], e3 * (h / l3)[:, None])
    narrow = e1 * np.sqrt(-l3 / l1)[:, None]
    return CirclePoses(normals, e3, np.sqrt(l2 / l1), centres, failures, narrow)


def _pair(across: Array, along: Array) -> Array:
    """Return the unit vectors along -(+-across + along), shape (N, 2, 3)."""
    both = np.empty((len(along), 2, 3))
    np.add(along, across, out=both[:, 0])
    np.subtract(along, across, out=both[:, 1])
    return np.asarray(both / -np.sqrt((both * both).sum(axis=2, keepdims=True)))


def cone_of_conic(conic: FittedConic | FittedConics, plane_from_camera: Array) -> Array:
    """Return the cone of directions through an ellipse, or through each: C' = A^T C A [MB, section 2.3, step 3].

    A, shape (3, 3) or (N, 3, 3), takes the camera frame to the plane's homogeneous coordinates: K for pixels, a
    rotation for a gnomonic plane. C' is symmetric, scaled to unit norm; w^T C' w = 0 for the directions w of the
    ellipse's points.
    """
    # The transforms are multiplied first, so that a small ellipse far from the origin keeps its digits.
    H = conic.normalised_from_image @ plane_from_camera
    cone = np.swapaxes(H, -1, -2) @ conic.normalised @ H
    cone = (cone + np.swapaxes(cone, -1, -2)) / 2
    return np.asarray(cone / np.sqrt((cone * cone).sum(axis=(-2, -1), keepdims=True)))


def cone_rays(cone: npt.ArrayLike, sightline: npt.ArrayLike | None = None, count: int = 73) -> Array:
    """Return directions along the cone C' of an ellipse, shape (count, 3), the first repeated at the end: for drawing.

    The sightline is any direction on the wanted side of the cone; default forward.
    """
    (l1, l2, l3), vectors = cone_axes(cone, sightline)
    phase = np.linspace(0, 2 * np.pi, count)
    across = [np.cos(phase) / np.sqrt(l1), np.sin(phase) / np.sqrt(l2), np.full(count, 1 / np.sqrt(-l3))]
    return np.asarray((vectors @ np.stack(across)).T)


@dataclass(frozen=True)
class FittingPlanes:
    """N contours, each in a plane in which its sightlines' cone is an ellipse."""

    points: Sequence[Array]  # the contours in their planes' coordinates
    # (3, 3) or (N, 3, 3): from the camera frame to homogeneous coordinates of the one plane, or of each contour's
    # own.
    plane_from_camera: Array
    sightlines: Array  # (N, 3): A direction inside each cone, unit, camera frame
    # Failure by the contour's index; the other entries of such a contour mean nothing.
    failures: Mapping[int, Failure] = field(default_factory=dict)


def fitting_planes(contours: Sequence[Array], camera: Camera) -> FittingPlanes:
    """Map contours to the planes in which their ellipses are fitted.

    A pinhole images ellipses: its plane is the image, with the transform K. Where a lens distorts, the plane is
    perpendicular to the contour's mean sightline, and the transform is a rotation.

    Contours, shape (N_i, 2), px, have at least one point each. One with points at which the lens images nothing, or
    that reaches 90 deg from its mean sightline, is a Failure.
    """
    if camera.distortion is None or not contours:
        return FittingPlanes(contours, camera.K, np.broadcast_to(FORWARD, (len(contours), 3)))
    # mean sightline of each contour
    counts = np.array([len(points) for points in contours])
    first = np.cumsum(counts) - counts
    rays = camera.unproject(np.concatenate(contours))
    mean = np.add.reduceat(rays, first, axis=0)
    length = np.linalg.norm(mean, axis=1)
    failures: dict[int, Failure] = {}
    for index in np.flatnonzero(~(length > 0)).tolist():
        failures[index] = Failure(Reason.NOT_FINITE, "the lens images nothing at points of the isophote")
    sightlines = np.where(length[:, None] > 0, mean, FORWARD)
    sightlines /= np.linalg.norm(sightlines, axis=1, keepdims=True)
    # gnomonic projection onto the plane across it
    rotations = np.stack([*tangent_basis(sightlines), sightlines], axis=1)
    across = np.einsum("nij,nj->ni", np.repeat(rotations, counts, axis=0), rays)
    nearest = np.minimum.reduceat(across[:, 2], first)
    for index in np.flatnonzero(nearest <= 0).tolist():
        failures.setdefault(
            index, Failure(Reason.NOT_AN_ELLIPSE, "the isophote reaches 90 deg from its mean sightline")
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        points = across[:, :2] / across[:, 2:]
    return FittingPlanes(np.split(points, first[1:]), rotations, sightlines, failures)


@dataclass(frozen=True)
class PoseRegion:
    """The normals for which a cone is, within its noise, that of a circle.

    A plane across N cuts the cone C in a circle where, with u and v orthonormal across N,

        g(N) = (u^T C u - v^T C v, 2 u^T C v) = 0,

    two conditions that are linear in the cone's five parameters; the other three are the circle's position and size.
    With Gaussian noise on the cone, g^T cov(g)^-1 g at the true N is therefore exactly chi-squared with two degrees of
    freedom, also where N+ and N- meet and the errors of the normals are not Gaussian.
    """

    frame: Array  # (3, 3): rows: two unit vectors across the cone's axis, and the axis, camera frame
    # (5,): (a, b, c, d, e) of a x^2 + b x y + c y^2 + d x + e y = 1, the cone on the plane at unit distance along
    # the axis.
    conic: Array
    covariance: Array  # (5, 5): of the conic

    def statistic(self, normals: npt.ArrayLike) -> Array:
        """Compute the squared Mahalanobis distance of the cone from the cones of circles perpendicular to normals.

        The normals, shape (..., 3), are unit, camera frame; the distance, shape (...), is 0 at N+ and N-.
        """
        # g = G (a, b, c, d, e, -1) in the basis of each normal
        N = np.asarray(normals, dtype=float)
        local = N.reshape(-1, 3) @ self.frame.T
        u, v = tangent_basis(local)
        G = np.stack([_products(u, u) - _products(v, v), 2 * _products(u, v)], axis=1)
        g = G @ np.append(self.conic, -1.0)
        spread = G[..., :5] @ self.covariance @ np.swapaxes(G[..., :5], 1, 2)
        return np.asarray(np.einsum("ni,ni->n", g, np.linalg.solve(spread, g[..., None])[..., 0]).reshape(N.shape[:-1]))

    def contains(self, normals: npt.ArrayLike, confidence: float = CONFIDENCE) -> Mask:
        """Return which normals, shape (..., 3), lie in the region that holds the truth with a given confidence."""
        return np.asarray(self.statistic(normals) <= chi_squared.quantile(confidence, 2))


def _products(u: Array, v: Array) -> Array:
    """Return u^T C v as weights of the conic's five parameters and of its constant -1, shape (N, 6)."""
    (ux, uy, uz), (vx, vy, vz) = u.T, v.T
    parts = (ux * vx, (ux * vy + uy * vx) / 2, uy * vy, (ux * vz + uz * vx) / 2, (uy * vz + uz * vy) / 2, uz * vz)
    return np.stack(parts, axis=1)
