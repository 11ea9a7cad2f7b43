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
from collections.abc import Callable

import numpy as np

from simtest.errors import InputError
from simtest.geometry.vectors import dot, unit
from simtest.runtime.arrays import Array, IntArray, Mask, kept
from simtest.runtime.seeds import Stage, generator
from simtest.surfaces.jets import Jet
from simtest.surfaces.model import RayHits, TriangleMesh, implicit_shape_operator, outer, remembered
from simtest.surfaces.recipe import LiverLobe, LiverRecipe
from simtest.surfaces.triangles import MeshedSurface, face_edges, halve, rough_edges

SIDE = 4
"""Cells along the side of a block of the grid."""

POINTS = 8192
"""Points that are evaluated together: their temporaries stay in the processor's cache."""

ROUNDING = 1e-9
"""Relative margin of the bound, for rounding."""


def level_grid(values: Callable[[Array], Array], slopes: Callable[[Array, float], Array], axes: list[Array]) -> Array:
    """Return F at the nodes of a grid, exact at the corners of every cell that its zero passes.

    `values` is F at points, shape (N, 3), mm, `slopes` bounds its gradient within a radius, mm, of points. `axes` are
    the nodes' coordinates along x, y and z, mm, evenly spaced. In a block of half diagonal r about c, F has no zero if
    abs(F(c)) > L r, with L a bound on its slope there: such a block gets the value F(c), whose sign is right. The other
    nodes get F itself, so marching cubes find the same triangles as on the whole grid.
    """
    width = SIDE * float(axes[0][1] - axes[0][0])
    middles = [axis[0] + (np.arange(-(-len(axis) // SIDE)) + 0.5) * width for axis in axes]
    centres = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 3)
    radius = width * math.sqrt(3) / 2
    f = in_blocks(values, centres)
    may_cross = np.abs(f) <= in_blocks(lambda some: slopes(some, radius), centres) * radius * (1 + ROUNDING)
    blocks = [len(middle) for middle in middles]
    grid: Array = f.reshape(blocks)
    near: Mask = may_cross.reshape(blocks)
    for axis, nodes in enumerate(axes):
        # From blocks to nodes; some of the last blocks lie beyond the grid.
        inside = range(len(nodes))
        grid, near = np.repeat(grid, SIDE, axis).take(inside, axis), np.repeat(near, SIDE, axis).take(inside, axis)
    # The corners of all cells of the blocks that are left: a block's own nodes, and the next ones along each axis.
    for axis in range(3):
        rolled = np.moveaxis(near, axis, 0)
        rolled[1:] |= rolled[:-1].copy()
    left = np.nonzero(near)
    grid[left] = in_blocks(values, np.stack([axis[i] for axis, i in zip(axes, left, strict=True)], axis=1))
    return grid


def in_blocks(function: Callable[[Array], Array], points: Array) -> Array:
    """Return a function of points, shape (N, 3), computed for some of them at a time."""
    parts = [function(points[start : start + POINTS]) for start in range(0, max(len(points), 1), POINTS)]
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


GRID_MM = 1.15
"""Spacing of the marching cubes: about 150,000 triangles at the default sizes."""

MAX_NORMAL_ERROR_DEG = 0.1
"""Edges with a larger error of the interpolated normal at their middle are halved, up to `_SPLITS` times."""

MAX_CELLS = 12_000_000
NEWTON_STEPS = 12
NEWTON_TOLERANCE_MM = 1e-10
MAX_SHIFT_MM = 2.0
"""A solution farther from the mesh's hit than this is another part of the surface: no solution."""

_WAVES = 5
_EVENING_STEPS = 8
_SPLITS = 3


def _soft_max(parts: list[Jet], width: float) -> Jet:
    """Return width log sum exp(part / width) with its derivatives; a negative width makes it a smooth minimum."""
    # Relative to the largest exponent, so that none overflows.
    values = np.stack([part.value for part in parts]) / width
    top = values.max(axis=0)
    weights = np.exp(values - top)
    total = weights.sum(axis=0)
    weights /= total
    value = width * (top + np.log(total))
    gradient = sum((w[:, None] * part.gradient for w, part in zip(weights, parts, strict=True)), np.zeros(()))
    if len(parts[0].parts) < 3:
        return Jet(value, gradient)
    hessian = -outer(gradient, gradient) / width
    for w, part in zip(weights, parts, strict=True):
        hessian = hessian + w[:, None, None] * (part.hessian + outer(part.gradient, part.gradient) / width)
    return Jet(value, gradient, hessian)


class Body:
    """The level-set function of a recipe."""

    def __init__(self, recipe: LiverRecipe) -> None:
        self.recipe = recipe
        self._lobes = [_lobe(lobe) for lobe in recipe.lobes]
        self._fossa = _lobe(recipe.fossa) if recipe.fossa else None
        normal = np.array(recipe.visceral_normal)
        self._normal = normal / np.linalg.norm(normal)
        # Stage.SWEEP: the shape is part of the case, not of a realisation's rendering or noise.
        rng = generator(recipe.seed, "anatomy", "liver", 0, Stage.SWEEP)
        directions = unit(rng.normal(size=(_WAVES, 3)))
        lengths = recipe.relief_length_mm * rng.uniform(0.8, 1.25, size=_WAVES)
        self._waves = 2 * math.pi / lengths[:, None] * directions
        self._phases = rng.uniform(0, 2 * math.pi, size=_WAVES)

    def box(self) -> tuple[Array, Array]:
        """Return two opposite corners, mm, of a box that holds the body with a margin."""
        reach = np.array([np.sqrt(np.diagonal(np.linalg.inv(A))) for _, A, _ in self._lobes])
        centres = np.array([centre for centre, _, _ in self._lobes])
        waves = _WAVES * self.recipe.relief_mm
        margin = 4.0 + self.recipe.blend_mm * math.log(len(self._lobes) + 1) + 2 * waves
        # F < 0 only where some B_i is below h log n and the waves' height: in an ellipsoid, which is longer than the
        # lobe by more than the margin where that is long and thin.
        above = self.recipe.blend_mm * math.log(len(self._lobes)) + waves
        far = reach * np.sqrt([[1 + 2 * above / scale] for _, _, scale in self._lobes])
        low = np.minimum((centres - reach).min(axis=0) - margin, (centres - far).min(axis=0) - 1.0)
        return low, np.maximum((centres + reach).max(axis=0) + margin, (centres + far).max(axis=0) + 1.0)

    def normals(self, points: Array) -> Array:
        """Return the unit outward normals of the level sets through points, shape (N, 3)."""
        gradient = in_blocks(lambda some: self.evaluate(some, second=False).gradient, points)
        return unit(gradient)

    def values(self, points: Array) -> Array:
        """Return F, mm, at points of shape (N, 3), without derivatives, for large grids."""
        # B, then D with V
        blend, edge = self.recipe.blend_mm, self.recipe.edge_mm
        union = np.full(len(points), -np.inf)
        for lobe in self._lobes:
            union = np.logaddexp(union, -_ellipsoid(points, lobe)[0] / blend)
        face, _ = self._face(points)
        f = edge * np.logaddexp(-blend * union / edge, face / edge)
        # G
        if self._fossa and self.recipe.fossa:
            bed, _ = _ellipsoid(points, self._fossa)
            f = self.recipe.fossa.edge_mm * np.logaddexp(*(part / self.recipe.fossa.edge_mm for part in (f, -bed)))
        return f + self.recipe.relief_mm * np.cos(points @ self._waves.T + self._phases).sum(axis=1)

    def slopes(self, points: Array, radius: float) -> Array:
        """Return upper bounds of the gradient's length within a radius, mm, of points, shape (N, 3).

        Smooth maxima and minima have gradients that are means of their parts'. Those of the ellipsoids and of the face
        are linear in the point.
        """
        rest = self._face(points)[1]
        steepest = np.linalg.norm(rest, axis=1) + radius / self.recipe.visceral_radius_mm
        for lobe in (*self._lobes, *([self._fossa] if self._fossa else [])):
            slope = np.linalg.norm(_ellipsoid(points, lobe)[1], axis=1) + radius * np.linalg.norm(lobe[1], 2)
            steepest = np.maximum(steepest, lobe[2] * slope)
        return np.asarray(steepest + self.recipe.relief_mm * np.linalg.norm(self._waves, axis=1).sum())

    def evaluate(self, points: Array, second: bool = True) -> Jet:
        """Return F, mm, with gradient and, if `second`, Hessian, 1/mm, at points of shape (N, 3)."""

        def quadratic(value: Array, gradient: Array, hessian: Array) -> Jet:
            same = [np.broadcast_to(hessian, (len(points), 3, 3))] if second else []
            return Jet(value, gradient, *same)

        def ellipsoid(part: tuple[Array, Array, float], sign: float = 1.0) -> Jet:
            value, across = _ellipsoid(points, part)
            return quadratic(sign * value, sign * part[2] * across, sign * part[2] * part[1])

        # B, V, D and G of the module's head, then the waves
        lobes = _soft_max([ellipsoid(lobe) for lobe in self._lobes], -self.recipe.blend_mm)
        visceral = quadratic(*self._face(points), -np.eye(3) / self.recipe.visceral_radius_mm)
        body = _soft_max([lobes, visceral], self.recipe.edge_mm)
        if self._fossa and self.recipe.fossa:
            body = _soft_max([body, ellipsoid(self._fossa, -1.0)], self.recipe.fossa.edge_mm)
        angle = points @ self._waves.T + self._phases
        sine, cosine = self.recipe.relief_mm * np.sin(angle), self.recipe.relief_mm * np.cos(angle)
        waves = [cosine.sum(axis=1), -sine @ self._waves]
        if second:
            waves.append(-(cosine[:, :, None] * self._waves).transpose(0, 2, 1) @ self._waves)
        return body + Jet(*waves)

    def _face(self, points: Array) -> tuple[Array, Array]:
        """Return V, mm, and its gradient at points of shape (N, 3)."""
        offset, radius = self.recipe.visceral_offset_mm, self.recipe.visceral_radius_mm
        rest = points - offset * self._normal
        return rest @ self._normal - (rest * rest).sum(axis=1) / (2 * radius), self._normal - rest / radius

    def solve(self, origins: Array, directions: Array, distance: Array) -> Array:
        """Solve F(origin + t direction) = 0 by Newton's method from a `distance` close by; NaN without solution."""
        t, solved = distance.copy(), np.zeros(len(distance), dtype=bool)
        active = np.flatnonzero(np.isfinite(distance))
        for _ in range(NEWTON_STEPS):
            at = self.evaluate(origins[active] + t[active, None] * directions[active], second=False)
            slope = dot(at.gradient, directions[active])
            # On a grazing ray F is nearly flat: bound the step to the mesh's neighbourhood.
            slope = np.where(np.abs(slope) < 1e-6, np.copysign(1e-6, slope), slope)
            # Newton's step along the ray; a ray that leaves the neighbourhood of its hit is given up.
            step = np.clip(-at.value / slope, -0.5 * MAX_SHIFT_MM, 0.5 * MAX_SHIFT_MM)
            t[active] += step
            done = np.abs(step) < NEWTON_TOLERANCE_MM
            solved[active[done]] = True
            active = active[~done & (np.abs(t[active] - distance[active]) <= MAX_SHIFT_MM)]
            if not active.size:
                break
        return np.where(solved, t, np.nan)


def _lobe(lobe: LiverLobe) -> tuple[Array, Array, float]:
    """Return centre, matrix A of the unit level set, 1/mm^2, and scale a, mm, of a lobe."""
    angle, axes = math.radians(lobe.turn_deg), np.array(lobe.semi_axes_mm)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]])
    return np.array(lobe.centre_mm), turn @ np.diag(axes**-2.0) @ turn.T, float(np.cbrt(axes.prod()))


