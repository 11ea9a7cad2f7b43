"""What the camera chain leaves in a picture: blur, noise, halos, blocks; beside references and pictures without."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage, stats

from simtest.calibration import Response
from simtest.geometry import Camera
from simtest.simulation import sensor as camera_chain
from simtest.spec.sensor import Scaling, Sensor

# Point spread ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.6, 1.5, 4.0])
def test_the_point_spread_is_scipys_gaussian(sigma):
    radiance = np.random.default_rng(0).exponential(1.0, (50, 60, 3)).astype(np.float32)
    found = camera_chain.collect(radiance, Sensor(point_spread_px=sigma), Camera(60, 50, 60.0, 60.0, 30.0, 25.0))
    # OpenCV takes the Gaussian of floats out to 4 sigma, and mirrors the frame at its border.
    radius = (round(sigma * 4 * 2 + 1) | 1) // 2
    expected = ndimage.gaussian_filter(radiance.astype(float), (sigma, sigma, 0), radius=(radius, radius, 0))
    np.testing.assert_allclose(found, expected, rtol=2e-6, atol=2e-6)


# Shot noise -----------------------------------------------------------------------------------------------------------


def chi_square(numbers, mean):
    """Return the p-value of the hypothesis that numbers are Poisson's, in bins of some hundred at least."""
    edges = np.unique(stats.poisson.ppf(np.linspace(0, 1, 41)[1:-1], mean))
    expected = np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])) * numbers.size
    found = np.bincount(np.searchsorted(edges, numbers, side="left"), minlength=len(edges) + 1)
    return stats.chisquare(found, expected).pvalue


@pytest.mark.parametrize("mean", [3.0, 51.0, 400.0, 20000.0])
def test_electrons_are_poisson(mean):
    numbers = camera_chain.poisson(np.full(400_000, mean, np.float32), np.random.default_rng(3)).astype(float)
    assert (numbers == np.rint(numbers)).all()
    assert numbers.min() >= 0
    assert chi_square(numbers, mean) > 1e-3
    # Negative control: a rounded normal number has no skew.
    plain = np.rint(np.random.default_rng(3).normal(mean, np.sqrt(mean), 400_000))
    assert mean > 1000 or chi_square(plain, mean) < 1e-6


def test_the_expansion_keeps_to_its_bound():
    """Its distribution function, the quantile function inverted, against that of SciPy at the least mean."""
    mean = camera_chain.LEAST_MEAN
    normal = np.linspace(-6, 6, 2_000_001)
    quantile = mean + np.sqrt(mean) * normal + (2 + normal**2) * (1 / 6 - normal / (72 * np.sqrt(mean)))
    assert (np.diff(quantile) > 0).all()
    counts = np.arange(10, 110)
    cumulated = stats.norm.cdf(np.interp(counts + 1, quantile, normal))
    gap = np.diff(cumulated - stats.poisson.cdf(counts, mean))
    assert 0.5 * np.abs(gap).sum() < 5e-5


def test_pixels_of_one_picture_have_numbers_of_their_own():
    mean = np.repeat(np.float32([0.0, 10.0, 100.0, 1e9]), 5000)
    numbers = camera_chain.poisson(mean, np.random.default_rng(0))
    np.testing.assert_array_equal(numbers, camera_chain.poisson(mean, np.random.default_rng(0)))
    assert not np.array_equal(numbers, camera_chain.poisson(mean, np.random.default_rng(1)))
    for first, level in zip(range(0, 20000, 5000), [0.0, 10.0, 100.0, 1e9], strict=True):
        own = numbers[first : first + 5000].astype(float)
        assert own.mean() == pytest.approx(level, abs=5 * np.sqrt(level / 5000))
    # A pixel that darkens changes no other that is bright.
    darker = mean.copy()
    darker[-1] = 5.0
    np.testing.assert_array_equal(camera_chain.poisson(darker, np.random.default_rng(0))[5000:-1], numbers[5000:-1])


@pytest.mark.parametrize("read_noise", [0.0, 12.0])
def test_the_noise_of_a_processed_picture_is_that_of_a_plain_one(read_noise):
    """Level by level the variance is the level's electrons and the readout's, as `NoiseModel` says."""
    ramp = np.repeat(np.linspace(0.02, 0.9, 40, dtype=np.float32)[:, None], 20_000, axis=1)
    told = {"full_well": 3000, "read_noise": read_noise}
    processed = Sensor.model_validate({**told, "sharpening": {"amount": 0.0}})
    frames = [camera_chain.capture(ramp, 1.0, s, np.random.default_rng(5)) for s in (processed, Sensor(**told))]
    for frame in frames:
        # 20,000 numbers: their variance is known to 1 %.
        expected = ramp[:, 0] / 3000 + (read_noise / 3000) ** 2
        np.testing.assert_allclose(frame.var(axis=1) / expected, 1, atol=0.05)
        np.testing.assert_allclose(frame.mean(axis=1), ramp[:, 0], atol=5 * np.sqrt(expected.max() / 20_000))


# Response -------------------------------------------------------------------------------------------------------------

CURVES = [Response("srgb"), Response("gamma", 2.2), Response("table", light=(0, 0.2, 1), value=(0, 0.5, 1)), Response()]


