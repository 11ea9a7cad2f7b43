"""Frames of a sphere whose truth is known in closed form, and maps of it, for the tests of the dense track."""

import cv2
import numpy as np

from simtest.dataset.scoring.dense.truth import EXCLUDED, FrameTruth, zones
from simtest.geometry import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt

LENSES = {
    "pinhole": Camera(96, 72, 70.0, 70.0, 48.0, 36.0),
    "brown_conrady": Camera(96, 72, 70.0, 72.0, 47.0, 37.0, distortion=BrownConrady(k1=-0.1, p1=0.01)),
    "fisheye": Camera(96, 72, 45.0, 45.0, 48.0, 36.0, distortion=KannalaBrandt(k1=0.02)),
}


def sphere_truth(name="a", camera=LENSES["pinhole"], centre=(3.0, -2.0, 30.0), radius=14.0, eps=2.0, image=None):
    """Return the truth of a sphere seen from outside; the far wall of a sphere around the camera fills the rest."""
    rays = camera.unproject(camera.pixel_centres())
    distance, normal, curvature = hit(rays, np.array(centre), radius)
    wall, wall_normal, wall_curvature = hit(rays, np.array([1.0, 2.0, 5.0]), -60.0)
    inside = np.isfinite(distance)
    distance = np.where(inside, distance, wall)
    normal = np.where(inside[..., None], normal, wall_normal)
    curvature = np.where(inside, curvature, wall_curvature)
    regions = np.zeros(distance.shape, dtype=np.int64)
    y, x = np.mgrid[: camera.height, : camera.width]
    for number, (column, row, size) in enumerate(((50, 30, 5), (20, 50, 3)), start=1):
        regions[(x - column) ** 2 + (y - row) ** 2 <= size**2] = number
    return FrameTruth(
        name=name, camera=camera, normal={"fine": normal, "base": normal},
        curvature={"fine": curvature, "base": curvature}, distance=distance, eps=eps,
        scored=np.isfinite(distance), excluded=dict.fromkeys(EXCLUDED, 0), zone=zones(regions), image=image,
    )  # fmt: skip


def hit(rays, centre, radius):
    """Return distance, normal and curvature of a sphere, of its far side where the radius is negative."""
    along = rays @ centre
    root = along**2 - centre @ centre + radius**2
    with np.errstate(invalid="ignore"):
        distance = along - np.sign(radius) * np.sqrt(root)
    normal = (distance[..., None] * rays - centre) / radius
    return distance, normal, np.full(distance.shape, 1 / radius)


def turned(normal, angle_deg, seed=0):
    """Return normals turned by an angle about random axes across each."""
    axis = np.cross(normal, np.random.default_rng(seed).normal(size=normal.shape))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.radians(angle_deg)
    return np.cos(angle) * normal + np.sin(angle) * np.cross(axis, normal)


def write_png(path, vectors, bits=16, encoding="unit"):
    """Write vectors as a PNG; NaN becomes 0, no answer."""
    largest = 2**bits - 1
    counts = largest * (vectors + 1) / 2
    if encoding == "centred":
        counts = vectors * (2 ** (bits - 1) - 1) + 2 ** (bits - 1)
    if encoding == "positive_z":
        counts[..., 2] = largest * vectors[..., 2]
    counts = np.rint(np.nan_to_num(counts, nan=0.0)).astype(np.uint8 if bits == 8 else np.uint16)
    assert cv2.imwrite(str(path), counts[:, :, ::-1])
