"""Vectors by their components: arrays of N numbers are quicker than arrays of N vectors."""

import numpy as np

from simtest.runtime.arrays import Array, IntArray

Components = tuple[Array, Array, Array]
"""The components of N vectors, each of shape (N,)."""


def components(vectors: Array) -> Components:
    """Return the components of vectors, shape (N, 3)."""
    x, y, z = np.ascontiguousarray(vectors.T)
    return x, y, z


def chosen(vectors: Components, rows: IntArray) -> Components:
    """Return some of the vectors, by their numbers."""
    x, y, z = vectors
    return x[rows], y[rows], z[rows]


def solve3(a: Components, b: Components, c: Components, right: Components) -> tuple[Array, Array, Array]:
    """Solve [a b c] (x, y, z) = right by Cramer's rule; inf or NaN for a singular matrix."""
    bc = cross(b, c)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / dot(a, bc)
        x, y, z = (dot(right, minor) * inverse for minor in (bc, cross(c, a), cross(a, b)))
    return x, y, z


def cross(a: Components, b: Components) -> Components:
    """Return the cross products of vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def dot(a: Components, b: Components) -> Array:
    """Return the dot products of vectors, shape (N,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
