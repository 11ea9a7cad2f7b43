"""Conics: the cone of sightlines through a fitted ellipse, and the ellipse of a conic."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry.circle_from_cone import cone_axes
from simtest.geometry.ellipse_fit import FittedConic, FittedConics
from simtest.runtime.arrays import Array


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
class Ellipse:
    """An ellipse in the plane.

    Parameters
    ----------
    centre : ndarray, shape (2,)
        px.
    semi_major, semi_minor : float
        px.
    angle : float
        Direction of the major axis, rad from x to y, in (-pi/2, pi/2].
    """

    centre: Array
    semi_major: float
    semi_minor: float
    angle: float


def ellipse_of_conic(conic: npt.ArrayLike) -> Ellipse:
    """Compute centre and axes of a symmetric conic, shape (3, 3), that is a real ellipse."""
    C = np.asarray(conic, dtype=float)
    C = C if np.trace(C[:2, :2]) > 0 else -C
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    values, vectors = np.linalg.eigh(C[:2, :2])
    major = vectors[:, 0]
    angle = float(np.arctan2(major[1], major[0]))
    angle = angle - np.pi if angle > np.pi / 2 else angle + np.pi if angle <= -np.pi / 2 else angle
    return Ellipse(centre, float(np.sqrt(level / values[0])), float(np.sqrt(level / values[1])), angle)
