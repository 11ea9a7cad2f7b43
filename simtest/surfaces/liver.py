"""A generated liver: a smooth closed level set F = 0 with closed-form gradient and Hessian, seen from outside.

F = smoothmax(B, V) + waves, with B the smooth union of ellipsoids and V the visceral face:

    B_i = (a_i / 2) ((x - c_i)^T A_i (x - c_i) - 1),  a_i the geometric mean of the half extents
    B   = -h log sum_i exp(-B_i / h)
    V   = n . x - offset - |x - offset n|^2 / (2 R)          a hollow of radius R
    D   = e log(exp(B / e) + exp(V / e))
    G   = g log(exp(D / g) + exp(-E / g)),  E like B_i: the fossa, an ellipsoid taken out; G = D without it
    F   = G + sum_j a cos(q_j . x + phi_j)

All are lengths in mm; F < 0 in the tissue.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b

import numpy as np

from simtest.errors import InputError
from simtest.runtime.seeds import Stage, generator
from simtest.surfaces.cutting import face_edges, halve, rough_edges
from simtest.surfaces.model import (
    Array,
    IntArray,
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    implicit_shape_operator,
    pack_points,
)
from simtest.surfaces.poses import MeshProbe, organ_pose
from simtest.surfaces.recipe import LiverFossa, LiverLobe, LiverRecipe

GRID_MM = 1.15
"""Spacing of the marching cubes: about 150,000 triangles at the default sizes."""

MAX_NORMAL_ERROR_DEG = 0.1
"""Largest error of the interpolated normal at an edge's middle that is left as it is, as far as `_SPLITS` go."""

MAX_CELLS = 12_000_000
NEWTON_STEPS = 12
NEWTON_TOLERANCE_MM = 1e-10
MAX_SHIFT_MM = 2.0
"""A solution farther from the mesh's hit than this is another part of the surface: no solution."""

_WAVES = 5
_EVENING_STEPS = 8
_SPLITS = 3


@dataclass(frozen=True)
class _Value:
    """A function with its gradient and Hessian: shapes (N,), (N, 3), (N, 3, 3), or (0, 3, 3) where it is not wanted."""

    f: Array
    gradient: Array
    hessian: Array


def _soft_max(parts: list[_Value], width: float) -> _Value:
    """Give width log sum exp(part / width) with its derivatives; a negative width gives the smooth minimum."""
    values = np.stack([part.f for part in parts]) / width
    top = values.max(axis=0)
    weights = np.exp(values - top)
    total = weights.sum(axis=0)
    weights /= total
    gradient = sum((w[:, None] * part.gradient for w, part in zip(weights, parts, strict=True)), np.zeros(()))
    if not len(parts[0].hessian):
        return _Value(width * (top + np.log(total)), gradient, _UNWANTED)
    hessian = -_outer(gradient) / width
    for w, part in zip(weights, parts, strict=True):
        hessian = hessian + w[:, None, None] * (part.hessian + _outer(part.gradient) / width)
    return _Value(width * (top + np.log(total)), gradient, hessian)


_UNWANTED = np.empty((0, 3, 3))


def _outer(vectors: Array) -> Array:
    return vectors[:, :, None] * vectors[:, None, :]


