"""The region of `circle_pose`: its conic's covariance, and what smoothing adds to the conic taken off."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.estimators.isophote_family import IsophoteFamily
from simtest.estimators.protocol import FittedIsophote
from simtest.geometry import Camera, Patch
from simtest.geometry.pose_region import PoseRegion

Array = npt.NDArray[np.float64]

STEP = 1e-5
"""Step of the differences between conic and ellipse, as a share of the largest of their parameters."""


def pose_region(patch: Patch, camera: Camera, isophote: FittedIsophote) -> PoseRegion | None:
    """Give the region of normals that an isophote's noise leaves to a circle; None where the noise is not known.

    Smoothing and the contour's linear interpolation widen the ellipse alike in all directions of the image (theory.md
    section 4); without that taken off, the region lies about the normals of another cone.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isophote : FittedIsophote
        Whose cone is taken for a circle's.
    """
    pose = isophote.pose()
    if patch.noise is None or isinstance(pose, Failure):
        return None
    spot = IsophoteFamily(patch, camera, (isophote,), (pose,), ())
    try:
        return _region(spot)
    except np.linalg.LinAlgError:
        # Crossings that leave a parameter of the conic open.
        return None


def _region(spot: IsophoteFamily) -> PoseRegion | None:
    conic, noise = spot.conic(0), spot.conic_covariance(0)
    shrink = np.append(np.zeros(2), -spot.widening()[np.triu_indices(2)])
    ellipse, turn = _ellipse(conic), _jacobian(_ellipse, conic)
    own = ellipse + shrink
    if np.linalg.eigvalsh(_matrix(own))[0] <= 0:
        return None
    back = _jacobian(_conic, own) @ turn
    covariance = back @ noise @ back.T
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        # Without noise there is no region, but its two members.
        return None
    region = PoseRegion(np.concatenate([spot.basis, spot.axis[None]]), _conic(own), covariance)
    return region if np.isfinite(region.statistic(spot.poses[0].normals)).all() else None


def _ellipse(conic: Array) -> Array:
    """Give centre and second moments (x, y, xx, xy, yy) of (a, b, c, d, e), shape (..., 5)."""
    a, b, c, d, e = np.moveaxis(conic, -1, 0)
    determinant = 4 * a * c - b * b
    x, y = (b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant
    scale = 2 * (1 + a * x * x + b * x * y + c * y * y) / determinant
    return np.stack([x, y, 2 * c * scale, -b * scale, 2 * a * scale], axis=-1)


def _conic(ellipse: Array) -> Array:
    """Undo `_ellipse`."""
    x, y, xx, xy, yy = np.moveaxis(ellipse, -1, 0)
    determinant = xx * yy - xy * xy
    a, half, c = yy / determinant, -xy / determinant, xx / determinant
    dx, dy = a * x + half * y, half * x + c * y
    return np.stack([a, 2 * half, c, -2 * dx, -2 * dy], axis=-1) / (1 - x * dx - y * dy)[..., None]


def _matrix(ellipse: Array) -> Array:
    xx, xy, yy = ellipse[2:]
    return np.array([[xx, xy], [xy, yy]])


def _jacobian(function: Callable[[Array], Array], place: Array) -> Array:
    """Give a function's derivatives by central differences, shape (5, 5)."""
    step = STEP * np.abs(place).max()
    steps = step * np.eye(5)
    return np.asarray((function(place + steps) - function(place - steps)).T / (2 * step))
