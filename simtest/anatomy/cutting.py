"""Cutting triangles at the middles of some of their edges, without a gap to their neighbours."""

import numpy as np

from simtest.anatomy.base import IntArray


def face_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Number the edges.

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
