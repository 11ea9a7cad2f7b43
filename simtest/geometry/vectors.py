"""Directions and rotations: tangent bases, angles, the bisector of light and camera, quaternions."""

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.runtime.arrays import Array, Mask

_ROUNDED = 1e-2
"""How far the length of a quaternion may be from 1: files hold rounded numbers."""


def angle_deg(first: Array, second: Array) -> Array:
    """Return the angle between unit vectors, shapes (..., 3), deg; exact for small angles too."""
    # Component by component: for a few vectors NumPy's cross product and norm take ten times as long.
    x, y, z = _components(first)
    u, v, w = _components(second)
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    sine, cosine = np.sqrt(a * a + b * b + c * c), x * u + y * v + z * w
    return np.asarray(np.degrees(np.arctan2(sine, cosine)))


def _components(vectors: Array) -> tuple[Array, Array, Array]:
    values = np.asarray(vectors)
    return values[..., 0], values[..., 1], values[..., 2]


def tangent_basis(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors that with each unit normal, shape (N, 3), form a right-handed orthonormal basis.

    The branch-free construction of Duff et al. 2017 (J. Comput. Graph. Tech. 6(1)). Covariances of normals are stated
    in this basis.
    """
    x, y, z = normal[:, 0], normal[:, 1], normal[:, 2]
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.array([1 + sign * x * x * a, sign * b, -sign * x]).T.copy()
    second = np.array([b, sign + y * y * a, -y]).T.copy()
    return first, second


def basis_across(normal: Array) -> Array:
    """Return the tangent basis of one unit normal, shape (3,), as rows, shape (2, 3)."""
    # The same numbers as `tangent_basis` gives, without the calls for arrays of one.
    x, y, z = normal.tolist()
    sign = 1.0 if z >= 0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]])


def covariance_across(normal: Array, covariance: Array) -> Array:
    """Return the covariance of a normal's x and y, camera frame, of that in its tangent basis; both of shape (2, 2)."""
    basis = basis_across(normal)[:, :2]
    return np.asarray(basis.T @ covariance @ basis)


def deviation_deg(covariance: Array) -> float:
    """Return the reported deviation of a normal, deg, from its covariance across it, rad^2.

    It is the root of the trace: what the root of the mean squared angle is where the covariance is right. Along one
    axis, as the semi-axes of regions are told, it is 1 / sqrt(2) of that.
    """
    return float(np.degrees(np.sqrt(max(np.trace(covariance), 0.0))))


def tilt_deg(normal: Array) -> float:
    """Return the angle between a unit normal, camera frame, and the direction against the optical axis, deg."""
    return float(np.degrees(np.arccos(np.clip(-normal[2], -1, 1))))


def tangent_coordinates(normal: Array, other: Array) -> Array:
    """Return the rotation from one unit vector, shape (3,), to another in the first one's tangent basis.

    Its shape is (2,), its length the angle between the two, rad.
    """
    first, second = basis_across(normal)
    across = np.array([first @ other, second @ other])
    sine = float(np.hypot(*across))
    angle = float(np.arctan2(sine, normal @ other))
    return across * (angle / sine) if sine > 0 else across  # 0 stays 0


def rotation(vector: npt.ArrayLike) -> Array:
    """Return the matrix, shape (3, 3), that turns about a vector by its length, rad, right-handed (Rodrigues)."""
    x, y, z = np.asarray(vector, dtype=float)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.sqrt(x * x + y * y + z * z))
    # sin(a)/a and (1 - cos(a))/a^2
    first, second = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi)) ** 2 / 2
    return np.asarray(np.eye(3) + first * across + second * across @ across)


def bisect(position: Array, light: Array) -> Array:
    """Return the unit vectors that bisect the directions from points, shape (..., 3), to a light and to the camera."""
    to_light, to_camera = light - position, -position
    both = to_light / _length(to_light) + to_camera / _length(to_camera)
    return np.asarray(both / _length(both))


def _length(vectors: Array) -> Array:
    return np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True))


def rotation_of(quaternion: npt.ArrayLike, where: str = "quaternion") -> Array:
    """Return the rotation, shape (3, 3), of a quaternion w, x, y, z of length 1."""
    q = np.asarray(quaternion, dtype=float)
    length = float(np.linalg.norm(q))
    if not abs(length - 1) <= _ROUNDED:
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


def unit(vectors: npt.ArrayLike) -> Array:
    """Return vectors, shape (..., 3), of unit length."""
    vectors = np.asarray(vectors, dtype=float)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def dot(first: Array, second: Array) -> Array:
    """Return the scalar products of vectors, both of shape (N, 3)."""
    return np.asarray(np.einsum("ni,ni->n", first, second))


def projector(normals: Array) -> Array:
    """Return I - N N^T, shape (N, 3, 3), of unit normals, shape (N, 3): the projection along each."""
    return np.eye(3) - normals[:, :, None] * normals[:, None, :]


FEW = 100
"""Pairs of no more points are tried one by one: a tree of them takes 0.15 s to load."""


def first_of_each(points: Array, apart: float) -> Mask:
    """Return which points, shape (N, D), to keep so that no two are within a distance; earlier points win."""
    kept, undecided = np.zeros(len(points), dtype=bool), np.ones(len(points), dtype=bool)
    if len(points) <= FEW:
        first, second = np.triu_indices(len(points), 1)
        near = np.square(points[first] - points[second]).sum(axis=1) <= apart**2
        first, second = first[near], second[near]
    else:
        from scipy.spatial import cKDTree

        pairs = cKDTree(points).query_pairs(apart, output_type="ndarray")
        first, second = pairs.min(axis=1), pairs.max(axis=1)
    while len(first):
        # A point without an earlier undecided neighbour stays; its neighbours go.
        beaten = np.zeros(len(points), dtype=bool)
        beaten[second] = True
        stays = undecided & ~beaten
        kept |= stays
        undecided &= ~stays
        undecided[second[stays[first]]] = False
        live = undecided[first] & undecided[second]
        first, second = first[live], second[live]
    return kept | undecided
