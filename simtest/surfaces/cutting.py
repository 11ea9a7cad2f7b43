"""Cutting triangles at the middles of some of their edges, without a gap to their neighbours."""

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from simtest.surfaces.model import Array, IntArray


def face_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Give each edge a number.

    Parameters
    ----------
    faces : ndarray of int, shape (F, 3)

    Returns
    -------
    edges : ndarray of int, shape (E, 2)
        Vertices of each edge, the smaller first.
    index : ndarray of int, shape (F, 3)
        Number of the edge from each corner of a face to the next.
    """
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    span = int(faces.max()) + 1
    codes, index = np.unique(pairs[:, 0] * span + pairs[:, 1], return_inverse=True)
    return np.stack(np.divmod(codes, span), axis=1), index.reshape(-1, 3)


def cut_faces(faces: IntArray, middles: IntArray) -> IntArray:
    """Cut each triangle into 1 to 4, by how many of its edges have a new vertex.

    Parameters
    ----------
    faces : ndarray of int, shape (F, 3)
    middles : ndarray of int, shape (F, 3)
        New vertex on the edge from each corner to the next; -1: none.

    Returns
    -------
    ndarray of int, shape (F', 3)
        The winding is kept.
    """
    count = (middles >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    # Turn each face so that its pattern stands first: the one halved edge, or the one that is whole last.
    first = np.where(count == 1, np.argmax(middles >= 0, axis=1), np.argmin(middles >= 0, axis=1) + 1) % 3
    turn = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(faces, turn, axis=1).T
    p, q, r = np.take_along_axis(middles, turn, axis=1).T  # on ab, bc, ca

    def add(chosen: IntArray, *triangles: tuple[IntArray, IntArray, IntArray]) -> None:
        parts.extend(np.stack(triangle, axis=1)[chosen] for triangle in triangles)

    add(count == 1, (a, p, c), (p, b, c))
    add(count == 2, (p, b, q), (a, p, q), (a, q, c))
    add(count == 3, (a, p, r), (p, b, q), (r, q, c), (p, q, r))
    return np.concatenate(parts)


def rough_edges(
    normals: Array, edges: IntArray, middle_normals: Callable[[IntArray], Array], limit_deg: float
) -> IntArray:
    """Find the edges at whose middle the mean of the end normals is off.

    Parameters
    ----------
    normals : ndarray, shape (V, 3)
        Exact unit normals at the vertices.
    edges : ndarray of int, shape (E, 2)
    middle_normals : callable
        Gives the exact unit normals at the middles of edges, by their numbers.
    limit_deg : float
        Error that is allowed.

    Returns
    -------
    ndarray of int
        Numbers of the edges.
    """
    limit, ends = math.radians(limit_deg), normals[edges]
    # Where the end normals nearly agree nothing between can be far off: most edges need no more.
    tried = np.flatnonzero(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1) > 10 * limit)
    return np.asarray(tried[off_between(ends[tried], middle_normals(tried), 0.5, limit_deg)])


def off_between(ends: Array, normals: Array, share: float, limit_deg: float) -> npt.NDArray[np.bool_]:
    """Tell where the normal that is interpolated along an edge is off.

    Parameters
    ----------
    ends : ndarray, shape (N, 2, 3)
        Exact unit normals at the edges' ends.
    normals : ndarray, shape (N, 3)
        Those at a share of the way between.
    share : float
        From the first end, 0 to 1.
    limit_deg : float
        Error that is allowed.

    Returns
    -------
    ndarray of bool, shape (N,)
    """
    between = (1 - share) * ends[:, 0] + share * ends[:, 1]
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(np.cross(between, normals), axis=1) > math.radians(limit_deg))


def halve(faces: IntArray, index: IntArray, chosen: IntArray, first_vertex: int, edge_count: int) -> IntArray:
    """Cut the faces at the chosen edges, whose middles are vertices from `first_vertex` on, in their order."""
    added = np.full(edge_count, -1, dtype=np.int64)
    added[chosen] = first_vertex + np.arange(len(chosen))
    return cut_faces(faces, added[index])
