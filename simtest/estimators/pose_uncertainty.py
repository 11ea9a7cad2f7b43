"""The region of `circle_pose`: its conic without the widening by smoothing, and the conic's covariance."""

from collections.abc import Callable

import numpy as np

from simtest.errors import Failure
from simtest.estimators.isophote_family import IsophoteFamily
from simtest.estimators.isophote_fit import FittedIsophote
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.cones import PoseRegion

STEP = 1e-5
"""Step of the differences between conic and ellipse, as a share of the largest of their parameters."""


def pose_region(patch: Patch, camera: Camera, isophote: FittedIsophote) -> PoseRegion | None:
    """Compute the normals that an isophote's noise allows to a circle; None where the noise is not known.

    Smoothing and the contour's linear interpolation widen the ellipse equally in all directions of the image (theory.md
    section 4). That is subtracted; else the region would lie about the normals of another cone.
    """
    pose = isophote.pose()
    if patch.noise is None or isinstance(pose, Failure):
        return None
    try:
        return _region(IsophoteFamily(patch, camera, (isophote,), (pose,), ()))
    except np.linalg.LinAlgError:
        # The crossings do not determine the conic.
        return None


def _region(family: IsophoteFamily) -> PoseRegion | None:
    conic, noise = family.conic(0), family.conic_covariance(0)  # as seen, after smoothing
    # the ellipse before smoothing: same centre, smaller moments
    shrink = np.append(np.zeros(2), -family.widening()[np.triu_indices(2)])
    ellipse, turn = _ellipse(conic), _jacobian(_ellipse, conic)
    own = ellipse + shrink
    if np.linalg.eigvalsh(_matrix(own))[0] <= 0:
        return None
    # its conic's covariance, from that of the smoothed one
    back = _jacobian(_conic, own) @ turn
    covariance = back @ noise @ back.T
    if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
        # Without noise the region is its two members alone.
        return None
    region = PoseRegion(np.concatenate([family.basis, family.axis[None]]), _conic(own), covariance)
    return region if np.isfinite(region.statistic(family.poses[0].normals)).all() else None


def _ellipse(conic: Array) -> Array:
    """Return centre and second moments (x, y, xx, xy, yy) of (a, b, c, d, e), shape (..., 5)."""
    a, b, c, d, e = np.moveaxis(conic, -1, 0)
    determinant = 4 * a * c - b * b
    x, y = (b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant
    scale = 2 * (1 + a * x * x + b * x * y + c * y * y) / determinant
    return np.stack([x, y, 2 * c * scale, -b * scale, 2 * a * scale], axis=-1)


def _conic(ellipse: Array) -> Array:
    """Return (a, b, c, d, e) of centre and second moments: the inverse of `_ellipse`."""
    x, y, xx, xy, yy = np.moveaxis(ellipse, -1, 0)
    determinant = xx * yy - xy * xy
    a, half, c = yy / determinant, -xy / determinant, xx / determinant
    dx, dy = a * x + half * y, half * x + c * y
    return np.stack([a, 2 * half, c, -2 * dx, -2 * dy], axis=-1) / (1 - x * dx - y * dy)[..., None]


def _matrix(ellipse: Array) -> Array:
    xx, xy, yy = ellipse[2:]
    return np.array([[xx, xy], [xy, yy]])


def _jacobian(function: Callable[[Array], Array], at: Array) -> Array:
    """Compute a function's derivatives by central differences, shape (5, 5)."""
    step = STEP * np.abs(at).max()
    steps = step * np.eye(5)
    return np.asarray((function(at + steps) - function(at - steps)).T / (2 * step))
