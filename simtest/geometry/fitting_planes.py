"""The planes in which ellipses are fitted: a cone of sightlines is an ellipse in any plane across it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from simtest.errors import Failure, Reason
from simtest.geometry.camera import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array

FORWARD: Array = np.array([0.0, 0.0, 1.0])
FORWARD.flags.writeable = False


@dataclass(frozen=True)
class FittingPlanes:
    """N contours, each in a plane in which its sightlines' cone is an ellipse.

    Parameters
    ----------
    points : sequence of ndarray, shape (N_i, 2)
        The contours in their planes' coordinates.
    plane_from_camera : ndarray, shape (3, 3) or (N, 3, 3)
        From the camera frame to homogeneous coordinates of the one plane, or of each contour's own.
    sightlines : ndarray, shape (N, 3)
        A direction inside each cone, unit, camera frame.
    failures : mapping
        Failure by the contour's index; the other entries of such a contour mean nothing.
    """

    points: Sequence[Array]
    plane_from_camera: Array
    sightlines: Array
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
