"""Normals at highlights against the law of reflection."""

import numpy as np
import pytest

from simtest.estimators.reflection_check import RELIEF_RAD, reflected, reflection
from simtest.geometry.vectors import tangent_basis

LIGHTS = np.array([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0]])
COUNT = 4000


def highlights(seed, tilt=0.0, stated=0.05):
    """Return what is stated at highlights of either light: base normals off by relief, noise, and a tilt, rad."""
    rng = np.random.default_rng(seed)
    rays = rng.uniform(-0.5, 0.5, (COUNT, 3))
    rays[:, 2] = 1
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = rng.uniform(15, 60, COUNT)
    to_light = LIGHTS[rng.integers(2, size=COUNT)] - distance[:, None] * rays
    normal = to_light / np.linalg.norm(to_light, axis=1, keepdims=True) - rays
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    basis = np.stack(tangent_basis(normal), axis=1)
    off = rng.normal(0, np.hypot(RELIEF_RAD, stated), (COUNT, 2)) + tilt
    made = normal + np.einsum("ni,nij->nj", np.tan(off), basis)
    made /= np.linalg.norm(made, axis=1, keepdims=True)
    covariance = np.broadcast_to(stated**2 * np.eye(2), (COUNT, 2, 2))
    return made, covariance, rays, distance * np.exp(rng.normal(0, 0.2, COUNT)), np.full(COUNT, 0.2), LIGHTS


def test_normals_that_reflect_the_lights_agree():
    # Slightly below 1: of two lights the nearer one counts.
    assert 0.75 < reflection(*highlights(1)).distance < 1.05


def test_normals_that_are_wrong_and_sure_do_not():
    assert reflection(*highlights(2, tilt=0.6)).distance > 3.5


@pytest.mark.parametrize("stated", [0.05, 0.3])
def test_what_is_stated_to_be_uncertain_may_be_off(stated):
    assert 0.7 < reflection(*highlights(3, stated=stated)).distance < 1.1


def test_a_bisector_corrects_a_normal_as_far_as_it_is_sure():
    rng = np.random.default_rng(5)
    true = np.tile([0.2, -0.1, -1.0], (COUNT, 1))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    basis = np.stack(tangent_basis(true), axis=1)

    def drawn(deviation):
        off = rng.normal(0, deviation, (COUNT, 2))
        angle = np.linalg.norm(off, axis=1, keepdims=True)
        return np.cos(angle) * true + np.sinc(angle / np.pi) * np.einsum("ni,nij->nj", off, basis)

    normals, bisectors = drawn(0.2), drawn(RELIEF_RAD)
    # A light at the camera: the bisector is the reversed sightline.
    covariances = np.broadcast_to(0.04 * np.eye(2), (COUNT, 2, 2))
    told = (-bisectors, np.full(COUNT, 30.0), np.full(COUNT, 0.2), np.zeros((1, 3)))
    made, left = reflected(normals, covariances, reflection(normals, covariances, *told))
    before, after = (np.degrees(np.arccos(np.sum(each * true, axis=1))) for each in (normals, made))
    # Two measurements of equal weight halve the variance.
    assert np.sqrt(np.mean(after**2)) == pytest.approx(np.sqrt(np.mean(before**2)) * 0.67, rel=0.05)
    own = np.stack(tangent_basis(made), axis=1)
    off = np.einsum("nij,nj->ni", own, true)
    inside = np.einsum("ni,ni->n", off, np.linalg.solve(left, off[..., None])[..., 0]) < 5.991
    assert 0.93 < inside.mean() < 0.98
    assert np.allclose(np.linalg.norm(made, axis=1), 1)


def test_a_contradiction_widens_the_ellipse():
    normals = np.array([[0.0, 0.0, -1.0]])
    covariances = 1e-4 * np.eye(2)[None]
    ray = np.array([[np.sin(1.0), 0.0, np.cos(1.0)]])
    seen = reflection(normals, covariances, ray, np.array([30.0]), np.array([0.1]), np.zeros((1, 3)))
    _, left = reflected(normals, covariances, seen)
    assert seen.squared[0] == pytest.approx(1.0 / (RELIEF_RAD**2 + 1e-4), rel=0.01)
    assert np.trace(left[0]) > 3 * np.trace(covariances[0])
