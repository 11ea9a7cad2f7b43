"""A generated colon, seen from inside: exact points on rays, and the mesh that is rendered."""

import math

import numpy as np
import numpy.typing as npt
from numpy.random import Generator

from simtest.errors import InputError
from simtest.geometry.vectors import unit
from simtest.runtime.arrays import AnyArray, Array, IntArray, Mask, kept
from simtest.surfaces.model import RayHits, TriangleMesh, remembered
from simtest.surfaces.recipe import ColonRecipe
from simtest.surfaces.triangles import (
    MeshedSurface,
    area_vectors,
    face_edges,
    halve,
    off_between,
    rough_edges,
)
from simtest.surfaces.tube import POLYP_EDGE, Tube, TubeChart

TRIANGLES = 200_000
"""Size of the rendered mesh: edges of about 0.4 mm at the default sizes."""

MAX_NORMAL_ERROR_DEG = 0.2
"""Edges with a larger error of the interpolated normal at their middle are halved, up to `_SPLITS` times."""

MAX_STRETCH = 2.0
"""Longest edge, over a cell's side: on a wall stretched by a polyp both ends of an edge may face one way and its middle
another."""

QUARTERED = 0.3
"""On a pedunculated polyp, edges longer than this share of the longest are checked at their quarters too."""

LEAST_FACING = 0.7
"""On a pedunculated polyp, triangles are cut if the cosine between their normal and a corner's is smaller."""

_SPLITS, _BLOCK = 6, 2**14
MAX_TRIANGLES = 5_000_000


