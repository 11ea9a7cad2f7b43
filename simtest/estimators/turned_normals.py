"""Normals with covariances, from the rotations that a network states."""

import numpy as np

from simtest.estimators.spot_inputs import normal_of
from simtest.geometry import Array
from simtest.geometry.vectors import tangent_basis

STEP = 1e-5
"""Step of the differences of the normal, rad."""


def turned_normals(rays: Array, rotation: Array, root: Array) -> tuple[Array, Array]:
    """Return normals and their covariances, to first order.

    Parameters
    ----------
    rays : ndarray, shape (N, 3)
        Unit sightlines.
    rotation : ndarray, shape (N, 2)
        From the direction to the camera to the normal, rad in `simtest.estimators.spot_inputs.image_basis`.
    root : ndarray, shape (N, 2, 2)
        Factor L of the rotation's covariance L L^T, rad.

    Returns
    -------
    normals : ndarray, shape (N, 3)
        Unit, camera frame.
    covariances : ndarray, shape (N, 2, 2)
        rad^2 in `simtest.geometry.vectors.tangent_basis` of the normals.
    """
    normals = normal_of(rays, rotation)
    basis = np.stack(tangent_basis(normals), axis=1)
    steps = [(normal_of(rays, rotation + step) - normals) / STEP for step in STEP * np.eye(2)]
    jacobian = basis @ np.stack(steps, axis=2)
    whole = jacobian @ root
    return normals, np.asarray(whole @ whole.transpose(0, 2, 1))