class Body:
    """The level-set function of a recipe.

    Parameters
    ----------
    recipe : LiverRecipe
    """

    def __init__(self, recipe: LiverRecipe) -> None:
        self.recipe = recipe
        self._lobes = [_lobe(lobe) for lobe in recipe.lobes]
        self._fossa = _lobe(recipe.fossa) if recipe.fossa else None
        normal = np.array(recipe.visceral_normal)
        self._normal = normal / np.linalg.norm(normal)
        # Stage.SWEEP: the shape is part of the case, not of a realisation's rendering or noise.
        rng = generator(recipe.seed, "anatomy", "liver", 0, Stage.SWEEP)
        directions = rng.normal(size=(_WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        lengths = recipe.relief_length_mm * rng.uniform(0.8, 1.25, size=_WAVES)
        self._waves = 2 * math.pi / lengths[:, None] * directions
        self._phases = rng.uniform(0, 2 * math.pi, size=_WAVES)

    def box(self) -> tuple[Array, Array]:
        """Give two opposite corners, mm, of a box that holds the body with a margin."""
        reach = np.array([np.sqrt(np.diagonal(np.linalg.inv(A))) for _, A, _ in self._lobes])
        centres = np.array([centre for centre, _, _ in self._lobes])
        margin = 4.0 + self.recipe.blend_mm * math.log(len(self._lobes) + 1) + 2 * _WAVES * self.recipe.relief_mm
        return (centres - reach).min(axis=0) - margin, (centres + reach).max(axis=0) + margin

    def normals(self, points: Array) -> Array:
        """Give the unit outward normals of the level sets through points, shape (N, 3)."""
        gradient = self.evaluate(points, second=False).gradient
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))

    def values(self, points: Array) -> Array:
        """Give F, mm, at points of shape (N, 3): the formula alone, for large grids."""
        blend, edge = self.recipe.blend_mm, self.recipe.edge_mm
        union = np.full(len(points), -np.inf)
        for centre, A, scale in self._lobes:
            d = points - centre
            union = np.logaddexp(union, -0.5 * scale * (((d @ A) * d).sum(axis=1) - 1) / blend)
        face, _ = self._face(points)
        f = edge * np.logaddexp(-blend * union / edge, face / edge)
        if self._fossa and self.recipe.fossa:
            centre, A, scale = self._fossa
            d = points - centre
            bed = 0.5 * scale * (((d @ A) * d).sum(axis=1) - 1)
            f = self.recipe.fossa.edge_mm * np.logaddexp(*(part / self.recipe.fossa.edge_mm for part in (f, -bed)))
        return f + self.recipe.relief_mm * np.cos(points @ self._waves.T + self._phases).sum(axis=1)

    def evaluate(self, points: Array, second: bool = True) -> _Value:
        """Give F, mm, its gradient, and its Hessian, 1/mm, at points of shape (N, 3); without `second` no Hessian."""
        count = len(points) if second else 0

        def same(matrix: Array) -> Array:
            return np.broadcast_to(matrix, (count, 3, 3))

        def ellipsoid(part: tuple[Array, Array, float], sign: float = 1.0) -> _Value:
            centre, A, scale = part
            d, scale = points - centre, sign * scale
            Ad = d @ A
            return _Value(0.5 * scale * ((Ad * d).sum(axis=1) - 1), scale * Ad, same(scale * A))

        face, gradient = self._face(points)
        lobes = _soft_max([ellipsoid(lobe) for lobe in self._lobes], -self.recipe.blend_mm)
        visceral = _Value(face, gradient, same(-np.eye(3) / self.recipe.visceral_radius_mm))
        body = _soft_max([lobes, visceral], self.recipe.edge_mm)
        if self._fossa and self.recipe.fossa:
            body = _soft_max([body, ellipsoid(self._fossa, -1.0)], self.recipe.fossa.edge_mm)
        angle = points @ self._waves.T + self._phases
        sine, cosine = self.recipe.relief_mm * np.sin(angle), self.recipe.relief_mm * np.cos(angle)
        hessian = body.hessian - (cosine[:count, :, None] * self._waves).transpose(0, 2, 1) @ self._waves
        return _Value(body.f + cosine.sum(axis=1), body.gradient - sine @ self._waves, hessian)

    def _face(self, points: Array) -> tuple[Array, Array]:
        """Give V, mm, and its gradient at points of shape (N, 3)."""
        offset, radius = self.recipe.visceral_offset_mm, self.recipe.visceral_radius_mm
        rest = points - offset * self._normal
        return rest @ self._normal - (rest * rest).sum(axis=1) / (2 * radius), self._normal - rest / radius

    def solve(self, origins: Array, directions: Array, distance: Array) -> Array:
        """Solve F(origin + t direction) = 0 by Newton's method from a start close by.

        Parameters
        ----------
        origins, directions : ndarray, shape (N, 3)
            Rays, mm; unit directions.
        distance : ndarray, shape (N,)
            The start, mm.

        Returns
        -------
        ndarray, shape (N,)
            mm; NaN where there is no solution.
        """
        t, found = distance.copy(), np.zeros(len(distance), dtype=bool)
        active = np.flatnonzero(np.isfinite(distance))
        for _ in range(NEWTON_STEPS):
            at = self.evaluate(origins[active] + t[active, None] * directions[active], second=False)
            slope = np.einsum("ni,ni->n", at.gradient, directions[active])
            # A grazing ray has a nearly flat F: bound the step to the mesh's neighbourhood.
            slope = np.where(np.abs(slope) < 1e-6, np.copysign(1e-6, slope), slope)
            step = np.clip(-at.f / slope, -0.5 * MAX_SHIFT_MM, 0.5 * MAX_SHIFT_MM)
            t[active] += step
            done = np.abs(step) < NEWTON_TOLERANCE_MM
            found[active[done]] = True
            active = active[~done & (np.abs(t[active] - distance[active]) <= MAX_SHIFT_MM)]
            if not active.size:
                break
        return np.where(found, t, np.nan)


