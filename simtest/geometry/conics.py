"""Conics: back-projection into the camera frame and the ellipse of a conic."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry.camera import Camera
from simtest.geometry.ellipse_fit import FittedConic, FittedConics

Array = npt.NDArray[np.float64]


def backproject_conic(conic: FittedConic | FittedConics, camera: Camera) -> Array:
    """Give the cone of sightlines through an image ellipse, or each of several: C' = K^T C K [MB, section 2.3, step 3].

    The transforms are multiplied before the conic is touched, so that a small ellipse far from the origin keeps its
    digits.

    Parameters
    ----------
    conic : FittedConic or FittedConics
        In pixels.
    camera : Camera
        For K.

    Returns
    -------
    ndarray, shape (3, 3) or (N, 3, 3)
        Symmetric; w^T C' w = 0 for the sightlines w of the ellipse's pixels. Scaled to unit norm.
    """
    H = conic.normalised_from_image @ camera.K
    cone = np.swapaxes(H, -1, -2) @ conic.normalised @ H
    cone = (cone + np.swapaxes(cone, -1, -2)) / 2
    return np.asarray(cone / np.linalg.norm(cone, axis=(-2, -1), keepdims=True))


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

    def points(self, count: int = 100) -> Array:
        """Give points along the ellipse, shape (count, 2), the first repeated at the end."""
        phase = np.linspace(0, 2 * np.pi, count)
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        local = np.stack([self.semi_major * np.cos(phase), self.semi_minor * np.sin(phase)], axis=1)
        return np.asarray(self.centre + local @ np.array([[cos, sin], [-sin, cos]]))


def ellipse_of_conic(conic: npt.ArrayLike) -> Ellipse:
    """Give centre and axes of a conic that is a real ellipse.

    Parameters
    ----------
    conic : array_like, shape (3, 3)
        Symmetric.

    Returns
    -------
    Ellipse
    """
    C = np.asarray(conic, dtype=float)
    C = C if np.trace(C[:2, :2]) > 0 else -C
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    values, vectors = np.linalg.eigh(C[:2, :2])
    major = vectors[:, 0]
    angle = float(np.arctan2(major[1], major[0]))
    angle = angle - np.pi if angle > np.pi / 2 else angle + np.pi if angle <= -np.pi / 2 else angle
    return Ellipse(centre, float(np.sqrt(level / values[0])), float(np.sqrt(level / values[1])), angle)
