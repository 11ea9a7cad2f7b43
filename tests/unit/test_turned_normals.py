"""Normals turned by stated rotations, and planes between the centres of their cells."""

import numpy as np

from simtest.estimators.learned import normal_of, turned_normals
from simtest.estimators.learned_dense import interpolated
from simtest.geometry.vectors import tangent_coordinates


def test_turned_normals_have_the_covariance_of_drawn_rotations():
    ray = np.array([[0.3, -0.2, 0.93]])
    ray /= np.linalg.norm(ray)
    turn, root = np.array([[0.6, -0.3]]), 0.02 * np.array([[[1.0, 0.0], [0.5, 0.7]]])
    normals, covariances = turned_normals(ray, turn, root)
    drawn = turn + np.random.default_rng(1).normal(size=(20000, 2)) @ root[0].T
    others = normal_of(np.repeat(ray, len(drawn), axis=0), drawn)
    off = np.array([tangent_coordinates(normals[0], other) for other in others[:4000]])
    assert np.allclose(np.cov(off.T), covariances[0], rtol=0.1, atol=2e-5)


def test_interpolation_is_exact_at_centres_and_between_them():
    planes = np.arange(12.0).reshape(1, 3, 4)
    points = np.array([[0, 0], [3, 2], [1.5, 1.0], [1.0, 0.5], [-4, 0], [9, 9]], dtype=float)
    assert interpolated(planes, points)[0].tolist() == [0, 11, 5.5, 3, 0, 11]