def _lobe(lobe: LiverLobe | LiverFossa) -> tuple[Array, Array, float]:
    """Give centre, matrix A of the unit level set, 1/mm^2, and scale, mm, of a lobe."""
    angle, axes = math.radians(lobe.turn_deg), np.array(lobe.semi_axes_mm)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    return np.array(lobe.centre_mm), turn @ np.diag(axes**-2.0) @ turn.T, float(np.cbrt(axes.prod()))


@dataclass(frozen=True)
class _Build:
    body: Body
    mesh: TriangleMesh
    key: str

    @cached_property
    def probe(self) -> MeshProbe:
        return MeshProbe(self.mesh)

    def clearance(self, points: Array) -> Array:
        """Give the distance of points, shape (N, 3), to the mesh, mm, with the exact sign of F."""
        return np.where(self.body.values(points) > 0, 1.0, -1.0) * self.probe.distance(points)

    def shape_operators(self) -> Array:
        """Give S at the mesh's vertices by the level set, 1/mm, shape (V, 3, 3)."""
        at = self.body.evaluate(self.mesh.vertices)
        return implicit_shape_operator(at.gradient, at.hessian)[1]


@lru_cache(maxsize=4)
def build(recipe: LiverRecipe, edge_mm: float | None = None) -> _Build:
    """Make the level set and the mesh of a recipe.

    Parameters
    ----------
    recipe : LiverRecipe
    edge_mm : float, optional
        Spacing of the marching cubes and about the length of the edges, mm; default `GRID_MM`. Where the surface bends
        so sharply that normals between the vertices would be wrong by more than `MAX_NORMAL_ERROR_DEG`, the default
        mesh has shorter ones.

    Returns
    -------
    object
        With the fields ``body``, ``mesh`` (mm, normals outward) and ``key``.

    Raises
    ------
    InputError
        If the recipe gives no body, or one too large for the grid.
    """
    body = Body(recipe)
    vertices, faces = _march(body, GRID_MM if edge_mm is None else edge_mm)
    vertices = _even(body, vertices, faces)
    for _ in range(_SPLITS if edge_mm is None else 0):
        vertices, faces = _split(body, vertices, faces)
    normals = body.normals(vertices)
    digest = blake2b(f"{recipe.model_dump_json()} {edge_mm}".encode(), digest_size=12).hexdigest()
    return _Build(body, TriangleMesh(vertices, faces, normals), f"liver-{digest}")


