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
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.spec.reflectance import Vessels
from simtest.surfaces.surface_samples import Patch, spread_points, thinned

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
    """Trees of vessels. Node i is joined to its parent by a vessel of radius `radius[i]`; a root is joined to nothing.

    Parameters
    ----------
    position, normal : ndarray, shape (N, 3)
        Of the nodes, on the surface, mm, and the surface's unit normals.
    parent : ndarray of int, shape (N,)
        The node towards the trunk; -1 for a root.
    radius : ndarray, shape (N,)
        mm; that of a root is its trunk's.
    vein : ndarray of bool, shape (N,)
        Whether the node belongs to a vein.
    """

    position: Array
    normal: Array
    parent: IntArray
    radius: Array
    vein: Mask


@dataclass(frozen=True)
class Segments:
    """Straight pieces of vessels.

    Parameters
    ----------
    start, end : ndarray, shape (S, 3)
        mm.
    normal : ndarray, shape (S, 3)
        Of the surface, unit, at the start.
    radius : ndarray, shape (S,)
        mm.
    vein : ndarray of bool, shape (S,)
    """

    start: Array
    end: Array
    normal: Array
    radius: Array
    vein: Mask


@lru_cache(maxsize=4)
def grow_vessels(patch: Patch, spec: Vessels, seed: int) -> Forest:
    """Grow the vessels of a surface; the last few are cached."""
    branches = np.random.SeedSequence(seed).spawn(SYSTEMS)
    parts = [_grow(patch, spec, np.random.Generator(np.random.SFC64(branch))) for branch in branches]
    # One list of nodes: parents are numbered from its start.
    first = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    position, normal, parent, radius = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    system = np.repeat(np.arange(SYSTEMS), np.diff(first))
    return Forest(position, normal, np.where(parent >= 0, parent + first[system], -1), radius, system == 1)


def _grow(patch: Patch, spec: Vessels, rng: np.random.Generator) -> tuple[Array, Array, IntArray, Array]:
    """Grow one system; return positions, normals, parents and radii."""
    # The systems share the surface: the ends of one are farther apart than those of both.
    spacing = spec.spacing_mm * math.sqrt(SYSTEMS)
    points, normals = spread_points(patch, spacing / NODES_PER_SPACING, rng)
    ends = thinned(points, spacing * 0.8)
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


def _neighbours(points: Array, normals: Array, tortuosity: float, rng: np.random.Generator) -> sparse.csr_matrix:
    """Return the costs of edges between neighbouring nodes, a symmetric sparse matrix."""
    distance, other = _nearest(points)
    first, second = np.repeat(np.arange(len(points)), distance.shape[1] - 1), other[:, 1:].ravel()
    low, high = np.minimum(first, second), np.maximum(first, second)
    # Each edge once
    _, once = np.unique(low * len(points) + high, return_index=True)
    low, high, length = low[once], high[once], distance[:, 1:].ravel()[once]
    facing = np.einsum("ni,ni->n", normals[low], normals[high]) > FACING
    low, high, length = low[facing], high[facing], length[facing]
    cost = length * np.exp(tortuosity * rng.standard_normal(len(length)))
    shape = (len(points), len(points))
    whole = sparse.coo_matrix(
        (np.concatenate([cost, cost]), (np.concatenate([low, high]), np.concatenate([high, low]))), shape=shape
    )
    return whole.tocsr()


def _nearest(points: Array) -> tuple[Array, IntArray]:
    """Return distances and numbers of each point's nearest ones, itself first, shape (N, K)."""
    # SciPy drops the last axis of one neighbour: a small patch may hold a single node.
    distance, other = cKDTree(points).query(points, k=np.arange(1, min(NEIGHBOURS, len(points)) + 1))
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


def _trees(graph: sparse.csr_matrix, roots: IntArray, ends: Mask) -> tuple[IntArray, IntArray]:
    """Return each node's parent, -1 for roots and what is not reached, and the nodes reached, from the roots on."""
    cost = graph.copy()
    row = np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr))
    for growth in range(GROWTHS):
        distance, parent, _ = dijkstra(cost, indices=roots, return_predecessors=True, min_only=True)
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


def _carried(parent: IntArray, order: IntArray, own: Array) -> Array:
    """Sum a quantity over each node's subtree; `order` lists parents before their children."""
    total, above = own.tolist(), parent.tolist()
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
    return position, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _shape_operators(points: Array, normals: Array) -> Array:
    """Fit dN = S dP over each node's neighbours, 1/mm, shape (N, 3, 3)."""
    _, other = _nearest(points)
    gap, turn = points[other[:, 1:]] - points[:, None], normals[other[:, 1:]] - normals[:, None]
    near = np.einsum("nki,ni->nk", normals[other[:, 1:]], normals) > FACING
    gap, turn = gap * near[..., None], turn * near[..., None]
    # Damped along the normal, along which the gaps say nothing.
    moment = np.einsum("nki,nkj->nij", gap, gap)
    scale = np.trace(moment, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    damped = moment + scale * (normals[:, :, None] * normals[:, None, :] + 1e-6 * np.eye(3))
    S = np.einsum("nki,nkj->nij", turn, gap) @ np.linalg.inv(damped)
    projector = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    S = projector @ S @ projector
    return np.asarray((S + S.transpose(0, 2, 1)) / 2)


def segments(forest: Forest) -> Segments:
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
    normals = (1 - t[:-1]) * normal[above] + t[:-1] * normal[joined]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return Segments(
        curve[:-1].reshape(-1, 3),
        curve[1:].reshape(-1, 3),
        normals.reshape(-1, 3),
        np.tile(forest.radius[joined], PIECES),
        np.tile(forest.vein[joined], PIECES),
    )


def _along(vector: Array, normal: Array) -> Array:
    """Return the part of vectors along the surface."""
    return np.asarray(vector - normal * np.sum(vector * normal, axis=1, keepdims=True))
