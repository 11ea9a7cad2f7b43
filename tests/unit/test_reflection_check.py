"""Normals at highlights against the law of reflection."""

import numpy as np
import pytest

from simtest.estimators.learned import RELIEF_RAD, reflection_distances
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
    assert 0.75 < reflection_distances(*highlights(1)).mean() / 2 < 1.05


def test_normals_that_are_wrong_and_sure_do_not():
    assert reflection_distances(*highlights(2, tilt=0.6)).mean() / 2 > 3.5


@pytest.mark.parametrize("stated", [0.05, 0.3])
def test_what_is_stated_to_be_uncertain_may_be_off(stated):
    assert 0.7 < reflection_distances(*highlights(3, stated=stated)).mean() / 2 < 1.1