class Colon(MeshedSurface):
    """A generated colon, a shell with the camera inside."""

    solid = False

    def __init__(self, mesh: TriangleMesh, key: str, tube: Tube, corners: Array, on_polyp: Mask) -> None:
        super().__init__(mesh, "colon", key)
        self.tube, self.polyps = tube, tube.polyps
        self.corners = corners  # (F, 3, 2): (u, v) of each triangle's corners
        self.on_polyp = on_polyp  # (F,): which triangles may show a polyp

    @property
    def chart(self) -> TubeChart:
        """The tube's parameters on the mesh (see `SurfaceModel.chart`)."""
        return TubeChart(self.tube, self.corners)

    def vertex_shape_operators(self) -> Array:
        """Return S by the tube's formulas (see `SurfaceModel.vertex_shape_operators`)."""
        parameters = np.empty((len(self.mesh.vertices), 2))
        parameters[self.mesh.faces.ravel()] = self.corners.reshape(-1, 2)
        # In blocks: the temporaries of a whole mesh are many times as large.
        blocks = np.split(parameters, range(_BLOCK, len(parameters), _BLOCK))
        return np.concatenate([self.form(*block.T)[1] for block in blocks])

    def clearance(self, points: Array) -> Array:
        """Return the signed distance to the wall, mm; positive in the lumen (see `SurfaceModel.clearance`).

        The magnitude is the distance to the mesh. The sign is exact: a slice u = const is the plane through C(u)
        perpendicular to T(u), in which the lumen is the disc below r(u, v).
        """
        u, v, radial = self.tube.slice_of(points)
        return np.where(radial < self.tube.reach(u, v), 1.0, -1.0) * self.probe.distance(points)

    def solved(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, Array, Array]:
        """Solve for distance, u and v by Newton's method from the hits; a ray that only grazes the mesh has none."""
        return self.tube.solve(origins, directions, hits.distance, *self._parameters(hits))

    def polyp_at(self, hits: RayHits) -> npt.NDArray[np.uint8]:
        """Return the polyp that is hit (see `SurfaceModel.polyp_at`)."""
        numbers = np.zeros(len(hits.distance), dtype=np.uint8)
        some = np.flatnonzero(np.isfinite(hits.distance) & self.on_polyp[hits.face])
        numbers[some] = self.tube.polyp_at(*self._parameters(hits.rows(some)))
        return numbers

    def _parameters(self, hits: RayHits) -> Array:
        """Return u and v of hits, interpolated in their triangles, shape (2, N)."""
        return np.einsum("nc,nck->kn", hits.weights, self.corners[hits.face])

    def form(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return normals and S by the tube's formulas (see `MeshedSurface.form`)."""
        return self.tube.normal_and_shape_operator(u, v)

    def sites(self, rng: Generator) -> Array:
        """Draw sites around the middle part of the centreline, shape (N, 3), mm."""
        recipe, count = self.tube.recipe, 32
        u, v = recipe.length_mm * rng.uniform(0.2, 0.8, count), rng.uniform(0, 2 * math.pi, count)
        radial = 0.6 * np.sqrt(rng.random(count)) * self.tube.radius(u, v, second=False).value
        return self.tube.centreline(u) + radial[:, None] * self.tube.frame(u, v)[1]


@remembered
def build(recipe: ColonRecipe, edge_mm: float | None = None) -> Colon:
    """Make the surface and the mesh of a recipe, with normals into the lumen.

    `edge_mm` is the side of the mesh's cells on the bare tube; default about `TRIANGLES` triangles. Raises `InputError`
    if the folds close the lumen, the tube bends into itself, or there would be too many triangles.
    """
    tube, key = Tube(recipe), f"{recipe.model_dump_json()} {edge_mm}"
    arrays = {**kept("colon", key, lambda: _mesh(tube, edge_mm))}
    corners, on_polyp = arrays.pop("corners"), arrays.pop("on_polyp")
    return Colon(TriangleMesh(**arrays), key, tube, corners, on_polyp)


def _mesh(tube: Tube, edge_mm: float | None) -> dict[str, AnyArray]:
    """Make vertices, faces and normals of the mesh, and (u, v) at its triangles' corners (see `build`)."""
    # cells, square on the bare tube
    recipe = tube.recipe
    area = recipe.length_mm * 2 * math.pi * recipe.radius_mm
    cell = math.sqrt(2 * area / TRIANGLES) if edge_mm is None else edge_mm
    low, high = tube.ends
    if (count := 2 * area * (high - low) / recipe.length_mm / cell**2) > MAX_TRIANGLES:
        raise InputError(f"edge_mm = {cell:g}: gives {count:.0f} triangles; at most {MAX_TRIANGLES} are allowed")
    # A regular grid over (u, v), closed around the tube ...
    rows = max(1, round((high - low) / cell))
    columns = max(8, round(2 * math.pi * recipe.radius_mm / cell))
    u, v = np.linspace(low, high, rows + 1), 2 * math.pi / columns * np.arange(columns + 1)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    # Two triangles per cell, counter-clockwise seen from the lumen as P_u x P_v points there.
    di, dj = np.array([[0, 1, 1], [0, 1, 0]]), np.array([[0, 0, 1], [0, 1, 1]])
    row, column = i[:, None, None] + di, j[:, None, None] + dj
    faces = (row * columns + column % columns).reshape(-1, 3)
    parameters = np.stack([g.ravel() for g in np.meshgrid(u, v[:-1], indexing="ij")], axis=1)
    if recipe.closed:
        # The first and the last ring are one vertex each.
        faces = np.clip(faces - (columns - 1), 0, (rows - 1) * columns + 1)
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        parameters = parameters[columns - 1 : 1 - columns]
    # ... is refined until its interpolated normals are good enough.
    vertices, normals = _positions(tube, parameters)
    fresh = 0
    for _ in range(_SPLITS if edge_mm is None else 0):
        before = len(parameters)
        parameters, faces = _split(tube, parameters, faces, (vertices, normals), fresh, MAX_STRETCH * cell)
        if len(parameters) == before:
            break
        added = _positions(tube, parameters[before:])
        vertices, normals = np.vstack([vertices, added[0]]), np.vstack([normals, added[1]])
        fresh = before
    corners = parameters[faces]
    # A corner beyond the seam has v = 2 pi or a little more, while its vertex is that of v = 0.
    turn, pole = corners[:, :, 1], tube.is_pole(corners[:, :, 0])
    last = np.where(pole, -np.inf, turn).max(axis=1, keepdims=True)
    turn = np.where(turn < last - math.pi, turn + 2 * math.pi, turn)
    corners[:, :, 1] = np.where(pole, (turn.sum(axis=1, keepdims=True) - turn) / 2, turn)
    # A triangle of which no corner is near a polyp's edge shows none.
    on_polyp = tube.polyp_at(parameters[:, 0], parameters[:, 1], POLYP_EDGE / 3)[faces].any(axis=1)
    return {"vertices": vertices, "faces": faces, "normals": normals, "corners": corners, "on_polyp": on_polyp}


def _positions(tube: Tube, parameters: Array) -> tuple[Array, Array]:
    """Return positions, mm, and unit normals into the lumen at (u, v), each of shape (N, 3)."""
    positions, along, around = tube.tangents(*parameters.T)
    return positions, unit(np.cross(along, around))


def _split(
    tube: Tube, parameters: Array, faces: IntArray, surface: tuple[Array, Array], fresh: int, longest: float
) -> tuple[Array, IntArray]:
    """Halve edges that are too long, or at whose middle the mean of the end normals is wrong: on polyps.

    The shipped colon has none. `surface` holds positions and normals at the vertices; edges between vertices before
    `fresh` have been checked already.
    """
    positions, at_ends = surface
    # Only faces with a new vertex can be cut, and those beside them.
    near = np.zeros(len(parameters), dtype=bool)
    near[faces[(faces >= fresh).any(axis=1)]] = True
    active: Mask = np.asarray(near[faces].any(axis=1))
    some = faces[active]
    edges, index = face_edges(some)

    def between(chosen: IntArray, share: float = 0.5) -> Array:
        (u0, v0), (u1, v1) = parameters[edges[chosen]].transpose(1, 2, 0)
        v0, v1 = np.where(tube.is_pole(u0), v1, v0), np.where(tube.is_pole(u1), v0, v1)
        # The short way around, across the seam too.
        step = np.remainder(v1 - v0 + math.pi, 2 * math.pi) - math.pi
        return np.stack([u0 + share * (u1 - u0), np.remainder(v0 + share * step, 2 * math.pi)], axis=1)

    def normals(chosen: IntArray, share: float = 0.5) -> Array:
        return _positions(tube, between(chosen, share))[1]

    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    new = np.flatnonzero(edges[:, 1] >= fresh)  # the second end is the later one
    bent = rough_edges(at_ends, edges[new], lambda chosen: normals(new[chosen]), MAX_NORMAL_ERROR_DEG)
    rough = [np.flatnonzero(length > longest), new[bent]]
    if tube.has_stalks:
        # A stretched edge may be bent both ways, which its middle alone does not show: its quarters count too.
        moved = near.copy()
        moved[near] = tube.moved_by_stalks(positions[near])
        stretched = new[(length[new] > QUARTERED * longest) & moved[edges[new]].any(axis=1)]
        for share in (0.25, 0.75):
            off = off_between(at_ends[edges[stretched]], normals(stretched, share), share, MAX_NORMAL_ERROR_DEG)
            rough.append(stretched[off])
        # A thin triangle may face away from the lumen: its longest edge is halved.
        turned = np.flatnonzero(_facing(positions, at_ends, some) < LEAST_FACING)
        rough.append(index[turned, length[index[turned]].argmax(axis=1)])
    chosen = np.unique(np.concatenate(rough))
    # Whole faces come first, in the order of all.
    whole = ~np.isin(index, chosen).any(axis=1)
    cut = halve(some, index, chosen, len(parameters), len(edges))[np.count_nonzero(whole) :]
    kept = ~active
    kept[active] = whole
    return np.vstack([parameters, between(chosen)]), np.concatenate([faces[kept], cut])


def _facing(positions: Array, normals: Array, faces: IntArray) -> Array:
    """Return the least cosine between a triangle's normal and those at its corners, shape (F,)."""
    cross = unit(area_vectors(positions, faces))
    return np.asarray(np.einsum("ni,nci->nc", cross, normals[faces]).min(axis=1))
