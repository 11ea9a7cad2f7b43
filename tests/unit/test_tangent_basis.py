"""The basis in which covariances of normals are stated and stored."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simtest.geometry.vectors import basis_across, tangent_basis

COORDINATE = st.floats(-1, 1)


@given(st.tuples(COORDINATE, COORDINATE, COORDINATE).filter(lambda drawn: np.linalg.norm(drawn) > 1e-3))
def test_the_basis_is_orthonormal_right_handed_and_one(drawn):
    normal = np.array(drawn) / np.linalg.norm(drawn)
    first, second = (axis[0] for axis in tangent_basis(normal[None]))
    rows = np.stack([first, second, normal])
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-14)
    np.testing.assert_array_equal(basis_across(normal), [first, second])


def test_the_basis_is_that_of_every_release():
    """To the letter, since it says what a stored covariance means: also beside the pole where z changes its sign."""
    np.testing.assert_array_equal(basis_across(np.array([0.0, 0.0, 1.0])), [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(basis_across(np.array([0.0, 0.0, -1.0])), [[1, 0, 0], [0, -1, 0]])
    np.testing.assert_allclose(basis_across(np.array([0.6, 0.0, -0.8])), [[0.8, 0, 0.6], [0, -1, 0]], atol=1e-15)
    np.testing.assert_allclose(basis_across(np.array([0.0, 0.6, 0.8])), [[1, 0, 0], [0, 0.8, -0.6]], atol=1e-15)
