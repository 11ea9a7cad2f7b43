"""The axis at a lopsided lobe's peak, and what a family states about it."""

import numpy as np
import pytest
from scipy import stats

from simtest.estimators.family import (
    DRIFT_CHI2,
    MEAN_SHARE,
    MEAN_SIZE,
    OF_MEAN,
    OF_PEAK,
    SUSPECT_CHI2,
    fit_isophote_family,
)
from simtest.estimators.isophotes import weights_at_zero, weights_of_axes
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.lenses import KannalaBrandt
from simtest.geometry.vectors import angle_deg

CAMERA = Camera(200, 160, 300.0, 300.0, 100.0, 80.0)
ISOVALUES = (0.3, 0.4, 0.5, 0.6, 0.7)
PLACE = np.array([103.3, 76.8])
PIXEL_DEG = float(np.degrees(1 / 300.0))


def lopsided(cubic, widths=(7.0, 7.0), base=0.0, smoothing=2.0, sigma=0.0, seed=0):
    """A Gaussian lobe whose logarithm has terms x^3, x y^2 and y^3, x and y over its widths, on a base."""
    x, y = np.meshgrid(np.arange(200) + 0.5, np.arange(160) + 0.5)
    x, y = (x - PLACE[0]) / widths[0], (y - PLACE[1]) / widths[1]
    r2 = x * x + y * y
    # The terms are turned off where the expansion says nothing any more.
    odd = (cubic[0] * x**3 + cubic[1] * x * y * y + cubic[2] * y**3) * np.exp(-((r2 / 12) ** 3))
    frame = (np.exp(-r2 / 2 + odd) + base) / (1 + base)
    frame = frame + sigma * np.random.default_rng(seed).standard_normal(frame.shape)
    smoothed = smooth(frame.astype(np.float32), smoothing).astype(float)
    patch = Patch.cut(smoothed, (40, 20, 130, 120), noise=sigma or 1e-9, smoothing_px=smoothing)
    assert isinstance(patch, Patch)
    return patch


def errors_px(patch):
    """How far mean axis, peak of the smoothed lobe, and axis at the peak lie from the true one, px."""
    family, true = fit_isophote_family(patch, CAMERA, ISOVALUES), CAMERA.unproject(PLACE)
    places = np.array([pose.axis for pose in family.poses])
    smoothed = weights_at_zero(family.levels) @ places
    axes = (family.axis, smoothed / np.linalg.norm(smoothed), family.peak_axis)
    return [float(angle_deg(axis, true)) / PIXEL_DEG for axis in axes]


@pytest.mark.parametrize("cubic", [(0.02, 0.0, 0.0), (0.0, 0.04, 0.0), (0.015, 0.015, 0.01)])
def test_the_peak_before_smoothing_is_found(cubic):
    mean, smoothed, peak = errors_px(lopsided(cubic))
    assert peak < 0.006
    # Negative controls: smoothing moves the peak by 2 s^2 / V of the run, and the mean axis lies by the run from it.
    assert smoothed > 4 * peak
    assert mean > 3.5 * smoothed


def test_of_a_long_lobe_the_longer_axis_tells_how_far():
    mean, smoothed, peak = errors_px(lopsided((0.02, 0.0, 0.0), widths=(10.0, 5.0)))
    assert peak < 0.35 * smoothed < 0.1 * mean


def test_on_a_base_the_axis_runs_with_the_area():
    patch = lopsided((0.02, 0.0, 0.0), widths=(12.0, 12.0), base=0.25, smoothing=0.0)
    mean, by_level, peak = errors_px(patch)
    assert peak < 0.02
    # Negative control: over -ln t the run is bent there, and a straight line misses.
    assert by_level > 3 * peak
    assert mean > 4 * by_level


