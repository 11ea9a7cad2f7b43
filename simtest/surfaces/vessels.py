"""Vessels of tissue: trees on a surface, whose radii obey Murray's law [M26].

Arteries and veins are two forests, grown apart. Each grows in stages:

1. Nodes spread over the surface, joined to their neighbours by edges of random cost (first-passage percolation).
2. Every node is joined to the trunk that is cheapest to reach. Edges that carry many twigs get cheaper, and the trees
   are grown again: flow gathers in trunks, as in rivers.
3. Twigs that do not lead to one of the evenly spread ends are pruned, and paths are straightened.
4. Radii: every end has the smallest calibre, and r_parent^3 = sum of r_child^3.

[M26] C. D. Murray, "The physiological principle of minimum work. I", Proc. Natl. Acad. Sci. 12 (1926) 207.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from simtest.geometry.vectors import dot, first_of_each, projector, unit
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.spec.reflectance import Vessels
from simtest.surfaces.analytic import QUADRIC_REACH, Cylinder, Plane, Quadric, Sphere
from simtest.surfaces.model import SurfaceModel, TriangleMesh, remembered
from simtest.surfaces.triangles import area_vectors

PRIMES = (73856093, 19349663, 83492791)
"""Factors of the hash of a cell's three numbers (Teschner et al. 2003)."""

LOAD = 0.5
"""Entries of lists over slots, at most: then few cells share a slot."""

SEGMENTS = 2**12
"""Segments that are sorted together: they bound the memory."""

MARGIN_MM = 0.02
"""Rounding of a point in single precision, and how far a mesh lies beside its smooth surface."""

CELL_PER_WIDTH = 3.0
"""Side of a cell over the median half-width of what is seen of a vessel."""

LEAST_CHORD = 1e-9
"""mm: below, nothing is seen."""

STEPS = 4
"""Points of a segment whose distance to a cell is taken."""

ENDLESS = 1e9
"""mm: farther than any point of a surface."""

SLACK = 0.5
"""How far a surface may leave the tangent plane of a vessel within its reach, over that reach."""


@dataclass(frozen=True)
class SegmentTable:
    """Segments by the cell in which they are seen."""

    cell_mm: float  # Side of a cell
    # (slots + 1,): where each slot's list starts in `listed`; the number of slots is a power of two
    first: npt.NDArray[np.uint32]
    listed: npt.NDArray[np.uint32]  # (R,): the segments of the lists, by their number
    # (S, 8): of each segment start (3), half-width that is seen, end minus start (3), peak of the chord, mm; the last
    # is negative for a vein
    rows: npt.NDArray[np.float32]
    # (3,): along each axis of the model, how far from its origin the segments reach; beyond, they are mirrored over
    # and over. `ENDLESS` where they are not
    half_mm: Array = field(default_factory=lambda: np.full(3, ENDLESS))

    @property
    def mask(self) -> int:
        """What of a hash is the slot."""
        return len(self.first) - 2

    def mirrored(self, points: Array) -> Array:
        """Return the points among the segments that stand for points, shape (N, 3), mm."""
        number = np.round(points / (2 * self.half_mm))
        return np.asarray((points - 2 * number * self.half_mm) * np.where(number % 2, -1.0, 1.0))

    def slots(self, points: Array) -> IntArray:
        """Return the slots of points, shape (N, 3), mm."""
        return _hash(np.floor(points / self.cell_mm).astype(np.int64)) & self.mask

    def chords(self, points: Array) -> Array:
        """Return the longest chords, mm, through arteries and veins below points, mm; shape (N, 2)."""
        return self.seen(points)[0]

    def seen(self, points: Array) -> tuple[Array, Array]:
        """Return the chords of `chords`, and the mean depths, mm, of all vessels there by their chords, (N, 2)."""
        points = self.mirrored(points)
        slot = self.slots(points)
        first, last = self.first[slot], self.first[slot + 1]
        longest, weight, deep = np.zeros((3, len(points), 2))
        active = np.flatnonzero(last > first)
        row = first.astype(np.int64)
        while len(active):
            rows = self.rows[self.listed[row[active]]].astype(np.float64)
            chord, vein = _chord(points[active], rows)
            longest[active, vein] = np.maximum(longest[active, vein], chord)
            weight[active, vein] += chord
            deep[active, vein] += chord * seen_depth(rows[:, 3], np.abs(rows[:, 7]))
            row[active] += 1
            active = active[row[active] < last[active]]
        return longest, deep / np.maximum(weight, LEAST_CHORD)


