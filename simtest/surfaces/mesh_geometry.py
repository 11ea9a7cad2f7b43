"""Edges, areas and proportions of triangle meshes: vertices of shape (V, 3), mm, and faces of shape (F, 3)."""

import numpy as np

from simtest.runtime.arrays import Array, IntArray


def face_edges(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges of faces, and where each belongs.

    Returns
    -------
    edges : ndarray of int, shape (E, 2)
        Vertices of each edge, the smaller first.
    index : ndarray of int, shape (F, 3)
        Number of the edge from each corner of a face to the next.
    """
    codes, span = _edge_codes(faces)
    # Each edge once, and for each corner which of them it starts
    found, index = np.unique(codes, return_inverse=True)
    return np.stack(np.divmod(found, span), axis=1), index.reshape(-1, 3)


def edge_uses(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges, shape (E, 2), smaller vertex first, and how many faces each belongs to, shape (E,)."""
    codes, span = _edge_codes(faces)
    found, uses = np.unique(codes, return_counts=True)
    return np.stack(np.divmod(found, span), axis=1), uses


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
    weight, known = vertex_areas(vertices, faces), np.isfinite(values)
    # Values in rising order, against the area that has at most that value
    order = np.argsort(values[known])
    filled = np.cumsum(weight[known][order])
    return float(values[known][order][np.searchsorted(filled, share * filled[-1])])


def isoperimetric_quotient(vertices: Array, faces: IntArray) -> float:
    """Return 36 pi V^2 / A^3 of a mesh with outward faces: 1 for a sphere, small for a long or folded body.

    An open mesh counts as closed by cones from its centroid.
    """
    centred = vertices - vertices.mean(axis=0)
    cross = area_vectors(centred, faces)
    area = np.linalg.norm(cross, axis=1).sum() / 2
    # Sum of the signed volumes of the cones from the centroid to the faces
    volume = np.einsum("ni,ni->n", centred[faces][:, 0], cross).sum() / 6
    return float(36 * np.pi * volume**2 / area**3)
