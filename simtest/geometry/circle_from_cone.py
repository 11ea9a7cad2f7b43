"""Pose of a circle from the cone of its sightlines [F91; MB, section 2.3, step 4], and the axes of that cone."""

import operator
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.runtime.arrays import Array


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


_ROUND = np.diag([1.0, 1.0, -1.0])
_HUGE = 1e100


def _pair(across: Array, along: Array) -> Array:
    """Return the unit vectors along -(+-across + along), shape (N, 2, 3)."""
    both = np.empty((len(along), 2, 3))
    np.add(along, across, out=both[:, 0])
    np.subtract(along, across, out=both[:, 1])
    return np.asarray(both / -np.sqrt((both * both).sum(axis=2, keepdims=True)))
