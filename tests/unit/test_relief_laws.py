"""Closed forms of the laws of glints."""

import math

import numpy as np
import pytest
from scipy import integrate

from simtest.validation import laws


def test_without_relief_there_is_one_glint():
    assert laws.glint_count(1e-9, 1.5, 20.0, (2.0, 1.0)) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("slope", "wave", "distance"), [(2, 1.5, 20), (6, 3, 40), (4, 1, 10)])
@pytest.mark.parametrize("gains", [(1, 1), (0.5, 1), (3, 1)])
def test_count_is_the_mean_over_random_hessians(slope, wave, distance, gains):
    """Hessians drawn from random plane waves of one length, as an isotropic field has them."""
    rng = np.random.default_rng(5)
    s, n, k, waves = math.radians(slope), 40_000, 2 * math.pi / wave, 48
    # Waves a cos(phase) of random direction: the slope's variance is s^2 = sum a^2 k^2 / 4 along each axis.
    angle, phase = rng.uniform(0, 2 * math.pi, (2, n, waves))
    bend = -math.sqrt(4 / waves) * s * k * np.cos(phase)
    directions = (np.cos(angle) ** 2, np.cos(angle) * np.sin(angle), np.sin(angle) ** 2)
    xx, xy, yy = (np.sum(bend * share, axis=1) for share in directions)
    determinant = (gains[0] / distance - xx) * (gains[1] / distance - yy) - xy**2
    drawn = np.abs(determinant) * distance**2 / abs(gains[0] * gains[1])
    error = drawn.std() / math.sqrt(n)
    assert abs(laws.glint_count(s, wave, distance, gains) - drawn.mean()) < 4 * error + 0.02 * drawn.mean()


def test_a_glints_error_is_rayleighs():
    s = math.radians(4.0)
    density = lambda e: e / s**2 * math.exp(-(e**2) / (2 * s**2))  # noqa: E731
    mean = integrate.quad(lambda e: e * density(e), 0, 12 * s)[0]
    assert float(laws.relief_error(s)) == pytest.approx(mean, rel=1e-6)
    assert float(laws.relief_error(s)) == pytest.approx(1.2533 * s, rel=1e-4)
    for error in (0.3 * s, s, 2.45 * s):
        assert float(laws.relief_error_share(error, s)) == pytest.approx(integrate.quad(density, 0, error)[0], rel=1e-6)
    assert float(laws.relief_error_share(2.4477 * s, s)) == pytest.approx(0.95, abs=1e-4)


@pytest.mark.parametrize("gains", [(1.0, 1.0), (0.5, 1.0), (3.0, 1.0), (2.0, -0.7)])
def test_the_centroid_of_independent_glints(gains):
    """Means of N sightlines that are off by independent gaussian slopes over the gains."""
    rng = np.random.default_rng(3)
    off = rng.normal(0, 0.07, (20_000, 9, 2)) / np.array(gains)
    mean = np.linalg.norm(off.mean(axis=1), axis=1).mean()
    assert float(laws.independent_centroid_error(0.07, 9, gains)) == pytest.approx(mean, rel=0.02)


def test_cloud_is_as_long_as_the_highlight():
    assert laws.cloud_axis_ratio((0.5, 1.0)) == 0.5
    covariance = laws.cloud_covariance(0.1, 20.0, (2.0, 1.0))
    assert np.sqrt(np.diag(covariance)) == pytest.approx([1.0, 2.0])
