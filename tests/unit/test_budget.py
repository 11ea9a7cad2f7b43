"""The uncertainty of an estimate as a budget of named parts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from simtest.estimators.budget import STATED, deviations, dominant, equivalent_covariance, total
from simtest.estimators.protocol import Estimate

NORMAL = np.array([0.0, 0.0, -1.0])
SMALL, LARGE = np.diag([1e-6, 2e-6]), np.diag([4e-4, 1e-4])


def estimate(**given):
    return Estimate(NORMAL, NORMAL[None], np.array([16.0, 16.0]), **given)


def test_the_covariance_is_the_sum_of_the_parts():
    stated = estimate(budget={"noise": SMALL, "shape": LARGE})
    np.testing.assert_array_equal(stated.covariance, SMALL + LARGE)
    more = stated.with_parts(noise=SMALL, camera=LARGE)
    np.testing.assert_allclose(more.covariance, 2 * SMALL + 2 * LARGE)
    np.testing.assert_allclose(more.budget["noise"], 2 * SMALL)
    assert dominant(stated.budget) == "shape"
    assert deviations(stated.budget)["noise"] == pytest.approx(np.sqrt(3e-6))
    assert stated.without_uncertainty().covariance is None


def test_a_covariance_without_a_budget_is_one_part():
    stated = estimate(covariance=LARGE)
    assert list(stated.budget) == [STATED]
    np.testing.assert_array_equal(total(stated.budget), LARGE)
    assert estimate().budget is None


@given(st.floats(0.01, 1), st.floats(-0.9, 0.9), st.integers(0, 2**31))
def test_normal_errors_have_their_covariance(scale, correlation, seed):
    truth = scale**2 * np.array([[1, correlation / 2], [correlation / 2, 0.25]])
    moves = np.random.default_rng(seed).multivariate_normal([0, 0], truth, 20000)
    np.testing.assert_allclose(equivalent_covariance(moves), truth, atol=0.06 * scale**2)


def test_heavy_tails_are_held_to_95_percent_and_a_plain_covariance_is_not():
    rng = np.random.default_rng(4)
    offset, distance, azimuth = rng.uniform(0, 6, 40000), rng.uniform(5, 80, 40000), rng.uniform(0, 2 * np.pi, 40000)
    angle = np.arctan(offset / distance) / 2
    moves = angle[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)

    def held(covariance):
        return np.mean(np.einsum("ni,ni->n", moves, np.linalg.solve(covariance, moves.T).T) <= chi2.ppf(0.95, 2))

    assert held(equivalent_covariance(moves)) == pytest.approx(0.95, abs=0.002)
    assert held(moves.T @ moves / len(moves)) < 0.94


def test_no_moves_have_no_covariance():
    np.testing.assert_array_equal(equivalent_covariance(np.zeros((5, 2))), np.zeros((2, 2)))
    line = equivalent_covariance(np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, 0.0]]))
    assert line[0, 0] > 0.1
    assert np.isfinite(line).all()
