"""Camera poses by number: inside a lumen or outside an organ, never in tissue.

The same label and number give the same pose. The surface is passed as callables, so that generated anatomies and a
user's mesh share the two pose functions.
"""

import math
from collections.abc import Callable

import igl
import numpy as np

from simtest.errors import InputError
from simtest.geometry.vectors import tangent_basis
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import Stage, generator
from simtest.surfaces.mesh_geometry import area_vectors
from simtest.surfaces.model import TriangleMesh

MIN_CLEARANCE_MM = 5.0
"""A camera in a lumen keeps this distance from the wall if the lumen is wide enough."""

CLEARANCE_SHARE = 0.6
"""In a narrower lumen: share of the largest clearance found."""

AXIS_RANGE_MM = (10.0, 45.0)
"""Preferred distance along the optical axis to the wall of a lumen: working distances of a colonoscope."""

ORGAN_RANGE_MM = (40.0, 150.0)
"""Distance of a camera outside an organ from the point it looks at."""

ORGAN_TILT_DEG = 25.0
"""Largest angle between the sightline and the normal of the point it looks at."""


_DIRECTIONS = 64
_TARGETS = 64

Generator = np.random.Generator
Clearance = Callable[[Array], Array]
Cast = Callable[[Array, Array], Array]


def nearest_mm(lumen: bool) -> float:
    """Return the distance, mm, from the wall of a lumen or from an organ that chosen viewpoints keep at least."""
    return (AXIS_RANGE_MM if lumen else ORGAN_RANGE_MM)[0]


class MeshProbe:
    """Distances to a triangle mesh and rays against it, for the choice of a pose.

    Parameters
    ----------
    mesh : TriangleMesh
        Its normals face the space of the camera.
    """

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh = mesh
        self._vertices = np.ascontiguousarray(mesh.vertices)
        self._faces = np.ascontiguousarray(mesh.faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def clearance(self, points: Array) -> Array:
        """Return the signed distance of points, shape (N, 3), to the mesh, mm; positive on the camera's side.

        The sign is that of the interpolated vertex normal at the closest point, so an open mesh works too.
        """
        squared, face, closest = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points))
        # The normal at the closest point, interpolated in its triangle
        corners = self._mesh.vertices[self._mesh.faces[face]]
        weights = _barycentric(closest, corners)
        normal = np.einsum("nc,nci->ni", weights, self._mesh.normals[self._mesh.faces[face]])
        side = np.einsum("ni,ni->n", points - closest, normal)
        return np.where(side >= 0, 1.0, -1.0) * np.sqrt(squared)

    def distance(self, points: Array) -> Array:
        """Return the unsigned distance of points, shape (N, 3), to the mesh, mm."""
        squared, _, _ = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points))
        return np.sqrt(squared)

    def cast(self, origins: Array, directions: Array) -> Array:
        """Return the distance along unit rays, shape (N, 3), to the first wall, mm; inf if there is none."""
        face, distance, _ = self._tree.intersect_ray_first(
            self._vertices, self._faces, np.ascontiguousarray(origins), np.ascontiguousarray(directions)
        )
        return np.where(face >= 0, distance, np.inf)

    def targets(self, rng: Generator, count: int) -> tuple[Array, Array]:
        """Draw points of the mesh, even by area, with unit normals of their faces; two arrays of shape (count, 3)."""
        corners = self._mesh.vertices[self._mesh.faces]
        cross = area_vectors(self._mesh.vertices, self._mesh.faces)
        # A face is drawn in proportion to its area, then a point in it by the square-root rule.
        cumulative = np.cumsum(np.linalg.norm(cross, axis=1))
        face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right").clip(max=len(cross) - 1)
        a, b = np.sqrt(rng.random(count)), rng.random(count)
        weights = np.stack([1 - a, a * (1 - b), a * b], axis=1)
        points = np.einsum("nc,nci->ni", weights, corners[face])
        return points, cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True)

    def sites(self, rng: Generator) -> Array:
        """Draw points well inside a lumen, shape (N, 3): between a random point of the wall and the wall opposite."""
        points, normals = self.targets(rng, 16)
        width = self.cast(points + 1e-3 * normals, normals)
        # The middle of a chord is the safest, other shares add variety; an open end has no chord.
        width = np.where(np.isfinite(width), width, 2 * MIN_CLEARANCE_MM)
        shares = np.array([0.25, 0.4, 0.5, 0.6, 0.75])
        sites = points[:, None] + (shares[None, :, None] * width[:, None, None]) * normals[:, None]
        return sites.reshape(-1, 3)