@pytest.mark.parametrize("curve", CURVES, ids=lambda curve: curve.kind)
@pytest.mark.parametrize("shape", [(7, 9), (5, 6, 3)])
def test_the_fast_curve_is_the_curve(curve, shape):
    light = np.random.default_rng(0).uniform(0, 1, shape).astype(np.float32)
    light.ravel()[:4] = 0.0, 1.0, 0.0031308, 1e-6
    found = curve.encode_picture(light)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, curve.encode(light), atol=3e-7)


# Exposure -------------------------------------------------------------------------------------------------------------


@given(st.floats(-9, 9), st.floats(0.2, 5.0))
@settings(max_examples=40, deadline=None)
def test_a_zero_is_found_in_few_steps(zero, power):
    asked = []

    def falling(x):
        asked.append(x)
        return float(np.exp(-power * x) - np.exp(-power * zero)) if power > 1 else -np.arctan(power * (x - zero))

    assert camera_chain._zero_of(falling, -10.0, 10.0) == pytest.approx(zero, abs=2e-7)
    assert len(asked) < 60
    assert camera_chain._zero_of(lambda x: 1.0 - x, 2.0, 3.0) == 2.0
    assert camera_chain._zero_of(lambda x: 9.0 - x, 2.0, 3.0) == 3.0


# Scaling --------------------------------------------------------------------------------------------------------------


def overlaps(size, count):
    """Return the matrix that averages `size` pixels to `count`, by how much of each the new ones cover."""
    ends = np.arange(count + 1) * size / count
    covered = np.minimum(ends[1:, None], np.arange(1, size + 1)) - np.maximum(ends[:-1, None], np.arange(size))
    return np.maximum(covered, 0) * count / size


def between(size, count):
    """Return the matrix of linear interpolation from `size` pixels to `count`, about the pixels' centres."""
    at = np.clip((np.arange(count) + 0.5) * size / count - 0.5, 0, size - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(size)), 0)


@pytest.mark.parametrize("factor", [0.5, 0.6, 2 / 3, 2.0])
def test_scaling_equals_plain_matrices(factor):
    """Smaller: areas are averaged, then lines are drawn between the centres; larger: the other way round."""
    frame = np.random.default_rng(0).uniform(0, 1, (30, 48)).astype(np.float32)
    found = camera_chain.rescale(frame, Scaling(factor=factor, method="linear"))
    there, back = (overlaps, between) if factor < 1 else (between, overlaps)
    expected = frame
    for _ in range(2):
        size = len(expected)
        expected = (back(round(size * factor), size) @ there(size, round(size * factor)) @ expected).T
    np.testing.assert_allclose(found, expected, atol=2e-6)


# Halos and blocks -----------------------------------------------------------------------------------------------------


def around_highlight(chain):
    """Return the median luma at each whole distance, px, from a clipping disc of 6 px on even tissue, without noise."""
    y, x = np.mgrid[:96, :96] + 0.5
    radius = np.hypot(x - 48, y - 48)
    light = np.array([0.35, 0.16, 0.12]) + np.where(radius < 6, 3.0, 0.0)[..., None]
    frame = camera_chain.capture(light.astype(np.float32), 1.0, Sensor.model_validate(chain), None)
    luma = frame @ np.float32([0.299, 0.587, 0.114])
    return np.array([np.median(luma[radius.astype(int) == r]) for r in range(30)])


@pytest.mark.parametrize("name", ["colonoscope_hd", "laparoscope_hd", "old_sd"])
def test_sharpening_draws_a_dark_halo_and_nothing_else_does(name):
    quiet = {"preset": name, "full_well": None, "read_noise": 0.0, "exposure": {"full_scale": 1.0}}
    depths = []
    for amount in (0.0, 0.5, 1.5):
        luma = around_highlight({**quiet, "sharpening": {"amount": amount}})
        depths.append(np.median(luma[22:]) - luma[6:16].min())
    assert depths[2] > 2 * depths[1] > 2 * (depths[0] + 0.015)
    # Demosaicing and coding alone ring by some steps of 255.
    assert abs(depths[0]) < 0.025


def blockiness(picture):
    """Return the mean step across the borders of blocks of 8 px over that inside of them, along x."""
    steps = np.abs(np.diff(picture.astype(float), axis=1))
    borders = np.arange(steps.shape[1]) % 8 == 7
    return steps[:, borders].mean() / steps[:, ~borders].mean()


def test_blocks_tell_jpeg_60_from_90():
    smooth = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal((128, 128, 3)), (5, 5, 0))
    frame = (0.3 + 0.3 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.float32)

    def blocks(coding):
        told = Sensor.model_validate({"response": {"type": "srgb"}, "bits": 8, "coding": coding, "overlay": {}})
        return blockiness(camera_chain.capture(frame, 1.0, told, None))

    coded = {quality: blocks({"type": "jpeg", "quality": quality}) for quality in (30, 60, 90)}
    assert coded[30] > coded[60] > coded[90] + 0.1
    # Negative control: a picture that was not coded has no blocks.
    assert blocks(None) == pytest.approx(1.0, abs=0.06)