def _march(body: Body, spacing: float) -> tuple[Array, IntArray]:
    """Give vertices, shape (V, 3), and faces, shape (F, 3), outward, of the level set on a grid."""
    from skimage.measure import marching_cubes  # slow to import

    low, high = body.box()
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    cells = math.prod(len(axis) for axis in axes)
    if cells > MAX_CELLS:
        raise InputError(
            f"liver recipe: a grid of {cells} cells of {spacing:g} mm; at most {MAX_CELLS} allowed: make the lobes "
            "smaller or the edges longer"
        )
    slab = np.stack(np.meshgrid(axes[1], axes[2], indexing="ij"), axis=-1).reshape(-1, 2)
    grid = np.empty([len(axis) for axis in axes])
    for row, x in zip(grid, axes[0], strict=True):  # slab by slab: little memory
        row[:] = body.values(np.column_stack([np.full(len(slab), x), slab])).reshape(row.shape)
    if not grid.min() < 0 < grid.max():
        raise InputError("liver recipe: the visceral face leaves nothing of the lobes: raise visceral_offset_mm")
    vertices, faces, _, _ = marching_cubes(grid, 0.0, spacing=(spacing,) * 3, gradient_direction="descent")
    return vertices.astype(np.float64) + low, faces.astype(np.int64)


def _even(body: Body, vertices: Array, faces: IntArray) -> Array:
    """Make the triangles more even: move each vertex to the mean of its neighbours, then back onto F = 0."""
    from scipy.sparse import coo_matrix

    a, b = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()  # a closed mesh has each edge in both directions
    neighbours = coo_matrix((np.ones(len(a)), (a, b)), shape=(len(vertices),) * 2).tocsr()
    neighbours = neighbours.multiply(1.0 / np.asarray(neighbours.sum(axis=1))).tocsr()
    for _ in range(_EVENING_STEPS):
        vertices = _project(body, vertices + 0.5 * (neighbours @ vertices - vertices), 1)
    return _project(body, vertices, 6)


def _split(body: Body, vertices: Array, faces: IntArray) -> tuple[Array, IntArray]:
    """Halve the edges at whose middle the mean of the end normals is off, and cut the triangles that have such."""
    edges, index = face_edges(faces)

    def middles(chosen: IntArray) -> Array:
        return _project(body, vertices[edges[chosen]].mean(axis=1), 3)

    rough = rough_edges(body.normals(vertices), edges, lambda e: body.normals(middles(e)), MAX_NORMAL_ERROR_DEG)
    return np.vstack([vertices, middles(rough)]), halve(faces, index, rough, len(vertices), len(edges))


def _project(body: Body, points: Array, steps: int) -> Array:
    for _ in range(steps):
        at = body.evaluate(points, second=False)
        points = points - (at.f / np.einsum("ni,ni->n", at.gradient, at.gradient))[:, None] * at.gradient
    return points


class Liver(SurfaceModel):
    """A generated liver with a camera outside.

    Parameters
    ----------
    recipe : LiverRecipe
        The sizes. The mesh is cached by recipe.
    viewpoint : int
        Number of the camera pose, >= 0.

    Raises
    ------
    InputError
        If the recipe gives no body.
    """

    def __init__(self, recipe: LiverRecipe, viewpoint: int) -> None:
        self._build = build(recipe)
        probe = self._build.probe
        self.model_from_camera = organ_pose(recipe.type, viewpoint, probe.targets, self._build.clearance, probe.cast)

    def shape(self) -> Shape:
        """Give the closed mesh of even triangles, with exact vertices and normals."""
        return Shape("mesh", False, {}, self._build.mesh, self._build.key)

    def vertex_shape_operators(self) -> Array:
        """Give S at the mesh's vertices by the level set (see `SurfaceModel.vertex_shape_operators`)."""
        return self._build.shape_operators()

    def clearance(self, points: Array) -> Array:
        """Give the signed distance of points, shape (N, 3), model frame, to the surface, mm; positive outside."""
        return self._build.clearance(points)

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Give the exact points where rays meet the smooth surface (see `SurfaceModel.points`).

        Newton's method on F along the ray, to 1e-10 mm, from the mesh's hit; a ray that grazes the mesh but misses
        the smooth surface has no point.
        """
        distance = self._build.body.solve(origins, directions, hits.distance)
        good = np.flatnonzero(np.isfinite(distance))
        normals, operators = np.full((len(origins), 3), np.nan), np.full((len(origins), 3, 3), np.nan)
        at = self._build.body.evaluate(origins[good] + distance[good, None] * directions[good])
        normals[good], operators[good] = implicit_shape_operator(at.gradient, at.hessian)
        return pack_points(origins, directions, distance, normals, operators)
