"""Triangle meshes: edges and areas, cuts at edges' middles, and the surfaces that are rendered as such."""

import math
from abc import abstractmethod
from collections.abc import Callable
from copy import copy
from functools import cached_property
from hashlib import blake2b
from typing import Any, Self

import numpy as np
from numpy.random import Generator

from simtest.geometry.vectors import dot, unit
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import weighted_quantile
from simtest.surfaces.model import RayHits, Shape, SurfaceModel, SurfacePoints, TriangleMesh, in_rows, pack_points

MIN_CLEARANCE_MM = 5.0
"""A camera in a lumen keeps this distance from the wall if the lumen is wide enough."""


def face_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges of faces, shape (E, 2), smaller vertex first, and their numbers after each corner, (F, 3)."""
    codes, span = _edge_codes(faces)
    # Each edge once, and for each corner which of them it starts
    unique, index = np.unique(codes, return_inverse=True)
    return np.stack(np.divmod(unique, span), axis=1), index.reshape(-1, 3)


def edge_uses(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges, shape (E, 2), smaller vertex first, and how many faces each belongs to, shape (E,)."""
    codes, span = _edge_codes(faces)
    unique, uses = np.unique(codes, return_counts=True)
    return np.stack(np.divmod(unique, span), axis=1), uses


def _edge_codes(faces: IntArray) -> tuple[IntArray, int]:
    """Return one number for the edge after each corner, shape (3 F,), the same for both directions, and its base."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    span = int(faces.max()) + 1
    return pairs[:, 0] * span + pairs[:, 1], span


def edge_lengths(vertices: Array, faces: IntArray) -> Array:
    """Return the length of each edge of `edge_uses`, mm, shape (E,)."""
    edges, _ = edge_uses(faces)
    return np.asarray(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1))


def area_vectors(vertices: Array, faces: IntArray) -> Array:
    """Return the normals of faces, twice as long as their areas, mm^2, shape (F, 3)."""
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def vertex_areas(vertices: Array, faces: IntArray) -> Array:
    """Return the sum of the adjacent faces' areas at each vertex, in any one unit, shape (V,)."""
    area = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    return np.asarray(np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices)), dtype=float)


def area_quantile(values: Array, vertices: Array, faces: IntArray, share: float) -> float:
    """Return the value that this share of the surface lies below; values at the vertices, shape (V,), NaN ignored."""
    return weighted_quantile(values, vertex_areas(vertices, faces), share)


def isoperimetric_quotient(vertices: Array, faces: IntArray) -> float:
    """Return 36 pi V^2 / A^3 of outward faces, closed by cones from their centroid: 1 for a sphere."""
    centred = vertices - vertices.mean(axis=0)
    cross = area_vectors(centred, faces)
    area = np.linalg.norm(cross, axis=1).sum() / 2
    # Sum of the signed volumes of the cones from the centroid to the faces
    volume = dot(centred[faces][:, 0], cross).sum() / 6
    return float(36 * np.pi * volume**2 / area**3)