def _ellipsoid(points: Array, lobe: tuple[Array, Array, float]) -> tuple[Array, Array]:
    """Return B_i, mm, of a lobe, and its gradient over a_i, at points of shape (N, 3)."""
    centre, A, scale = lobe
    d = points - centre
    Ad = d @ A
    return 0.5 * scale * ((Ad * d).sum(axis=1) - 1), Ad


class Liver(MeshedSurface):
    """A generated liver with the camera outside."""

    def __init__(self, mesh: TriangleMesh, key: str, body: Body) -> None:
        super().__init__(mesh, "liver", key)
        self.body = body

    def vertex_shape_operators(self) -> Array:
        """Return S by the level set (see `SurfaceModel.vertex_shape_operators`)."""
        return in_blocks(lambda some: self.form(some)[1], self.mesh.vertices)

    def clearance(self, points: Array) -> Array:
        """Return the distance to the mesh, mm, with the exact sign of F (see `SurfaceModel.clearance`)."""
        return np.where(self.body.values(points) > 0, 1.0, -1.0) * self.probe.distance(points)

    def solved(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, Array]:
        """Solve for distance and point by Newton's method on F; a ray that only grazes the mesh has none."""
        distance = self.body.solve(origins, directions, hits.distance)
        return distance, origins + distance[:, None] * directions

    def form(self, points: Array) -> tuple[Array, Array]:
        """Return normals and S of the level sets through points (see `MeshedSurface.form`)."""
        at = self.body.evaluate(points)
        return implicit_shape_operator(at.gradient, at.hessian)