@pytest.mark.parametrize(("distortion", "gain"), [(None, 10), (KannalaBrandt(0.02), 2)])
def test_a_round_lobe_aside_of_the_optical_axis_has_its_peak_where_it_is(distortion, gain):
    """Smoothing is round in pixels, which a lens images as an ellipse off its centre, a fisheye less."""
    camera = Camera(200, 160, 300.0, 300.0, -40.0, 20.0, distortion=distortion)
    x, y = np.meshgrid(np.arange(200) + 0.5, np.arange(160) + 0.5)
    rays, true = camera.unproject(np.array([x.ravel(), y.ravel()]).T), camera.unproject(PLACE)
    frame = np.exp(-(np.arccos(np.clip(rays @ true, -1, 1)) ** 2) / (2 * (7 / 300) ** 2)).reshape(x.shape)
    patch = Patch.cut(smooth(frame.astype(np.float32), 2.0).astype(float), (40, 20, 130, 120), smoothing_px=2.0)
    family = fit_isophote_family(patch, camera, ISOVALUES)
    pixel_deg = float(np.degrees(np.linalg.norm(camera.step_of_pixels(PLACE), axis=1).mean()))
    by_axes = family._weights @ np.array([pose.axis for pose in family.poses])
    followed = float(angle_deg(family.peak_axis, true)) / pixel_deg
    assert followed < 0.004
    # Negative control: the cones' axes, followed as far, leave it.
    assert float(angle_deg(by_axes / np.linalg.norm(by_axes), true)) / pixel_deg > gain * followed


def test_weights_sum_to_one_and_leave_a_common_axis():
    family = fit_isophote_family(lopsided((0.0, 0.0, 0.0)), CAMERA, ISOVALUES)
    weights = weights_of_axes(family.conics, family.isovalues, family.px2, 2.0)
    assert weights.sum() == pytest.approx(1)
    assert angle_deg(family.peak_axis, family.axis) < 0.01 * PIXEL_DEG
    one = family
    assert weights_of_axes(one.conics[:1], one.isovalues[:1], family.px2, 2.0) == pytest.approx([1])


def test_what_a_drift_adds_and_where_it_adds_nothing():
    plain = fit_isophote_family(lopsided((0.0, 0.0, 0.0), sigma=0.02, seed=3), CAMERA, ISOVALUES)
    assert not plain.drift_is_real
    assert list(plain.axis_budget) == ["noise", "resolution"]
    np.testing.assert_array_equal(plain.axis_budget["noise"], plain.axes_covariance[:2, :2])
    # A round lobe in white noise is left with what the grid of pixels makes.
    np.testing.assert_allclose(plain.axis_budget["resolution"], OF_MEAN.px2 * plain.px2)
    np.testing.assert_allclose(plain.peak_budget["resolution"], OF_PEAK.px2 * plain.px2)
    family = fit_isophote_family(lopsided((0.02, 0.01, 0.0), sigma=0.002), CAMERA, ISOVALUES)
    assert family.drift_is_real
    np.testing.assert_array_equal(family.axis_budget["noise"], family.axes_covariance[:2, :2])
    added = family.axis_budget["shape"]
    along = family.drift / np.linalg.norm(family.drift)
    across = np.array([-along[1], along[0]])
    # What the line to the peak leaves open lies in all directions; that the mean axis is not the peak's, along the run.
    left_open = across @ added @ across
    assert along @ added @ along == pytest.approx(left_open + MEAN_SHARE * family.drift @ family.drift, rel=1e-6)
    assert np.sqrt(left_open) > np.radians(0.08 * PIXEL_DEG)
    noise = np.hstack([np.eye(2)] * 2) @ family.axes_covariance @ np.vstack([np.eye(2)] * 2)
    np.testing.assert_allclose(family.peak_budget["noise"], noise, rtol=1e-9)
    by_size = MEAN_SIZE * np.sqrt(np.linalg.det(family.mean_moments))
    np.testing.assert_allclose(family.peak_budget["shape"], (left_open - by_size) * np.eye(2), rtol=1e-2, atol=1e-10)


def test_noise_alone_drifts_as_often_as_is_said():
    """Shares of 150 lobes without a drift beyond both limits, at a level of 1 % together; a control with a drift."""
    count = 150
    chi2 = [
        fit_isophote_family(lopsided((0.0, 0.0, 0.0), sigma=0.02, seed=seed), CAMERA, ISOVALUES)._drift_chi2
        for seed in range(count)
    ]
    for limit, share in ((DRIFT_CHI2, 0.001), (SUSPECT_CHI2, 0.2)):
        beyond = int(np.count_nonzero(np.array(chi2) > limit))
        low, high = stats.binom.ppf([0.0025, 0.9975], count, share)
        assert low <= beyond <= high, (limit, beyond)
    assert fit_isophote_family(lopsided((0.02, 0.0, 0.0), sigma=0.005), CAMERA, ISOVALUES)._drift_chi2 > DRIFT_CHI2
