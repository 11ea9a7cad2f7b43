"""Mirrors of known shape: where a ball or a plate shows the highlight of a light, and back.

The camera's centre is the origin; lengths are in mm. A mirror's position is known with a covariance. Its three errors
are counted in standard deviations: `z` of shape (3,) moves the mirror by its factor times z, so that z is standard
normal. Both kinds of mirror answer for many views and lights at once.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from simtest.geometry.camera import Camera
from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import Array, Index

NEWTON_STEPS = 8
"""From the start that is used, angles of incidence converge to rounding in at most five."""

LEAST_MM = 1e-12


class Mirrors(Protocol):
    """The mirror of each of V pictures."""

    def __len__(self) -> int:
        """Return the number of pictures."""

    def predict(self, camera: Camera, view: Index, lights: Array, z: Array) -> Array:
        """Return where the highlights of lights lie, px, shape (..., 2); NaN where a picture cannot show one.

        `view` of shape (...) numbers the pictures; `lights`, mm, and `z` have shape (..., 3).
        """

    def reflect(self, camera: Camera, view: Index, pixels: Array) -> tuple[Array, Array]:
        """Return the reflected rays of pixels, shape (..., 2): points, mm, and unit directions, shape (..., 3).

        NaN where the sightline misses the mirror.
        """


@dataclass(frozen=True)
class Balls:
    """A ball in each of V pictures."""

    centres: Array  # (V, 3): mm
    factors: Array  # (V, 3, 3): lower Cholesky factors of the centres' covariances, mm
    radii: Array  # (V,): mm

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self.centres)

    def predict(self, camera: Camera, view: Index, lights: Array, z: Array) -> Array:
        """Return the highlights' pixels (see `Mirrors`)."""
        centres = self.centres[view] + np.einsum("...ij,...j->...i", self.factors[view], z)
        return camera.project(mirror_points(centres, self.radii[view], lights))

    def reflect(self, camera: Camera, view: Index, pixels: Array) -> tuple[Array, Array]:
        """Return the reflected rays (see `Mirrors`)."""
        sightlines, centres, radii = camera.unproject(pixels), self.centres[view], self.radii[view]
        along = np.sum(sightlines * centres, axis=-1)
        square = along**2 - np.sum(centres**2, axis=-1) + radii**2
        depth = along - np.sqrt(np.where(square >= 0, square, np.nan))
        points = depth[..., None] * sightlines
        return points, _reflected(sightlines, (points - centres) / radii[..., None])


def mirror_points(centres: Array, radii: Array, lights: Array) -> Array:
    """Return the points of balls that mirror lights into the camera, shape (..., 3), mm (Alhazen's problem).

    At the point at the angle t from the direction to the camera, seen from the ball's centre, the angle of incidence is
    g(t, d) = t + atan2(R sin t, d - R cos t), with d the camera's distance from the centre. The light's is
    g(phi - t, l), with phi its own angle and l its distance. g rises with t, so Newton's method finds where both agree.
    Centres and lights, shape (..., 3), are in the camera frame.
    """
    d, from_centre = np.linalg.norm(centres, axis=-1), lights - centres
    towards = -centres / d[..., None]
    distance = np.linalg.norm(from_centre, axis=-1)
    beside = from_centre - np.sum(from_centre * towards, axis=-1, keepdims=True) * towards
    length = np.linalg.norm(beside, axis=-1)
    beside = beside / np.maximum(length, LEAST_MM)[..., None]
    phi = np.arctan2(length, np.sum(from_centre * towards, axis=-1))
    t = phi * distance / (distance + d)
    for _ in range(NEWTON_STEPS):
        near, slope = _incidence(t, d, radii)
        far, back = _incidence(phi - t, distance, radii)
        t = np.clip(t - (near - far) / (slope + back), 0.0, phi)
    normals = np.cos(t)[..., None] * towards + np.sin(t)[..., None] * beside
    # A camera or light inside the ball sees nothing of its outside.
    outside = (d > radii) & (distance > radii)
    return np.where(outside[..., None], centres + radii[..., None] * normals, np.nan)


def _incidence(t: Array, d: Array, radii: Array) -> tuple[Array, Array]:
    """Return the angle of incidence g(t, d), rad, and its derivative by t."""
    sine, cosine = radii * np.sin(t), radii * np.cos(t)
    square = d * d - 2 * d * cosine + radii * radii
    return t + np.arctan2(sine, d - cosine), 1 + (d * cosine - radii * radii) / square


@dataclass(frozen=True)
class Plates:
    """A flat plate in each of V pictures: the plane n . x = h."""

    normals: Array  # (V, 3): unit normals that face the camera, n . x < 0 for sightlines x that meet the plate.
    offsets: Array  # (V,): h, mm; negative
    # (V, 3, 3): lower Cholesky factors of the covariance of two turns about the tangent basis, rad, and of h, mm.
    factors: Array

    def __len__(self) -> int:
        """Return the number of pictures."""
        return len(self.normals)

    def _plane(self, view: Index, z: Array) -> tuple[Array, Array]:
        bases = np.array([basis_across(normal) for normal in self.normals])
        moved = np.einsum("...ij,...j->...i", self.factors[view], z)
        normals = self.normals[view] + np.einsum("...k,...ki->...i", moved[..., :2], bases[view])
        normals = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
        return normals, self.offsets[view] + moved[..., 2]

    def predict(self, camera: Camera, view: Index, lights: Array, z: Array) -> Array:
        """Return the highlights' pixels (see `Mirrors`): those of the mirrored lights."""
        normals, offsets = self._plane(view, z)
        beyond = offsets - np.sum(normals * lights, axis=-1)
        mirrored = lights + 2 * beyond[..., None] * normals
        # The light must stand on the camera's side.
        return camera.project(np.where((beyond < 0)[..., None], mirrored, np.nan))

    def reflect(self, camera: Camera, view: Index, pixels: Array) -> tuple[Array, Array]:
        """Return the reflected rays (see `Mirrors`)."""
        sightlines = camera.unproject(pixels)
        normals, offsets = self.normals[view], self.offsets[view]
        facing = np.sum(sightlines * normals, axis=-1)
        depth = offsets / np.where(facing < 0, facing, np.nan)
        return depth[..., None] * sightlines, _reflected(sightlines, normals)


def _reflected(directions: Array, normals: Array) -> Array:
    return np.asarray(directions - 2 * np.sum(directions * normals, axis=-1, keepdims=True) * normals)
