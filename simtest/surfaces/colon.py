"""A generated colon, seen from inside: exact points on rays, and the mesh that is rendered."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b

import numpy as np

from simtest.errors import InputError
from simtest.surfaces.cutting import face_edges, halve, off_between, rough_edges
from simtest.surfaces.model import (
    Array,
    IntArray,
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    pack_points,
)
from simtest.surfaces.poses import Generator, MeshProbe, lumen_pose
from simtest.surfaces.recipe import ColonRecipe
from simtest.surfaces.tube import Tube

TRIANGLES = 200_000
"""Size of the rendered mesh: edges of about 0.4 mm at the default sizes."""

MAX_NORMAL_ERROR_DEG = 0.2
"""Largest error of the interpolated normal at an edge's middle that is left as it is, as far as `_SPLITS` go."""

MAX_STRETCH = 2.0
"""Longest edge, over a cell's side: where a polyp stretches the wall, both ends of an edge may look one way and its
middle another."""

QUARTERED = 0.3
"""Of a pedunculated polyp, edges longer than this share of the longest are looked at in their quarters too."""

LEAST_FACING = 0.7
"""Of a pedunculated polyp, triangles whose normal and a corner's have a smaller cosine are cut."""

_SPLITS = 6
MAX_TRIANGLES = 5_000_000


@dataclass(frozen=True)
class _Build:
    """A recipe's surface, its mesh, and (u, v) of each triangle's corners, shape (F, 3, 2)."""

    tube: Tube
    mesh: TriangleMesh
    corners: Array
    key: str

    @cached_property
    def probe(self) -> MeshProbe:
        return MeshProbe(self.mesh)

    def inside(self, points: Array) -> Array:
        """Give the signed distance of points, shape (N, 3), to the wall, mm; positive in the lumen.

        The magnitude is that to the mesh; the sign is exact: a slice u = const is the plane through C(u)
        perpendicular to T(u), in which the lumen is the disc below r(u, v).
        """
        u, v, radial = self.tube.slice_of(points)
        free = (radial < self.tube.radius(u, v).f) & (u >= 0) & (u <= self.tube.recipe.length_mm)
        return np.where(free, 1.0, -1.0) * self.probe.distance(points)

    def shape_operators(self) -> Array:
        """Give S at the mesh's vertices by the tube's formulas, 1/mm, shape (V, 3, 3)."""
        places = np.empty((len(self.mesh.vertices), 2))
        places[self.mesh.faces.ravel()] = self.corners.reshape(-1, 2)
        return self.tube.normal_and_shape_operator(places[:, 0], places[:, 1])[1]


@lru_cache(maxsize=4)
def build(recipe: ColonRecipe, edge_mm: float | None = None) -> _Build:
    """Make the surface and the mesh of a recipe.

    Parameters
    ----------
    recipe : ColonRecipe
    edge_mm : float, optional
        Side of the mesh's cells on the bare tube, mm; default about `TRIANGLES` triangles.

    Returns
    -------
    object
        With the fields ``tube``, ``mesh`` (mm, normals into the lumen), ``corners`` and ``key``.

    Raises
    ------
    InputError
        If the folds close the lumen, the tube bends into itself, or there would be too many triangles.
    """
    tube = Tube(recipe)
    area = recipe.length_mm * 2 * math.pi * recipe.radius_mm
    cell = math.sqrt(2 * area / TRIANGLES) if edge_mm is None else edge_mm
    if (count := 2 * area / cell**2) > MAX_TRIANGLES:
        raise InputError(f"edge_mm = {cell:g}: gives {count:.0f} triangles; at most {MAX_TRIANGLES} are allowed")
    rows = max(1, round(recipe.length_mm / cell))
    columns = max(8, round(2 * math.pi * recipe.radius_mm / cell))
    u, v = np.linspace(0, recipe.length_mm, rows + 1), 2 * math.pi / columns * np.arange(columns + 1)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    # Two triangles a cell, counter-clockwise seen from the lumen as P_u x P_v points there.
    di, dj = np.array([[0, 1, 1], [0, 1, 0]]), np.array([[0, 0, 1], [0, 1, 1]])
    row, column = i[:, None, None] + di, j[:, None, None] + dj
    faces = (row * columns + column % columns).reshape(-1, 3)
    places = np.stack([g.ravel() for g in np.meshgrid(u, v[:-1], indexing="ij")], axis=1)
    vertices, normals = _positions(tube, places)
    fresh = 0
    for _ in range(_SPLITS if edge_mm is None else 0):
        before = len(places)
        places, faces = _split(tube, places, faces, (vertices, normals), fresh, MAX_STRETCH * cell)
        if len(places) == before:
            break
        added = _positions(tube, places[before:])
        vertices, normals = np.vstack([vertices, added[0]]), np.vstack([normals, added[1]])
        fresh = before
    corners = places[faces]
    # A corner beyond the seam has v = 2 pi, or a little more, while its vertex is that of v = 0.
    around = corners[:, :, 1]
    corners[:, :, 1] = np.where(around < around.max(axis=1, keepdims=True) - math.pi, around + 2 * math.pi, around)
    digest = blake2b(f"{recipe.model_dump_json()} {edge_mm}".encode(), digest_size=12).hexdigest()
    return _Build(tube, TriangleMesh(vertices, faces, normals), corners, f"colon-{digest}")