def _barycentric(points: Array, corners: Array) -> Array:
    """Return barycentric weights, shape (N, 3), of points in triangles with corners of shape (N, 3, 3)."""
    a, b, p = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (np.einsum("ni,ni->n", *pair) for pair in ((a, a), (a, b), (b, b)))
    pa, pb = np.einsum("ni,ni->n", p, a), np.einsum("ni,ni->n", p, b)
    determinant = np.maximum(aa * bb - ab * ab, np.finfo(float).tiny)
    second, third = (bb * pa - ab * pb) / determinant, (aa * pb - ab * pa) / determinant
    return np.stack([1 - second - third, second, third], axis=1)


def lumen_pose(
    label: str, viewpoint: int, sites: Callable[[Generator], Array], clearance: Clearance, cast: Cast
) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera inside a lumen.

    The site keeps `MIN_CLEARANCE_MM` or, in a narrow lumen, `CLEARANCE_SHARE` of the largest clearance found. The
    direction is random among those whose axis meets the wall within `AXIS_RANGE_MM`; if there are none, the one
    whose axis meets it closest to that range.

    Parameters
    ----------
    label : str
        Name of the surface; a branch of the seed tree.
    viewpoint : int
        Number of the pose, >= 0.
    sites : callable
        Draws candidates, shape (N, 3), mm.
    clearance : callable
        Signed distance of points to the wall, mm; positive in the lumen.
    cast : callable
        Distance from origins along directions to the wall, mm; inf if there is none.
    """
    rng = generator(0, "viewpoint", label, viewpoint, Stage.VIEWPOINT)
    # site
    candidates = sites(rng)
    room = clearance(candidates)
    if not room.max() > 0:
        raise InputError(f"{label}: viewpoint {viewpoint}: no free place for the camera; kind lumen needs a cavity")
    allowed = np.flatnonzero(room >= min(MIN_CLEARANCE_MM, CLEARANCE_SHARE * float(room.max())))
    # Roomier sites are likelier: those at the limit show little but one patch of wall.
    site = candidates[rng.choice(allowed, p=room[allowed] / room[allowed].sum())]
    # direction
    directions = rng.normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = cast(np.broadcast_to(site, directions.shape), directions)
    low, high = AXIS_RANGE_MM
    outside = np.maximum(np.maximum(low - distance, distance - high), 0.0)
    return _pose(site, directions[int(np.argmin(outside))], rng)  # argmin: the first in range


def organ_pose(
    label: str,
    viewpoint: int,
    targets: Callable[[Generator, int], tuple[Array, Array]],
    clearance: Clearance,
    cast: Cast,
) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera outside an organ, looking at a random point of it.

    The distance is random in `ORGAN_RANGE_MM`, the sightline within `ORGAN_TILT_DEG` of the normal and free of
    obstacles.

    Parameters
    ----------
    label, viewpoint
        See `lumen_pose`.
    targets : callable
        Draws surface points and outward unit normals, two arrays of shape (count, 3).
    clearance : callable
        Signed distance of points to the surface, mm; positive outside.
    cast : callable
        Distance from origins along directions to the surface, mm; inf if there is none.
    """
    rng = generator(0, "viewpoint", label, viewpoint, Stage.VIEWPOINT)
    # candidates
    points, normals = targets(rng, _TARGETS)
    away = _cap(normals, math.radians(ORGAN_TILT_DEG), rng)
    distance = rng.uniform(*ORGAN_RANGE_MM, size=_TARGETS)
    cameras = points + distance[:, None] * away
    # A hit well before the target means that something else is in the way.
    free = (clearance(cameras) > 0) & (cast(cameras, -away) > distance - 0.5)
    if not free.any():
        raise InputError(f"{label}: viewpoint {viewpoint}: no free view of the surface found; kind organ needs one")
    chosen = int(np.argmax(free))  # the first
    return _pose(cameras[chosen], -away[chosen], rng)


def _cap(axes: Array, half_angle: float, rng: Generator) -> Array:
    """Draw directions even in the cap of the half angle, rad, around each of the unit axes, shape (N, 3)."""
    cosine = rng.uniform(math.cos(half_angle), 1.0, size=len(axes))
    around = rng.uniform(0, 2 * math.pi, size=len(axes))
    first, second = tangent_basis(axes)
    side = np.cos(around)[:, None] * first + np.sin(around)[:, None] * second
    return cosine[:, None] * axes + np.sqrt(1 - cosine**2)[:, None] * side


def _pose(site: Array, forward: Array, rng: Generator) -> Array:
    """Return model_from_camera, shape (4, 4), of a camera at a site looking forward, with a random roll."""
    first, second = (vector[0] for vector in tangent_basis(forward[None]))
    roll = rng.uniform(0, 2 * math.pi)
    pose = np.eye(4)
    pose[:3, 0] = math.cos(roll) * first + math.sin(roll) * second
    pose[:3, 1] = math.cos(roll) * second - math.sin(roll) * first
    pose[:3, 2] = forward
    pose[:3, 3] = site
    return pose