def halve(faces: IntArray, index: IntArray, chosen: IntArray, first_vertex: int, edge_count: int) -> IntArray:
    """Cut faces at the chosen edges, whose middles are the vertices from `first_vertex` on, in the same order.

    `index` holds the edges' numbers after each corner (see `face_edges`). Each triangle is cut into 1 to 4, by how many
    of its edges have a new vertex; the winding is kept.
    """
    added = np.full(edge_count, -1, dtype=np.int64)
    added[chosen] = first_vertex + np.arange(len(chosen))
    middles = added[index]
    count = (middles >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    # Rotate the corners of each face: a single halved edge comes first, a single whole edge last.
    first = np.where(count == 1, np.argmax(middles >= 0, axis=1), np.argmin(middles >= 0, axis=1) + 1) % 3
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, order, axis=1).T
    p, q, r = np.take_along_axis(middles, order, axis=1).T  # on ab, bc, ca

    def add(chosen: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        parts.extend(np.stack(triangle, axis=1)[chosen] for triangle in triangles)

    add(count == 1, (a, p, c), (p, b, c))
    add(count == 2, (p, b, q), (a, p, q), (a, q, c))
    add(count == 3, (a, p, r), (p, b, q), (r, q, c), (p, q, r))
    return np.concatenate(parts)


def rough_edges(
    normals: Array, edges: IntArray, middle_normals: Callable[[IntArray], Array], limit_deg: float
) -> IntArray:
    """Return the numbers of the edges, shape (E, 2), at whose middle the mean of the end normals is wrong.

    `normals`, shape (V, 3), are exact at the vertices; `middle_normals` returns exact ones at the middles of edges, by
    their numbers. `limit_deg` is the allowed error.
    """
    limit, ends = math.radians(limit_deg), normals[edges]
    # If the end normals nearly agree nothing between can be far off, which settles most edges.
    tried = np.flatnonzero(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > 10 * limit)
    return np.asarray(tried[off_between(ends[tried], middle_normals(tried), 0.5, limit_deg)])


def off_between(ends: Array, normals: Array, share: float, limit_deg: float) -> Mask:
    """Return where the normal interpolated along an edge is wrong by more than a limit, shape (N,).

    `ends`, shape (N, 2, 3), are the exact unit normals at both ends, `normals`, shape (N, 3), those at a share of the
    way from the first to the second.
    """
    between = unit((1 - share) * ends[:, 0] + share * ends[:, 1])
    # By the chord, which grows with the angle up to 180 deg; a sine would fall again beyond 90.
    return np.asarray(np.linalg.norm(between - normals, axis=1) > 2 * math.sin(math.radians(limit_deg) / 2))


class MeshProbe:
    """Distances to a triangle mesh, whose normals face the space of the camera, and rays against it."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh = mesh
        self._vertices = np.ascontiguousarray(mesh.vertices)
        self._faces = np.ascontiguousarray(mesh.faces)
        import igl  # slow to import

        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def clearance(self, points: Array) -> Array:
        """Return signed distances of points, mm, by the interpolated normal: also of an open mesh."""
        import igl

        squared, face, closest = self._tree.squared_distance(self._vertices, self._faces, np.ascontiguousarray(points))
        # The normal at the closest point, interpolated in its triangle
        corners = self._mesh.vertices[self._mesh.faces[face]]
        weights = igl.barycentric_coordinates(closest, *np.ascontiguousarray(corners.swapaxes(0, 1)))
        normal = np.einsum("nc,nci->ni", weights, self._mesh.normals[self._mesh.faces[face]])
        side = dot(points - closest, normal)
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
        return points, unit(cross[face])

    def sites(self, rng: Generator) -> Array:
        """Draw points well inside a lumen, shape (N, 3): between a random point of the wall and the wall opposite."""
        points, normals = self.targets(rng, 16)
        width = self.cast(points + 1e-3 * normals, normals)
        # The middle of a chord is the safest, other shares add variety; an open end has no chord.
        width = np.where(np.isfinite(width), width, 2 * MIN_CLEARANCE_MM)
        shares = np.array([0.25, 0.4, 0.5, 0.6, 0.75])
        sites = points[:, None] + (shares[None, :, None] * width[:, None, None]) * normals[:, None]
        return sites.reshape(-1, 3)


class MeshedSurface(SurfaceModel):
    """A surface that is rendered as a mesh; it is built once, and copied for each of its poses."""

    def __init__(self, mesh: TriangleMesh, kind: str, key: str) -> None:
        self.mesh = mesh  # mm; normals and winding on the camera's side
        # Identity of recipe or file, and settings
        self.key = f"{kind}-{blake2b(key.encode(), digest_size=12).hexdigest()}"

    @cached_property
    def probe(self) -> MeshProbe:
        """Distances and rays for the choice of a pose."""
        return MeshProbe(self.mesh)

    def posed(self, model_from_camera: Array) -> Self:
        """Return the surface with a camera's pose."""
        surface = copy(self)
        surface.model_from_camera = model_from_camera
        return surface

    def free_mm(self, point: Array) -> float:
        """Return nearly the distance to the mesh, from which the surface differs by far less (see `SurfaceModel`)."""
        return 0.9 * float(self.probe.distance(point[None])[0])

    def sites(self, rng: Generator) -> Array:
        """Draw candidates for a camera in a lumen, shape (N, 3), mm."""
        return self.probe.sites(rng)

    def shape(self) -> Shape:
        """Return the mesh; winding and normals on the camera's side."""
        return Shape("mesh", False, np.eye(4), self.mesh, self.key)

    @abstractmethod
    def vertex_shape_operators(self) -> Array:
        """Return S at the mesh's vertices for its normals, 1/mm, shape (V, 3, 3)."""

    @abstractmethod
    def solved(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Any, ...]:
        """Return distances along rays that hit the mesh, NaN without a solution, and what `form` takes there."""

    @abstractmethod
    def form(self, *place: Any) -> tuple[Array, Array]:
        """Return unit normals and S, 1/mm, at places of the surface."""

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Return how far along rays the surface lies (see `SurfaceModel.distances`)."""
        hit = np.flatnonzero(np.isfinite(hits.distance))
        return in_rows(len(origins), hit, self.solved(origins[hit], directions[hit], hits.rows(hit))[0])[0]

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the points where rays meet the surface (see `SurfaceModel.points`)."""
        hit = np.flatnonzero(np.isfinite(hits.distance))
        distance, *place = self.solved(origins[hit], directions[hit], hits.rows(hit))
        good = np.flatnonzero(np.isfinite(distance))
        form = self.form(*(part[good] for part in place))
        [distance] = in_rows(len(origins), hit, distance)
        return pack_points(origins, directions, distance, *in_rows(len(origins), hit[good], *form))
