"""Bent isophotes: melted highlights state a share of their size, single ones nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.calibration import LIGHT_AT_CAMERA
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.estimators.budget import MELTED, MELTED_RESIDUAL, bend_variance
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.family import OF_MEAN, OF_PEAK, fit_isophote_family
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime import chi_squared

CAMERA = Camera(120, 100, 300.0, 300.0, 60.0, 50.0)
CENTRE = np.array([58.3, 50.8])
QUANTILE = chi_squared.quantile(0.95, 2)
ROUND = np.diag([1e-4, 1e-4])


def patch(seed: int, noise: float, second: tuple[float, float, float] | None = None) -> Patch:
    """Return a lobe at `CENTRE`, perhaps with a second one: its offset, px, and its height."""
    pixels = CAMERA.pixel_centres()
    values = np.exp(-np.sum((pixels - CENTRE) ** 2, axis=-1) / (2 * 4.0**2))
    if second is not None:
        values += second[2] * np.exp(-np.sum((pixels - CENTRE - second[:2]) ** 2, axis=-1) / (2 * 3.0**2))
    raw = (values + noise * np.random.default_rng(seed).standard_normal(values.shape)).astype(np.float32)
    cut = Patch.cut(smooth(raw, 1.0), (0, 0, 120, 100), raw=raw, noise=noise, smoothing_px=1.0)
    assert isinstance(cut, Patch)
    return cut


def distance2(estimate, without: tuple[str, ...] = ()) -> float:
    covariance = sum(part for name, part in estimate.budget.items() if name not in without)
    miss = tangent_coordinates(estimate.normal, -CAMERA.unproject(CENTRE))
    return float(miss @ np.linalg.solve(covariance, miss))


@pytest.mark.parametrize("estimator", [cone_axis, curved], ids=["cone_axis", "curved"])
@pytest.mark.parametrize("second", [(6.0, 2.0, 0.5), (5.5, -3.0, 0.6), (-4.0, 6.0, 0.5)])
def test_a_near_miss_beside_the_glint_is_in_the_budget(estimator, second):
    estimate = estimator.estimate(patch(1, 0.002, second), CAMERA, LIGHT_AT_CAMERA)
    assert distance2(estimate) < QUANTILE
    # Negative control: noise and ripples alone are wrong and sure.
    assert distance2(estimate, ("shape",)) > QUANTILE


def test_a_single_highlight_has_no_bend_whatever_the_noise():
    for noise in (0.0005, 0.005, 0.03):
        for seed in range(20):
            family = fit_isophote_family(patch(seed, noise), CAMERA, CONE_AXIS_ISOVALUES)
            assert np.trace(family.bend_error()) < 0.1 * np.trace(family.axis_budget["noise"])
    melted = fit_isophote_family(patch(0, 0.005, (6.0, 2.0, 0.5)), CAMERA, CONE_AXIS_ISOVALUES)
    assert np.trace(melted.bend_error()) > 10 * np.trace(melted.axis_budget["noise"])


@given(st.floats(0.001, 0.3), st.floats(0, 0.3), st.sampled_from([OF_MEAN.bends, OF_PEAK.bends]))
def test_more_bend_is_never_less_error_and_noise_is_no_bend(residual, more, slope):
    def share(bend, noise=0.0):
        return np.sqrt(bend_variance(np.array([bend, 2 * bend]), np.array([noise, noise]), ROUND, slope) / 1e-4)

    assert share(residual + more) >= share(residual) * (1 - 1e-12)
    assert share(residual, residual) == 0
    assert share(MELTED_RESIDUAL) == pytest.approx(MELTED)
    assert share(MELTED_RESIDUAL / 2) < MELTED / 10
    assert share(0.2) == pytest.approx(0.2 * slope)


def test_moments_that_are_none_give_no_error():
    assert bend_variance(np.array([0.1]), np.array([0.0]), np.diag([1e-4, -1e-5]), OF_MEAN.bends) == 0