def _positions(tube: Tube, places: Array) -> tuple[Array, Array]:
    """Give positions, mm, and unit normals into the lumen at (u, v), each of shape (N, 3)."""
    positions, along, around = tube.tangents(places[:, 0], places[:, 1])
    normals = np.cross(along, around)
    return positions, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _split(
    tube: Tube, places: Array, faces: IntArray, surface: tuple[Array, Array], fresh: int, longest: float
) -> tuple[Array, IntArray]:
    """Halve edges that are long, or between whose ends the mean of the end normals is off: on polyps.

    The shipped colon has none. `surface` is position and normal at the places; edges between those before `fresh` have
    been looked at already. A stretched edge may be bent both ways, so that its middle alone says nothing, and a thin
    triangle may turn its back on the lumen.
    """
    edges, index = face_edges(faces)
    positions, at_ends = surface

    def between(chosen: IntArray, share: float = 0.5) -> Array:
        (u0, v0), (u1, v1) = places[edges[chosen]].transpose(1, 2, 0)
        # The short way around, across the seam too.
        turn = np.remainder(v1 - v0 + math.pi, 2 * math.pi) - math.pi
        return np.stack([u0 + share * (u1 - u0), np.remainder(v0 + share * turn, 2 * math.pi)], axis=1)

    def normals(chosen: IntArray, share: float = 0.5) -> Array:
        return _positions(tube, between(chosen, share))[1]

    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    new = np.flatnonzero(edges[:, 1] >= fresh)  # the second end is the later one
    bent = rough_edges(at_ends, edges[new], lambda chosen: normals(new[chosen]), MAX_NORMAL_ERROR_DEG)
    rough = [np.flatnonzero(length > longest), new[bent]]
    if tube.has_stalks:
        stretched = new[(length[new] > QUARTERED * longest) & tube.drawn_out(positions)[edges[new]].any(axis=1)]
        for share in (0.25, 0.75):
            off = off_between(at_ends[edges[stretched]], normals(stretched, share), share, MAX_NORMAL_ERROR_DEG)
            rough.append(stretched[off])
        turned = np.flatnonzero(_facing(positions, at_ends, faces) < LEAST_FACING)
        rough.append(index[turned, length[index[turned]].argmax(axis=1)])
    chosen = np.unique(np.concatenate(rough))
    return np.vstack([places, between(chosen)]), halve(faces, index, chosen, len(places), len(edges))


def _facing(positions: Array, normals: Array, faces: IntArray) -> Array:
    """Give the least cosine between a triangle's normal and those at its corners."""
    corners = positions[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cross /= np.linalg.norm(cross, axis=1, keepdims=True)
    return np.asarray(np.einsum("ni,nci->nc", cross, normals[faces]).min(axis=1))


class Colon(SurfaceModel):
    """A generated colon with a camera inside; a shell.

    Parameters
    ----------
    recipe : ColonRecipe
        The sizes. The mesh is cached by recipe.
    viewpoint : int
        Number of the camera pose, >= 0.

    Raises
    ------
    InputError
        If the recipe gives no usable tube.
    """

    solid = False

    def __init__(self, recipe: ColonRecipe, viewpoint: int) -> None:
        self._build = build(recipe)
        self.model_from_camera = lumen_pose(
            recipe.type, viewpoint, self._sites, self._build.inside, self._build.probe.cast
        )

    def _sites(self, rng: Generator) -> Array:
        """Draw sites around the middle part of the centreline, shape (N, 3), mm."""
        recipe, tube, count = self._build.tube.recipe, self._build.tube, 32
        u, v = recipe.length_mm * rng.uniform(0.2, 0.8, count), rng.uniform(0, 2 * math.pi, count)
        radial = 0.6 * np.sqrt(rng.random(count)) * tube.radius(u, v).f
        return tube.centreline(u) + radial[:, None] * tube.frame(u, v)[1]

    def shape(self) -> Shape:
        """Give the mesh of about 200,000 triangles, with exact vertices and normals, open at both ends."""
        return Shape("mesh", False, {}, self._build.mesh, self._build.key)

    def vertex_shape_operators(self) -> Array:
        """Give S at the mesh's vertices by the tube's formulas (see `SurfaceModel.vertex_shape_operators`)."""
        return self._build.shape_operators()

    def clearance(self, points: Array) -> Array:
        """Give the signed distance of points, shape (N, 3), model frame, to the wall, mm; positive in the lumen."""
        return self._build.inside(points)

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Give the exact points where rays meet the smooth surface (see `SurfaceModel.points`).

        Newton's method on P(u, v) = origin + t direction, to 1e-10 mm, from (u, v) of the mesh's hit; a ray that
        grazes the mesh but misses the smooth surface has no point.
        """
        tube, hit = self._build.tube, np.flatnonzero(np.isfinite(hits.distance))
        second, third = hits.barycentric[hit].T
        weights = np.stack([1 - second - third, second, third], axis=1)
        u, v = np.einsum("nc,nck->kn", weights, self._build.corners[hits.face[hit]])
        distance, u, v = tube.solve(origins[hit], directions[hit], hits.distance[hit], u, v)
        good = np.isfinite(distance)
        distances = np.full(len(origins), np.nan)
        normals, operators = np.full((len(origins), 3), np.nan), np.full((len(origins), 3, 3), np.nan)
        distances[hit] = distance
        normals[hit[good]], operators[hit[good]] = tube.normal_and_shape_operator(u[good], v[good])
        return pack_points(origins, directions, distances, normals, operators)
