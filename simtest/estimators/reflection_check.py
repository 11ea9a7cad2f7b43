"""Whether normals at highlights agree with the law of reflection: a test of a method that needs no truth."""

import numpy as np

from simtest.geometry import Array
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.fitted import fitted_number

RELIEF_RAD = fitted_number("reflection.relief")


def reflection_distances(
    normals: Array, covariances: Array, rays: Array, distance_mm: Array, share: Array, lights_mm: Array
) -> Array:
    """Return how far normals at highlights lie from the bisectors of light and camera, shape (N,).

    A highlight's fine normal bisects the directions to its light and to the camera; the base's lies within the relief's
    slopes of it. The result is the squared Mahalanobis distance between the base's normal and the bisector, of the
    nearest light each: 2 on average where they differ as much as they may.

    Parameters
    ----------
    normals : ndarray, shape (N, 3)
        Unit normals of the base.
    covariances : ndarray, shape (N, 2, 2)
        In `simtest.geometry.vectors.tangent_basis` of them, rad^2.
    rays : ndarray, shape (N, 3)
        Unit sightlines.
    distance_mm, share : ndarray, shape (N,)
        Distances along them, and deviations of their logarithms.
    lights_mm : ndarray, shape (L, 3)
        Positions, camera frame.
    """
    basis = np.stack(tangent_basis(normals), axis=1)
    nearest = np.full(len(normals), np.inf)
    for light in lights_mm:
        near, middle, far = (_bisectors(rays, distance_mm * np.exp(k * share), light) for k in (-1, 0, 1))
        off = _across(basis, normals, middle)
        of_distance = np.einsum("nij,nj->ni", basis, far - near) / 2
        whole = covariances + RELIEF_RAD**2 * np.eye(2) + of_distance[:, :, None] * of_distance[:, None]
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(whole, off[..., None])[..., 0])
        nearest = np.minimum(nearest, squared)
    return nearest


def _bisectors(rays: Array, distance_mm: Array, light: Array) -> Array:
    """Return the unit bisectors of the directions to a light and to the camera, shape (N, 3)."""
    to_light = light - distance_mm[:, None] * rays
    between = to_light / np.linalg.norm(to_light, axis=1, keepdims=True) - rays
    return np.asarray(between / np.linalg.norm(between, axis=1, keepdims=True))


def _across(basis: Array, normals: Array, others: Array) -> Array:
    """Return the rotations from normals to other directions in their tangent bases, rad, shape (N, 2)."""
    across = np.einsum("nij,nj->ni", basis, others)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.sum(normals * others, axis=1))
    return np.asarray(across * (angle / np.maximum(sine, 1e-12))[:, None])
