"""Coverage of circle pose's region over noise, near its branch point and far from it, and in renders."""

import numpy as np
import pytest
from scipy import stats

from simtest.calibration import Priors
from simtest.estimators.circle_pose import CirclePoseEstimator, pose_region
from simtest.runtime.seeds import from_integer
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.protocol import Pipeline

ALPHA = 0.01
"""Level of each family of tests, shared evenly by its members."""

SETTINGS = [(theta, sigma) for theta in (0.0, 3.0, 10.0, 58.0, 80.0) for sigma in (0.05,)] + [(58.0, 0.01)]


def statistics_of(theta, sigma, count, **more):
    setting = PaperSetting(theta_deg=theta, sigma=sigma, isovalue=0.5, smoothing_px=2.0, **more)
    pipeline = Pipeline(setting)
    found = []
    for seed in range(count):
        patch = pipeline.patch(from_integer(40_000 + seed))
        estimate = CirclePoseEstimator(setting.isovalue).estimate(patch, setting.camera, Priors(plane=True))
        found.append(float(estimate.region.statistic(setting.normal)))
    return np.array(found)


def off(T):
    """p-value of the share within the 95 % region."""
    inside = int(np.sum(stats.chi2.ppf(0.95, 2) >= T))
    return stats.binomtest(inside, len(T), 0.95).pvalue


@pytest.mark.parametrize(("theta", "sigma"), [(0.0, 0.05), pytest.param(58.0, 0.05, marks=pytest.mark.ci)])
def test_regions_cover_at_and_far_from_the_branch_point(theta, sigma):
    assert off(statistics_of(theta, sigma, 150)) > ALPHA / 2


@pytest.mark.slow
@pytest.mark.parametrize(("theta", "sigma"), SETTINGS)
def test_regions_cover_in_93_to_97_percent(theta, sigma):
    T = statistics_of(theta, sigma, 2000)
    assert 0.93 <= np.mean(stats.chi2.ppf(0.95, 2) >= T) <= 0.97


def test_a_region_of_another_cone_does_not_cover():
    """Negative control: with the smoothing kept in the ellipse, the region lies elsewhere."""
    setting = PaperSetting(sigma=0.01, isovalue=0.5, smoothing_px=2.0)
    pipeline = Pipeline(setting)
    T = []
    for seed in range(40):
        patch = pipeline.patch(from_integer(seed))
        isophote = CirclePoseEstimator(0.5).estimate(patch, setting.camera).isophotes[0]
        region = pose_region(patch, setting.camera, isophote)
        own = CirclePoseEstimator(0.5).estimate(patch, setting.camera)
        # The published normals themselves are those of the smoothed picture.
        T.append(float(region.statistic(own.candidates).min()))
    assert np.median(T) > 2
