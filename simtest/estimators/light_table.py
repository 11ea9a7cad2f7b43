"""How a light somewhere beside the camera moves the normal from the reversed sightline, over the priors.

The light lies at an offset across the optical axis, in any direction, the surface at a distance along the sightline;
the true normal bisects the directions to both (theory.md section 3, item 1). The sightline's angle from the optical
axis alone changes the distribution of the moves, so a table over that angle holds it.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from simtest.calibration import Distribution
from simtest.estimators.budget import equivalent_covariance
from simtest.geometry import Array

SIDE = 40
"""Shares of the offset, and of the distance, that are combined; fewer would miss the tail of near surfaces."""

ANGLES = np.radians([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 89.0, 105.0, 120.0])
"""Sightline's angles from the optical axis; a fisheye's go beyond 90 deg, where the moves would lie along one line."""

GOLDEN = (np.sqrt(5.0) - 1) / 2
"""Step of the azimuths, as a share of the full circle: neighbours in the list point in different directions."""


@dataclass(frozen=True)
class LightTable:
    """Equivalent variances of the moves over the sightline's angle from the optical axis.

    Parameters
    ----------
    along, across : ndarray, shape (A,)
        Variance towards the optical axis and perpendicular to it, rad^2, at each of `ANGLES`.
    """

    along: Array
    across: Array

    def covariance(self, normal: Array, basis: Array) -> Array:
        """Return the covariance of a reversed sightline, shape (2, 2), rad^2, in a basis of its tangent plane."""
        # Scalars, since NumPy's functions take ten times as long on one number.
        x, y, z = normal.tolist()
        angle = math.atan2(math.hypot(x, y), -z)
        along, across = (float(np.interp(angle, ANGLES, values)) for values in (self.along, self.across))
        # the direction towards the optical axis; on the axis both variances are equal
        u, v = basis[:, 2].tolist()
        square = max(u * u + v * v, 1e-24)
        more = (along - across) / square
        return np.array([[across + more * u * u, more * u * v], [more * u * v, across + more * v * v]])


@lru_cache(maxsize=16)
def light_table(offset: Distribution, distance: Distribution) -> LightTable:
    """Tabulate the moves for priors of a light's offset across the optical axis and of the distance, mm."""
    shares = (np.arange(SIDE) + 0.5) / SIDE
    o, d = (each.ravel() for each in np.meshgrid(offset.quantile(shares), distance.quantile(shares)))
    azimuth = 2 * np.pi * (np.arange(SIDE**2) * GOLDEN % 1.0)
    # Mirrored azimuths make the moves even about the sightline's meridian.
    lights = np.stack([o * np.cos(azimuth), o * np.sin(azimuth), np.zeros(SIDE**2)], axis=1)
    lights = np.concatenate([lights, lights * [1.0, -1.0, 1.0]])
    d = np.concatenate([d, d])
    variances = [np.diag(equivalent_covariance(_moves(angle, lights, d))) for angle in ANGLES.tolist()]
    along, across = np.array(variances).T
    return LightTable(along, across)


def _moves(angle: float, lights: Array, distance: Array) -> Array:
    """Return the moves of the normal at a sightline in the plane y = 0, shape (N, 2): along that plane and across."""
    sightline = np.array([np.sin(angle), 0.0, np.cos(angle)])
    to_light = lights - distance[:, None] * sightline
    normals = to_light / np.linalg.norm(to_light, axis=1)[:, None] - sightline
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    along, across = normals @ [np.cos(angle), 0.0, -np.sin(angle)], normals[:, 1]
    sine = np.hypot(along, across)
    scale = np.where(sine > 0, np.arctan2(sine, -normals @ sightline) / np.maximum(sine, 1e-300), 1.0)
    return np.stack([along, across], axis=1) * scale[:, None]
