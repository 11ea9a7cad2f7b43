"""Cuts triangles at the middles of some of their edges, without gaps to their neighbours."""

import math
from collections.abc import Callable

import numpy as np

from simtest.runtime.arrays import Array, IntArray, Mask


def cut_faces(faces: IntArray, middles: IntArray) -> IntArray:
    """Cut each triangle into 1 to 4, by how many of its edges have a new vertex; the winding is kept.

    `middles`, of the shape (F, 3) of `faces`, holds the new vertex on the edge from each corner to the next; -1 for
    none.
    """
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
    between = (1 - share) * ends[:, 0] + share * ends[:, 1]
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    # By the chord, which grows with the angle up to 180 deg; a sine would fall again beyond 90.
    return np.asarray(np.linalg.norm(between - normals, axis=1) > 2 * math.sin(math.radians(limit_deg) / 2))


def halve(faces: IntArray, index: IntArray, chosen: IntArray, first_vertex: int, edge_count: int) -> IntArray:
    """Cut faces at the chosen edges, whose middles are the vertices from `first_vertex` on, in the same order."""
    added = np.full(edge_count, -1, dtype=np.int64)
    added[chosen] = first_vertex + np.arange(len(chosen))
    return cut_faces(faces, added[index])
