"""The eigenproblem of the direct ellipse fit, of many fits at once, in closed form [HF98]."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_NEWTON_STEPS = 2


def constrained_minimum(M: Array) -> Array:
    """Minimise q^T M q subject to q^T C q = 4 a c - b^2 = 1 for q = (a, b, c).

    q solves (M - l C) q = 0 for the one l >= 0: M is positive semidefinite and C has one positive eigenvalue, so that
    of the three l, all real, the others are negative.

    Parameters
    ----------
    M : ndarray, shape (B, 3, 3)
        Symmetric, positive semidefinite, of rank 2 at least.

    Returns
    -------
    ndarray, shape (B, 3)
        q, unit.
    """
    A, B, C, D, E, F = M[:, 0, 0], M[:, 0, 1], M[:, 0, 2], M[:, 1, 1], M[:, 1, 2], M[:, 2, 2]
    # det(M - l C) = c0 + c1 l + c2 l^2 - 4 l^3: Vieta's largest root, then Newton's steps for its last digits.
    c0 = A * (D * F - E * E) - B * (B * F - C * E) + C * (B * E - C * D)
    c1, c2 = A * F - 4 * B * E - C * C + 4 * C * D, 4 * (C - D)
    shift = c2 / 12
    p, q = -c1 / 4 - 3 * shift**2, -c0 / 4 - c1 * shift / 4 - 2 * shift**3
    radius = np.sqrt(np.maximum(-p / 3, 0))
    cosine = -q / (2 * radius**3)
    root = 2 * radius * np.cos(np.arccos(np.clip(cosine, -1, 1)) / 3) + shift
    for _ in range(_NEWTON_STEPS):
        slope = c1 + root * (2 * c2 - 12 * root)
        root = root - (c0 + root * (c1 + root * (c2 - 4 * root))) / slope
    vector = _null_vector(M, root)
    # The vector's error is squared in its Rayleigh quotient.
    vector = _null_vector(M, _rayleigh(M, vector))
    return vector


def _rayleigh(M: Array, q: Array) -> Array:
    """Give q^T M q / q^T C q."""
    return np.asarray(np.einsum("ni,nij,nj->n", q, M, q) / (4 * q[:, 0] * q[:, 2] - q[:, 1] ** 2))


# Entries, in a flattened matrix, of the cross products of rows 1 and 2, 2 and 0, 0 and 1: all of them at once, since
# of few matrices each call costs more than the products.
_FIRST = np.array([[4, 5, 3, 7, 8, 6, 1, 2, 0], [5, 3, 4, 8, 6, 7, 2, 0, 1]])
_SECOND = np.array([[8, 6, 7, 2, 0, 1, 5, 3, 4], [7, 8, 6, 1, 2, 0, 4, 5, 3]])


def _null_vector(M: Array, root: Array) -> Array:
    """Give the null vectors of M - l C, unit, shape (B, 3): of the cross products of two rows the longest."""
    N = M.copy()
    N[:, 0, 2] -= 2 * root
    N[:, 2, 0] -= 2 * root
    N[:, 1, 1] += root
    rows = N.reshape(-1, 9)
    crosses = rows[:, _FIRST[0]] * rows[:, _SECOND[0]] - rows[:, _FIRST[1]] * rows[:, _SECOND[1]]
    crosses = crosses.reshape(-1, 3, 3)
    lengths = np.sqrt((crosses * crosses).sum(axis=2))
    best, each = lengths.argmax(axis=1), np.arange(len(M))
    return np.asarray(crosses[each, best] / lengths[each, best][:, None])
