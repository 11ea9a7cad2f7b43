"""What the law of reflection says of normals at highlights: a test of a method without truth, and a measurement."""

from dataclasses import dataclass

import numpy as np

from simtest.geometry import Array
from simtest.geometry.vectors import tangent_basis

RELIEF_RAD = 0.18
"""Deviation, along each axis, of the bisector at a highlight from the base's normal: relief, and near misses.

On the validation split of `highlights` the median angle between both is 12.4 deg.
"""

CHI2_95 = -2 * np.log(0.05)


@dataclass(frozen=True)
class Reflection:
    """Bisectors of light and camera at N highlights, against normals that a method states there.

    Parameters
    ----------
    off : ndarray, shape (N, 2)
        Rotations from the normals to the bisectors of the nearest light each, rad, in the normals' tangent bases.
    covariance : ndarray, shape (N, 2, 2)
        Of the base's normal about the bisector, rad^2.
    squared : ndarray, shape (N,)
        Squared Mahalanobis distances between both.
    """

    off: Array
    covariance: Array
    squared: Array

    @property
    def distance(self) -> float:
        """Half of the mean squared distance: 1 where normals and bisectors differ as much as they may."""
        return float(self.squared.mean() / 2)


def reflection(
    normals: Array, covariances: Array, rays: Array, distance_mm: Array, share: Array, lights_mm: Array
) -> Reflection:
    """Compare normals at highlights with the bisectors of light and camera.

    A highlight's fine normal bisects the directions to its light and to the camera; the base's lies within the relief's
    slopes of it.

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
    count = len(normals)
    best = Reflection(np.zeros((count, 2)), np.zeros((count, 2, 2)), np.full(count, np.inf))
    for light in lights_mm:
        near, middle, far = (_bisectors(rays, distance_mm * np.exp(k * share), light) for k in (-1, 0, 1))
        off = _across(basis, normals, middle)
        of_distance = np.einsum("nij,nj->ni", basis, far - near) / 2
        own = RELIEF_RAD**2 * np.eye(2) + of_distance[:, :, None] * of_distance[:, None]
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(covariances + own, off[..., None])[..., 0])
        nearer = squared < best.squared
        best = Reflection(
            np.where(nearer[:, None], off, best.off), np.where(nearer[:, None, None], own, best.covariance),
            np.minimum(squared, best.squared),
        )  # fmt: skip
    return best


def reflected(normals: Array, covariances: Array, seen: Reflection) -> tuple[Array, Array]:
    """Return normals and covariances after the bisectors are taken as measurements of the base's normals.

    The product of both normal distributions. Where they contradict each other, beyond the 95 % ellipse of their
    difference, the covariance grows by as much.
    """
    basis = np.stack(tangent_basis(normals), axis=1)
    gain = covariances @ np.linalg.inv(covariances + seen.covariance)
    turn = np.einsum("nij,nj->ni", gain, seen.off)
    along = np.einsum("ni,nij->nj", turn, basis)
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    made = np.cos(angle) * normals + np.sinc(angle / np.pi) * along
    left = covariances - gain @ covariances
    left *= np.maximum(1.0, seen.squared / CHI2_95)[:, None, None]
    # From one normal's tangent basis to the other's, along the arc between both.
    new = np.stack(tangent_basis(made), axis=1)
    carried = (
        basis
        - (basis @ made[..., None]) @ ((normals + made) / (1 + np.sum(normals * made, axis=1, keepdims=True)))[:, None]
    )
    change = new @ carried.transpose(0, 2, 1)
    return made, np.asarray(change @ left @ change.transpose(0, 2, 1))


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
