"""Rays, normals and radiance computed from docs/concepts/theory.md: laws share no code with what they watch."""

import math
from typing import Any

import numpy as np

from simtest.runtime.arrays import Array

CAMERA: dict[str, Any] = {"width": 160, "height": 128, "fx": 150.0, "fy": 150.0, "cx": 83.0, "cy": 61.0}
"""Camera of the rendered laws."""

FINE = {name: 3 * value for name, value in CAMERA.items()}
"""The same view in three times as many pixels, where smoothing would spoil the smaller one."""


def sightlines() -> Array:
    """Compute the camera's unit sightlines through its pixels' centres, shape (H, W, 3)."""
    x, y = np.meshgrid(np.arange(CAMERA["width"]) + 0.5, np.arange(CAMERA["height"]) + 0.5)
    rays = np.stack([(x - CAMERA["cx"]) / CAMERA["fx"], (y - CAMERA["cy"]) / CAMERA["fy"], np.ones_like(x)], axis=-1)
    return np.asarray(rays / np.sqrt((rays**2).sum(axis=-1, keepdims=True)))


def anchor_normal(tilt_deg: float, azimuth_deg: float) -> Array:
    """Compute (0, 0, -1) tilted towards an azimuth, shape (3,)."""
    tilt, azimuth = tilt_deg * math.pi / 180, azimuth_deg * math.pi / 180
    across = math.sin(tilt)
    return np.array([across * math.cos(azimuth), across * math.sin(azimuth), -math.cos(tilt)])


def plane_points(normal: Array, distance_mm: float) -> Array:
    """Intersect the sightlines with the plane through (0, 0, d), shape (H, W, 3), mm."""
    rays = sightlines()
    return rays * (distance_mm * normal[2] / (rays @ normal))[..., None]


def phong_radiance(points: Array, normal: Array, light: Array, exponent: float) -> Array:
    """Compute the radiance of a Phong plane under a light of power 1: cos^n(beta) over the squared distance."""
    to_light = light - points
    squared = (to_light**2).sum(axis=-1)
    to_light = to_light / np.sqrt(squared)[..., None]
    to_camera = -points / np.sqrt((points**2).sum(axis=-1, keepdims=True))
    mirrored = 2 * (to_light @ normal)[..., None] * normal - to_light
    return np.asarray(np.maximum((mirrored * to_camera).sum(axis=-1), 0) ** exponent / squared)


def highlight_of_plane(normal: Array, distance_mm: float, light: Array) -> Array:
    """Find the point of the plane through (0, 0, d) where its normal bisects light and camera, shape (3,), mm.

    It lies on the line from the light's mirror image to the camera.
    """
    anchor = np.array([0.0, 0.0, distance_mm])
    mirrored = light - 2 * ((light - anchor) @ normal) * normal
    return np.asarray(mirrored * ((anchor @ normal) / (mirrored @ normal)))


def angle_deg(first: Array, second: Array) -> Array:
    """Compute the angle between vectors, shape (..., 3), deg."""
    first, second = (v / np.sqrt((v**2).sum(axis=-1, keepdims=True)) for v in (first, second))
    gap = np.sqrt(((first - second) ** 2).sum(axis=-1))
    return np.asarray(2 * np.arcsin(np.minimum(gap / 2, 1.0)) * (180 / math.pi))
