"""Evenly spread random points on a surface: the plane, the quadrics, and meshes."""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.surfaces.analytic import QUADRIC_REACH, Cylinder, Plane, Quadric, Sphere
from simtest.surfaces.mesh_geometry import area_vectors
from simtest.surfaces.model import SurfaceModel, TriangleMesh
from simtest.surfaces.segment_table import ENDLESS

WINDOW = 1.5
"""Half-size of the part of a plane or cylinder that is sampled, over the anchor's distance."""

CANDIDATES = 3.0
"""Points drawn before thinning, per square of the least distance."""

MAX_POINTS = 200_000
"""They bound time and memory; a larger surface gets a wider spacing."""

Draw = Callable[[np.random.Generator, int], tuple[Array, Array]]
"""Draws so many points and unit normals, shape (N, 3), uniformly by area."""


@dataclass(frozen=True)
class Patch:
    """The part of a surface that carries a pattern, model frame.

    Parameters
    ----------
    key : str
        Identity: patches of one key are equal.
    area : float
        mm^2.
    draw : Callable
        See `Draw`.
    half_mm : tuple of float
        Half-size along each axis, beyond which the pattern is mirrored; `ENDLESS` where the patch is the whole surface.
    """

    key: str
    area: float
    draw: Draw = field(compare=False, repr=False)
    half_mm: tuple[float, float, float] = (ENDLESS, ENDLESS, ENDLESS)


def surface_patch(surface: SurfaceModel) -> Patch:
    """Return what to sample of a surface: a window around the anchor of one without end, all of another."""
    if isinstance(surface, Plane):
        return _plane(WINDOW * surface.distance)
    if isinstance(surface, Sphere):
        return _sphere(surface)
    if isinstance(surface, Cylinder):
        return _cylinder(surface)
    if isinstance(surface, Quadric):
        return _quadric(surface)
    shape = surface.shape()
    assert shape.mesh is not None
    return _mesh(shape.mesh, shape.key)


def _plane(half: float) -> Patch:
    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        points = np.zeros((count, 3))
        points[:, :2] = rng.uniform(-half, half, (count, 2))
        return points, np.tile([0.0, 0.0, 1.0], (count, 1))

    return Patch(f"plane {half!r}", 4 * half**2, draw, (half, half, ENDLESS))


def _sphere(surface: Sphere) -> Patch:
    radius, side = surface.radius, -1.0 if surface.inside else 1.0

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        # Archimedes: the height above the far side is uniform over the area.
        z, angle = rng.uniform(-1.0, 1.0, count), rng.uniform(-np.pi, np.pi, count)
        across = np.sqrt(1 - z**2)
        # The anchor is at +z of the centre seen from outside, and at -z from inside.
        out = np.stack([across * np.cos(angle), across * np.sin(angle), side * z], axis=1)
        return surface.centre + radius * out, side * out

    return Patch(f"sphere {radius!r} {surface.inside}", 4 * math.pi * radius**2, draw)


def _cylinder(surface: Cylinder) -> Patch:
    radius, side = surface.radius, -1.0 if surface.inside else 1.0
    half = WINDOW * max(surface.distance, 2 * radius if surface.inside else 0.0)

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        angle, along = rng.uniform(-np.pi, np.pi, count), rng.uniform(-half, half, count)
        out = np.stack([np.sin(angle), np.zeros(count), side * np.cos(angle)], axis=1)
        return surface.centre + radius * out + along[:, None] * [0.0, 1.0, 0.0], side * out

    key = f"cylinder {radius!r} {half!r} {surface.inside}"
    return Patch(key, 4 * math.pi * half * radius, draw, (ENDLESS, half, ENDLESS))


def _quadric(surface: Quadric) -> Patch:
    half, (k1, k2, _) = QUADRIC_REACH * surface.distance, surface.curvatures
    steepest = math.hypot(1.0, k1 * half, k2 * half)

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        rows: list[Array] = []
        found = 0
        # Rejection: the density over the plane below is the slope's secant.
        while found < count:
            x, y = rng.uniform(-half, half, (2, 2 * count))
            secant = np.sqrt(1 + (k1 * x) ** 2 + (k2 * y) ** 2)
            kept = rng.uniform(0, steepest, 2 * count) < secant
            rows.append(np.stack([x[kept], y[kept]], axis=1))
            found += int(kept.sum())
        x, y = np.concatenate(rows)[:count].T
        normal = np.stack([k1 * x, k2 * y, np.ones_like(x)], axis=1)
        points = np.stack([x, y, -(k1 * x**2 + k2 * y**2) / 2], axis=1)
        return points, normal / np.linalg.norm(normal, axis=1, keepdims=True)

    # The area by a midpoint rule.
    side = (np.arange(200) + 0.5) / 100 * half - half
    secant = np.sqrt(1 + (k1 * side[:, None]) ** 2 + (k2 * side[None, :]) ** 2)
    return Patch(f"quadric {k1!r} {k2!r} {half!r}", float(secant.mean()) * 4 * half**2, draw)


def _mesh(mesh: TriangleMesh, key: str) -> Patch:
    areas = np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1) / 2
    total = np.cumsum(areas)

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        face = np.minimum(np.searchsorted(total, rng.uniform(0, total[-1], count)), len(total) - 1)
        # Uniform in a triangle: fold the square.
        first, second = rng.uniform(0, 1, (2, count))
        beyond = first + second > 1
        first, second = np.where(beyond, 1 - first, first), np.where(beyond, 1 - second, second)
        weights = np.stack([1 - first - second, first, second], axis=1)
        corners = mesh.faces[face]
        points = np.einsum("nc,nci->ni", weights, mesh.vertices[corners])
        normals = np.einsum("nc,nci->ni", weights, mesh.normals[corners])
        return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)

    return Patch(f"mesh {key}", float(total[-1]), draw)


def spread_points(patch: Patch, distance_mm: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw points no two of which are nearer than a distance, about as dense as that allows.

    Returns points, mm, and unit normals, shape (N, 3). The distance is wider, with a warning, where there would be more
    than `MAX_POINTS`.
    """
    # Random dart throwing reaches about 0.7 points per square of the distance.
    least = math.sqrt(0.7 * patch.area / MAX_POINTS)
    if distance_mm < least:
        warnings.warn(
            f"reflectance.albedo.vessels.spacing_mm: a surface of {patch.area:.0f} mm^2 would need more than "
            f"{MAX_POINTS} points; the vessels stand {least / distance_mm:.2g} times as far apart",
            stacklevel=2,
        )
        distance_mm = least
    count = max(16, math.ceil(CANDIDATES * patch.area / distance_mm**2))
    points, normals = patch.draw(rng, count)
    kept = thinned(points, distance_mm)
    return points[kept], normals[kept]


def thinned(points: Array, distance: float) -> Mask:
    """Return which points, shape (N, 3), to keep so that no two are nearer than a distance; earlier points win."""
    pairs = cKDTree(points).query_pairs(distance, output_type="ndarray")
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    kept, undecided = np.zeros(len(points), dtype=bool), np.ones(len(points), dtype=bool)
    while len(first):
        # A point without an earlier undecided neighbour stays; its neighbours go.
        beaten = np.zeros(len(points), dtype=bool)
        beaten[second] = True
        stays = undecided & ~beaten
        kept |= stays
        undecided &= ~stays
        undecided[_partners(first, second, stays)] = False
        live = undecided[first] & undecided[second]
        first, second = first[live], second[live]
    return kept | undecided


def _partners(first: IntArray, second: IntArray, chosen: Mask) -> IntArray:
    """Return the later partners of chosen points."""
    return second[chosen[first]]
