"""The eigenproblem of the direct ellipse fit [HF98], in closed form, for many fits at once."""

import numpy as np

from simtest.runtime.arrays import Array

_NEWTON_STEPS = 2


def constrained_minimum(M: Array) -> Array:
    """Minimise q^T M q subject to q^T C q = 4 a c - b^2 = 1 for q = (a, b, c).

    M, shape (B, 3, 3), is symmetric, positive semidefinite and of rank 2 at least. The result, shape (B, 3), is unit.
    It solves (M - l C) q = 0 for the one l >= 0: since C has one positive eigenvalue, all three l are real and the
    other two are negative.
    """
    # coefficients of det(M - l C) = c0 + c1 l + c2 l^2 - 4 l^3
    entries = M.reshape(-1, 9)
    products = entries.T[_FACTORS[0]] * entries.T[_FACTORS[1]]
    minors = products[:4] - products[4:]
    c0 = (entries.T[:3] * minors[:3]).sum(axis=0)
    c1, c2 = minors[3] - 4 * minors[2], 4 * (entries[:, 2] - entries[:, 4])
    # largest root by Vieta's formula, its last digits by Newton's steps
    shift = c2 / 12
    square, quarter = shift * shift, c1 / 4
    radius = np.sqrt(np.maximum(quarter / 3 + square, 0))
    cosine = (c0 / 4 + shift * (quarter + 2 * square)) / (2 * radius * radius * radius)
    root = 2 * radius * np.cos(np.arccos(np.maximum(np.minimum(cosine, 1), -1)) / 3) + shift
    for _ in range(_NEWTON_STEPS):
        slope = c1 + root * (2 * c2 - 12 * root)
        root = root - (c0 + root * (c1 + root * (c2 - 4 * root))) / slope
    vector = _null_vector(M, root)
    # A Rayleigh quotient squares the vector's error: one more step gives full precision.
    vector = _null_vector(M, _rayleigh(M, vector))
    return vector


def _rayleigh(M: Array, q: Array) -> Array:
    """Return q^T M q / q^T C q."""
    return np.asarray(np.einsum("ni,nij,nj->n", q, M, q) / (4 * q[:, 0] * q[:, 2] - q[:, 1] ** 2))


# Entries of a flattened matrix whose products make the minors of its first row and of its middle: DF - E^2, CE - BF,
# BE - CD and AF - C^2. For few matrices a call costs more than its products, so all are multiplied at once.
_FACTORS = np.array([[4, 2, 1, 0, 5, 1, 2, 2], [8, 5, 5, 8, 5, 8, 4, 2]])

# The same for the cross products of rows 1 and 2, 2 and 0, 0 and 1: u1 v2 - u2 v1, u2 v0 - u0 v2, u0 v1 - u1 v0.
_CROSSES = np.array(
    [
        [4, 5, 3, 7, 8, 6, 1, 2, 0, 5, 3, 4, 8, 6, 7, 2, 0, 1],
        [8, 6, 7, 2, 0, 1, 5, 3, 4, 7, 8, 6, 1, 2, 0, 4, 5, 3],
    ]
)


def _null_vector(M: Array, root: Array) -> Array:
    """Return the null vectors of M - l C, unit, shape (B, 3): the longest cross product of two rows."""
    N = M.copy()
    N[:, 0, 2] -= 2 * root
    N[:, 2, 0] -= 2 * root
    N[:, 1, 1] += root
    entries = N.reshape(-1, 9)
    products = entries.take(_CROSSES[0], axis=1) * entries.take(_CROSSES[1], axis=1)
    crosses = (products[:, :9] - products[:, 9:]).reshape(-1, 3, 3)
    squares = (crosses * crosses).sum(axis=2)
    best, each = squares.argmax(axis=1), np.arange(len(M))
    return np.asarray(crosses[each, best] / np.sqrt(squares[each, best])[:, None])