NO_VESSELS = SegmentTable(
    1.0, np.zeros(3, dtype=np.uint32), np.zeros(1, dtype=np.uint32), np.zeros((1, 8), dtype=np.float32)
)
"""The table of a surface without vessels."""


def _chord(points: Array, rows: Array) -> tuple[Array, IntArray]:
    """Return the chord through one segment below each point, and 1 for a vein."""
    start, width, along, peak = rows[:, :3], rows[:, 3], rows[:, 4:7], rows[:, 7]
    gap = points - start
    t = np.clip(np.sum(gap * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
    squared = np.sum((gap - t[:, None] * along) ** 2, axis=1)
    inside = np.maximum(1 - squared / width**2, 0)
    return np.abs(peak) * inside * np.sqrt(inside), (peak < 0).astype(np.int64)


BLUR_PER_DEPTH = 0.4
"""Standard deviation of the blur of a vessel's edge over its depth."""


def seen_profile(radius: Array, depth_mm: Array | float) -> tuple[Array, Array]:
    """Return half-width R and peak, mm, of the chord L(x) = peak (1 - x^2/R^2)^(3/2) that is seen of a vessel.

    The chord through a cylinder is 2 sqrt(r^2 - x^2): area pi r^2, variance r^2/4. Scattering above it adds the blur's
    variance and leaves the area; this profile has both, is 0 from R on, and has no crease.
    """
    variance = radius**2 / 4 + (BLUR_PER_DEPTH * depth_mm) ** 2
    width = np.sqrt(6 * variance)
    return width, 8 * radius**2 / (3 * width)


def seen_depth(width: Array, peak: Array) -> Array:
    """Return the depth, mm, of the vessels of profiles (`seen_profile`): r^2 = 3 R peak / 8 leaves the blur's part."""
    return np.asarray(np.sqrt(np.maximum(width**2 / 6 - 3 / 32 * width * peak, 0)) / BLUR_PER_DEPTH)


def make_table(segments: "VesselSegments", depth_mm: Array | float, half_mm: Array) -> SegmentTable:
    """Sort segments, each at its depth, mm, into the cells in which they are seen."""
    width, peak = seen_profile(segments.radius, depth_mm)
    if not len(width):
        return NO_VESSELS
    cell_mm = CELL_PER_WIDTH * float(np.median(width))
    parts = [
        _cells(segments, width, cell_mm, slice(start, start + SEGMENTS)) for start in range(0, len(width), SEGMENTS)
    ]
    owner, hashed = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    slots = 1 << max(1, math.ceil(math.log2(len(owner) / LOAD)))
    slot = hashed & np.uint32(slots - 1)
    first = np.zeros(slots + 1, dtype=np.uint32)
    np.cumsum(np.bincount(slot, minlength=slots), out=first[1:], dtype=np.uint32)
    # A stable order by a sort of whole numbers, in place, which takes the least time and memory
    order = slot.astype(np.int64) * len(slot)
    order += np.arange(len(slot))
    order.sort()
    order %= len(slot)
    rows = np.column_stack([segments.start, width, segments.end - segments.start, np.where(segments.vein, -peak, peak)])
    return SegmentTable(cell_mm, first, owner[order].astype(np.uint32), rows.astype(np.float32), half_mm)


def _cells(segments: "VesselSegments", width: Array, cell_mm: float, some: slice) -> tuple[IntArray, IntArray]:
    """Return some segment and the hash of a cell in which it is seen on the surface, of each pair of such."""
    # Lengths are in cells, in single precision: `MARGIN_MM` covers its rounding.
    start, end = segments.start[some] / cell_mm, segments.end[some] / cell_mm
    reach = ((width[some] + MARGIN_MM) / cell_mm)[:, None]
    low = np.floor(np.minimum(start, end) - reach).astype(np.int32)
    size = np.floor(np.maximum(start, end) + reach).astype(np.int32) - low + 1
    count = size.prod(axis=1)
    owner = np.repeat(np.arange(len(count), dtype=np.int32), count)
    index = np.arange(len(owner), dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    # Number of the cell in the segment's box: along z, y and x.
    rest, z = np.divmod(index, size[owner, 2])
    x, y = np.divmod(rest, size[owner, 1])
    steps = (x, y, z)
    near = (low + 0.5 - start).astype(np.float32)
    along, normal = (end - start).astype(np.float32), segments.normal[some].astype(np.float32)
    gap = [near[owner, axis] + steps[axis] for axis in range(3)]
    # Only cells that the surface can pass through, which leaves its tangent plane by less than the slack.
    slack = SLACK * (reach[:, 0] + np.linalg.norm(along, axis=1)) + np.abs(normal).sum(axis=1) / 2
    height = sum(gap[axis] * normal[owner, axis] for axis in range(3))
    kept = np.flatnonzero(np.abs(height) < slack.astype(np.float32)[owner])
    owner, gaps = owner[kept], np.stack([part[kept] for part in gap], axis=1)
    # Only cells that the vessel reaches: the distance from the cell to a few points of the segment, and half of the way
    # between these.
    nearest = np.full(len(owner), np.inf, dtype=np.float32)
    for i in range(STEPS):
        outside = np.maximum(np.abs(gaps - ((i + 0.5) / STEPS) * along[owner]) - 0.5, 0)
        np.minimum(nearest, dot(outside, outside), out=nearest)
    reached = nearest < ((reach[:, 0] + np.linalg.norm(along, axis=1) / (2 * STEPS)) ** 2)[owner]
    owner, kept = owner[reached], kept[reached]
    cell = low[owner] + np.stack([step[kept] for step in steps], axis=1)
    return owner + np.int32(some.start), _hash(cell.astype(np.int64)).astype(np.uint32)


def _hash(cell: IntArray) -> IntArray:
    """Return a number below 2^32 for each cell, shape (N, 3)."""
    parts = [(cell[:, axis] * prime) & 0xFFFFFFFF for axis, prime in enumerate(PRIMES)]
    return parts[0] ^ parts[1] ^ parts[2]


WINDOW = 1.5
"""Half-size of the part of a plane or cylinder that is sampled, over the anchor's distance."""

CANDIDATES = 3.0
"""Points drawn before thinning, per square of the least distance."""

MAX_POINTS = 200_000
"""They bound time and memory; a larger surface gets a wider spacing."""

Draw = Callable[[np.random.Generator, int], tuple[Array, Array]]
"""Draws so many points and unit normals, shape (N, 3), uniformly by area."""


@dataclass(frozen=True)
class PatternPatch:
    """The part of a surface that carries a pattern, model frame."""

    key: str  # Identity: patches of one key are equal
    area: float  # mm^2
    draw: Draw = field(compare=False, repr=False)  # See `Draw`
    # Half-size along each axis, beyond which the pattern is mirrored; `ENDLESS` where the patch is the whole surface
    half_mm: tuple[float, float, float] = (ENDLESS, ENDLESS, ENDLESS)


def surface_patch(surface: SurfaceModel) -> PatternPatch:
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


def _plane(half: float) -> PatternPatch:
    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        points = np.zeros((count, 3))
        points[:, :2] = rng.uniform(-half, half, (count, 2))
        return points, np.tile([0.0, 0.0, 1.0], (count, 1))

    return PatternPatch(f"plane {half!r}", 4 * half**2, draw, (half, half, ENDLESS))


def _sphere(surface: Sphere) -> PatternPatch:
    radius, side = surface.radius, -1.0 if surface.inside else 1.0

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        # Archimedes: the height above the far side is uniform over the area.
        z, angle = rng.uniform(-1.0, 1.0, count), rng.uniform(-np.pi, np.pi, count)
        across = np.sqrt(1 - z**2)
        # The anchor is at +z of the centre seen from outside, and at -z from inside.
        out = np.stack([across * np.cos(angle), across * np.sin(angle), side * z], axis=1)
        return surface.centre + radius * out, side * out

    return PatternPatch(f"sphere {radius!r} {surface.inside}", 4 * math.pi * radius**2, draw)


def _cylinder(surface: Cylinder) -> PatternPatch:
    radius, side = surface.radius, -1.0 if surface.inside else 1.0
    half = WINDOW * max(surface.distance, 2 * radius if surface.inside else 0.0)

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        angle, along = rng.uniform(-np.pi, np.pi, count), rng.uniform(-half, half, count)
        out = np.stack([np.sin(angle), np.zeros(count), side * np.cos(angle)], axis=1)
        return surface.centre + radius * out + along[:, None] * [0.0, 1.0, 0.0], side * out

    key = f"cylinder {radius!r} {half!r} {surface.inside}"
    return PatternPatch(key, 4 * math.pi * half * radius, draw, (ENDLESS, half, ENDLESS))


def _quadric(surface: Quadric) -> PatternPatch:
    half, (k1, k2, _) = QUADRIC_REACH * surface.distance, surface.curvatures
    steepest = math.hypot(1.0, k1 * half, k2 * half)

    def draw(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
        rows: list[Array] = []
        drawn = 0
        # Rejection: the density over the plane below is the slope's secant.
        while drawn < count:
            x, y = rng.uniform(-half, half, (2, 2 * count))
            secant = np.sqrt(1 + (k1 * x) ** 2 + (k2 * y) ** 2)
            kept = rng.uniform(0, steepest, 2 * count) < secant
            rows.append(np.stack([x[kept], y[kept]], axis=1))
            drawn += int(kept.sum())
        return surface.over(*np.concatenate(rows)[:count].T)

    # The area by a midpoint rule.
    side = (np.arange(200) + 0.5) / 100 * half - half
    secant = np.sqrt(1 + (k1 * side[:, None]) ** 2 + (k2 * side[None, :]) ** 2)
    return PatternPatch(f"quadric {k1!r} {k2!r} {half!r}", float(secant.mean()) * 4 * half**2, draw)


@remembered
def _mesh(mesh: TriangleMesh, key: str) -> PatternPatch:
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
        return points, unit(normals)

    return PatternPatch(f"mesh {key}", float(total[-1]), draw)


def spread_points(patch: PatternPatch, distance_mm: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw points, mm, and unit normals, shape (N, 3), no two nearer than a distance, about as dense as that allows."""
    count = max(16, math.ceil(CANDIDATES * patch.area / distance_mm**2))
    points, normals = patch.draw(rng, count)
    kept = first_of_each(points, distance_mm)
    return points[kept], normals[kept]


NODES_PER_SPACING = 2.5
"""Nodes along the distance between neighbouring ends: a twig has a few nodes."""

NEIGHBOURS = 9
"""Nodes that each node is joined to."""

FACING = 0.5
"""Least cosine between the normals of joined nodes: no edge leads through a fold from one side to the other."""

GROWTHS = 3
"""How often trees are grown; before each further time, edges get cheaper by what they carry."""

GATHERING = 0.2
"""Cost of an edge falls with this power of the number of ends that it serves."""

STRAIGHTENING = 2
"""How often nodes of a path move half of the way to the middle of their neighbours."""

PIECES = 2
"""Straight segments from node to node of the curve through them."""

SYSTEMS = 2
"""Arteries and veins."""


@dataclass(frozen=True)
class Forest:
    """Trees of vessels. A vessel of radius `radius[i]` joins node i to its parent; a root is joined to nothing."""

    # position, normal: (N, 3): of the nodes, on the surface, mm, and the surface's unit normals
    position: Array
    normal: Array
    parent: IntArray  # (N,): the node towards the trunk; -1 for a root
    radius: Array  # (N,): mm; that of a root is its trunk's
    vein: Mask  # (N,): whether the node belongs to a vein


@dataclass(frozen=True)
class VesselSegments:
    """Straight pieces of vessels."""

    # start, end: (S, 3): mm
    start: Array
    end: Array
    normal: Array  # (S, 3): of the surface, unit, at the start
    radius: Array  # (S,): mm
    vein: Mask  # (S,)


@remembered
def grow_vessels(patch: PatternPatch, spec: Vessels, seed: int) -> Forest:
    """Grow the vessels of a surface; the last few are cached."""
    # The systems share the surface: the ends of one are farther apart than those of both.
    spacing = spec.spacing_mm * math.sqrt(SYSTEMS)
    # Random dart throwing reaches about 0.7 points per square of the distance.
    least = NODES_PER_SPACING * math.sqrt(0.7 * patch.area / MAX_POINTS)
    if spacing < least:
        warnings.warn(
            f"reflectance.albedo.vessels.spacing_mm: a surface of {patch.area:.0f} mm^2 would need more than "
            f"{MAX_POINTS} points; the vessels stand {least / spacing:.2g} times as far apart",
            stacklevel=2,
        )
        spacing = least
    branches = np.random.SeedSequence(seed).spawn(SYSTEMS)
    parts = [_grow(patch, spec, spacing, np.random.Generator(np.random.SFC64(branch))) for branch in branches]
    # One list of nodes: parents are numbered from its start.
    first = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    position, normal, parent, radius = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    system = np.repeat(np.arange(SYSTEMS), np.diff(first))
    return Forest(position, normal, np.where(parent >= 0, parent + first[system], -1), radius, system == 1)


def _grow(
    patch: PatternPatch, spec: Vessels, spacing: float, rng: np.random.Generator
) -> tuple[Array, Array, IntArray, Array]:
    """Grow one system, whose ends are so far apart, mm; return positions, normals, parents and radii."""
    points, normals = spread_points(patch, spacing / NODES_PER_SPACING, rng)
    ends = first_of_each(points, spacing * 0.8)
    graph = _neighbours(points, normals, spec.tortuosity, rng)
    trees = max(1, round(ends.sum() * (spec.smallest_mm / spec.largest_mm) ** 3))
    parent, order = _trees(graph, _roots(points, trees, rng), ends)
    # What leads to no end goes.
    kept = np.flatnonzero(_carried(parent, order, ends.astype(float)) > 0)
    number = np.full(len(points) + 1, -1)
    number[kept] = np.arange(len(kept))
    rank = np.empty(len(points), dtype=np.int64)
    rank[order] = np.arange(len(order))
    parent = number[parent[kept]]
    order = np.argsort(rank[kept])
    # Each end carries one unit of r^3, so that Murray's law holds at every node.
    has_child = np.zeros(len(kept), dtype=bool)
    has_child[parent[parent >= 0]] = True
    carried = _carried(parent, order, (~has_child).astype(float))
    position, normal = _straightened(points[kept], normals[kept], parent, carried)
    return position, normal, parent, spec.smallest_mm / 2 * np.cbrt(carried)


def _neighbours(
    points: Array, normals: Array, tortuosity: float, rng: np.random.Generator
) -> "scipy.sparse.csr_matrix":
    """Return the costs of edges between neighbouring nodes, a symmetric sparse matrix."""
    distance, other = _nearest(points)
    first, second = np.repeat(np.arange(len(points)), distance.shape[1] - 1), other[:, 1:].ravel()
    low, high = np.minimum(first, second), np.maximum(first, second)
    # Each edge once
    _, once = np.unique(low * len(points) + high, return_index=True)
    low, high, length = low[once], high[once], distance[:, 1:].ravel()[once]
    facing = dot(normals[low], normals[high]) > FACING
    low, high, length = low[facing], high[facing], length[facing]
    cost = length * np.exp(tortuosity * rng.standard_normal(len(length)))
    shape = (len(points), len(points))
    whole = scipy.sparse.coo_matrix(
        (np.concatenate([cost, cost]), (np.concatenate([low, high]), np.concatenate([high, low]))), shape=shape
    )
    return whole.tocsr()


def _nearest(points: Array) -> tuple[Array, IntArray]:
    """Return distances and numbers of each point's nearest ones, itself first, shape (N, K)."""
    # SciPy drops the last axis of one neighbour: a small patch may hold a single node.
    distance, other = scipy.spatial.cKDTree(points).query(points, k=np.arange(1, min(NEIGHBOURS, len(points)) + 1))
    return distance, other


def _roots(points: Array, count: int, rng: np.random.Generator) -> IntArray:
    """Choose nodes that stand far apart, each the best of a few random ones."""
    chosen = [int(rng.integers(len(points)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        some = rng.integers(len(points), size=4)
        chosen.append(int(some[np.argmax(nearest[some])]))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.unique(chosen)


def _trees(graph: "scipy.sparse.csr_matrix", roots: IntArray, ends: Mask) -> tuple[IntArray, IntArray]:
    """Return each node's parent, -1 for roots and what is not reached, and the nodes reached, from the roots on."""
    cost = graph.copy()
    row = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr))
    for growth in range(GROWTHS):
        distance, parent, _ = scipy.sparse.csgraph.dijkstra(
            cost, indices=roots, return_predecessors=True, min_only=True
        )
        parent = np.where(parent >= 0, parent, -1).astype(np.int64)
        order = np.argsort(distance, kind="stable")
        order = order[np.isfinite(distance[order])]
        if growth + 1 < GROWTHS:
            carried = np.maximum(_carried(parent, order, ends.astype(float)), 1.0)
            column = graph.indices
            # The edge from a node to its parent carries what the node does.
            flow = np.where(parent[row] == column, carried[row], np.where(parent[column] == row, carried[column], 1.0))
            cost.data = graph.data * flow**-GATHERING
    return parent, order


def _carried(parent: IntArray, order: IntArray, amount: Array) -> Array:
    """Sum a quantity over each node's subtree; `order` lists parents before their children."""
    total, above = amount.tolist(), parent.tolist()
    for node in reversed(order.tolist()):
        if above[node] >= 0:
            total[above[node]] += total[node]
    return np.array(total)


def main_child(parent: IntArray, carried: Array) -> IntArray:
    """Return each node's child that carries most, -1 at ends."""
    child = np.full(len(parent), -1)
    rising = np.argsort(carried, kind="stable")
    rising = rising[parent[rising] >= 0]
    # The last one written is the largest.
    child[parent[rising]] = rising
    return child


def _straightened(points: Array, normals: Array, parent: IntArray, carried: Array) -> tuple[Array, Array]:
    """Move nodes along the surface towards the middle of their neighbours on the path; return points and normals."""
    S = _shape_operators(points, normals)
    child = main_child(parent, carried)
    inner = np.flatnonzero((parent >= 0) & (child >= 0))
    start, position = points, points.copy()
    normal = normals.copy()
    for _ in range(STRAIGHTENING):
        middle = (position[parent[inner]] + position[child[inner]]) / 2
        moved = (position[inner] + middle) / 2 - start[inner]
        # From where the node was, along its tangent plane, and down by the surface's curvature.
        N = normals[inner]
        along = moved - N * np.sum(N * moved, axis=1, keepdims=True)
        turned = np.einsum("nij,nj->ni", S[inner], along)
        sag = np.sum(along * turned, axis=1, keepdims=True) / 2
        position[inner] = start[inner] + along - N * sag
        normal[inner] = N + turned
    return position, unit(normal)


def _shape_operators(points: Array, normals: Array) -> Array:
    """Fit dN = S dP over each node's neighbours, 1/mm, shape (N, 3, 3)."""
    _, other = _nearest(points)
    gap, turn = points[other[:, 1:]] - points[:, None], normals[other[:, 1:]] - normals[:, None]
    near = np.einsum("nki,ni->nk", normals[other[:, 1:]], normals) > FACING
    gap, turn = gap * near[..., None], turn * near[..., None]
    # Damped along the normal, along which the gaps say nothing.
    moment = np.einsum("nki,nkj->nij", gap, gap)
    scale = np.trace(moment, axis1=1, axis2=2)[:, None, None]
    # A node alone on its side of a thin wall counts as flat.
    scale = np.where(scale > 0, scale, 1.0)
    damped = moment + scale * (normals[:, :, None] * normals[:, None, :] + 1e-6 * np.eye(3))
    S = np.einsum("nki,nkj->nij", turn, gap) @ np.linalg.inv(damped)
    across = projector(normals)
    S = across @ S @ across
    return np.asarray((S + S.transpose(0, 2, 1)) / 2)


def segments(forest: Forest) -> VesselSegments:
    """Cut the curves through the nodes, which are smooth along each path, into straight segments."""
    parent, position, normal = forest.parent, forest.position, forest.normal
    joined = np.flatnonzero(parent >= 0)
    above = parent[joined]
    child = main_child(parent, forest.radius)
    itself = np.arange(len(parent))
    path = position[np.where(child >= 0, child, itself)] - position[np.where(parent >= 0, parent, itself)]
    path /= np.linalg.norm(path, axis=1, keepdims=True) + np.finfo(float).tiny
    gap = position[joined] - position[above]
    length = np.linalg.norm(gap, axis=1, keepdims=True)
    # A branch leaves its parent's path at an angle.
    is_main = (child[above] == joined)[:, None]
    leaving = np.where(is_main, path[above], (path[above] + 2 * gap / length) / 3)
    first = length * _along(leaving, normal[above])
    second = length * _along(path[joined], normal[joined])
    # Cubic Hermite curves whose tangents lie in the surface's tangent planes.
    t = np.linspace(0, 1, PIECES + 1)[:, None, None]
    curve = (
        (2 * t**3 - 3 * t**2 + 1) * position[above]
        + (t**3 - 2 * t**2 + t) * first
        + (3 * t**2 - 2 * t**3) * position[joined]
        + (t**3 - t**2) * second
    )
    normals = unit((1 - t[:-1]) * normal[above] + t[:-1] * normal[joined])
    return VesselSegments(
        curve[:-1].reshape(-1, 3),
        curve[1:].reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(forest.radius[joined], PIECES),
        np.tile(forest.vein[joined], PIECES),
    )


def _along(vector: Array, normal: Array) -> Array:
    """Return the part of vectors along the surface."""
    return np.asarray(vector - normal * np.sum(vector * normal, axis=1, keepdims=True))
