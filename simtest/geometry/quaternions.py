"""Rotations as unit quaternions w, x, y, z."""

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.runtime.arrays import Array

ROUNDED = 1e-2
"""How far the length of a quaternion may be from 1: files hold rounded numbers."""


def rotation_of(quaternion: npt.ArrayLike, where: str = "quaternion") -> Array:
    """Return the rotation, shape (3, 3), of a quaternion w, x, y, z of length 1."""
    q = np.asarray(quaternion, dtype=float)
    length = float(np.linalg.norm(q))
    if not abs(length - 1) <= ROUNDED:
        raise InputError(f"{where}: quaternion of length {length:.3g}; must be 1")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_of(rotation: npt.ArrayLike) -> Array:
    """Return the unit quaternion w, x, y, z, w >= 0, of a rotation, shape (3, 3)."""
    R = np.asarray(rotation, dtype=float)
    # The squares of the components, of which the largest is divided by: no digits are lost at half turns.
    (a, b, c), trace = np.diag(R), np.trace(R)
    squares = np.array([1 + trace, 1 + 2 * a - trace, 1 + 2 * b - trace, 1 + 2 * c - trace])
    products = np.array(
        [
            [squares[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], squares[1], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], squares[2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], squares[3]],
        ]
    )
    q = products[int(squares.argmax())]
    q = q / np.linalg.norm(q)
    return np.asarray(-q if q[0] < 0 else q)