@remembered
def build(recipe: LiverRecipe, edge_mm: float | None = None) -> Liver:
    """Make the level set and the mesh of a recipe; normals outward.

    `edge_mm` is the spacing of the marching cubes and about the length of the edges; default `GRID_MM`, with shorter
    edges where normals between the vertices would be wrong by more than `MAX_NORMAL_ERROR_DEG`. Raises `InputError` if
    the recipe gives no body, or one too large for the grid.
    """
    body, key = Body(recipe), f"{recipe.model_dump_json()} {edge_mm}"
    arrays = kept("liver", key, lambda: vars(_mesh(body, edge_mm)))
    return Liver(TriangleMesh(**arrays), key, body)


def _mesh(body: Body, edge_mm: float | None) -> TriangleMesh:
    """Make the mesh of a level set (see `build`)."""
    # marching cubes, made even, then split where the surface bends sharply
    vertices, faces = _march(body, GRID_MM if edge_mm is None else edge_mm)
    vertices = _even(body, vertices, faces)
    for _ in range(_SPLITS if edge_mm is None else 0):
        vertices, faces = _split(body, vertices, faces)
    return TriangleMesh(vertices, faces, body.normals(vertices))


def _march(body: Body, spacing: float) -> tuple[Array, IntArray]:
    """Return vertices, shape (V, 3), and outward faces, shape (F, 3), of the level set on a grid."""
    from skimage.measure import marching_cubes  # slow to import

    low, high = body.box()
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    cells = math.prod(len(axis) for axis in axes)
    if cells > MAX_CELLS:
        raise InputError(
            f"liver recipe: a grid of {cells} cells of {spacing:g} mm; at most {MAX_CELLS} allowed: make the lobes "
            "smaller or the edges longer"
        )
    grid = level_grid(body.values, body.slopes, axes)
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
    """Halve the edges at whose middle the mean of the end normals is wrong, and cut their triangles."""
    edges, index = face_edges(faces)

    def middles(chosen: IntArray) -> Array:
        return _project(body, vertices[edges[chosen]].mean(axis=1), 3)

    rough = rough_edges(body.normals(vertices), edges, lambda e: body.normals(middles(e)), MAX_NORMAL_ERROR_DEG)
    return np.vstack([vertices, middles(rough)]), halve(faces, index, rough, len(vertices), len(edges))


def _project(body: Body, points: Array, steps: int) -> Array:
    """Move points along the gradient onto F = 0, by steps of Newton's method."""

    def moved(points: Array) -> Array:
        for _ in range(steps):
            at = body.evaluate(points, second=False)
            points = points - (at.value / dot(at.gradient, at.gradient))[:, None] * at.gradient
        return points

    return in_blocks(moved, points)
