"""Statistics of frames: each on pictures that were drawn to have a known value of it."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.errors import InputError
from simtest.realism.statistics import COLUMNS, STATISTICS, measure

TISSUE = np.float32([0.62, 0.34, 0.28])
"""Encoded red, green and blue."""


def tissue(height=240, width=320, noise=0.0, seed=0):
    frame = np.broadcast_to(TISSUE, (height, width, 3)).copy()
    return (frame + noise * np.random.default_rng(seed).standard_normal(frame.shape)).astype(np.float32)


def with_spots(frame, spots, sigma=3.0, height=0.36):
    """Add grey Gaussians at (x, y)."""
    rows, columns = np.mgrid[: frame.shape[0], : frame.shape[1]] + 0.5
    made = frame.copy()
    for x, y in spots:
        made += (height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2)))[..., None].astype(
            np.float32
        )
    return np.clip(made, 0, 1)


GRID = [(x, y) for x in (60, 140, 220) for y in (60, 120, 180)]


def test_every_column_is_measured_and_named_once():
    assert len(STATISTICS) == 12
    assert len(set(COLUMNS)) == len(COLUMNS)
    found = measure(with_spots(tissue(noise=0.01), GRID))
    assert set(found) == set(COLUMNS)
    assert all(values.ndim == 1 and np.isfinite(values).all() for values in found.values())


def test_highlights_are_counted_and_sized():
    found = measure(with_spots(tissue(noise=0.004), GRID))
    assert found["per_frame"] == [9]
    assert found["per_megapixel"] == pytest.approx(9 / (240 * 320) * 1e6)
    assert found["axis_ratio"] == pytest.approx(1.0, abs=0.12)
    # Neighbours are 60 px apart along y.
    assert np.median(found["clustering"] * found["radius"] * 320) == pytest.approx(60, abs=1)
    small = measure(with_spots(tissue(noise=0.004), GRID, sigma=2.0))
    ratio = np.median(found["radius"]) / np.median(small["radius"])
    assert ratio == pytest.approx(1.5, rel=0.15)
    assert found["area"] == pytest.approx(9 * np.pi * np.median(found["radius"] * 320) ** 2 / (240 * 320), rel=0.2)


def test_clipping_is_seen_at_the_peaks():
    assert measure(with_spots(tissue(), GRID, height=0.30))["clipped"] == [0.0]
    assert measure(with_spots(tissue(), GRID, height=2.0))["clipped"] == [1.0]
    half = with_spots(with_spots(tissue(), GRID[:4], height=2.0), GRID[4:8], height=0.30)
    assert measure(half)["clipped"] == pytest.approx(0.5)


def test_sharpening_draws_halos_and_nothing_else_does():
    frame = with_spots(tissue(noise=0.002), GRID, height=2.0, sigma=2.0)
    plain = np.median(measure(frame)["halo"])
    sharp = np.clip(frame + 1.2 * (frame - cv2.GaussianBlur(frame, (0, 0), 2.0)), 0, 1)
    assert np.median(measure(sharp)["halo"]) > plain + 0.05
    assert plain < 0.02


def test_colour_has_its_moments():
    found = measure(tissue(noise=0.02))
    lab = cv2.cvtColor(tissue(4, 4), cv2.COLOR_RGB2Lab)[0, 0]
    for i, name in enumerate("lab"):
        assert found[f"{name}_mean"] == pytest.approx(lab[i], abs=0.7)
        assert 0.3 < found[f"{name}_sd"] < 6


@given(st.floats(-3, 1))
@settings(max_examples=10, deadline=None)
def test_falloff_is_the_slope_over_the_squared_radius(slope):
    rows, columns = np.mgrid[:240, :320] + 0.5
    squared = ((columns - 160) ** 2 + (rows - 120) ** 2) / (160**2 + 120**2)
    linear = (0.15 * TISSUE / TISSUE.max() * np.exp(slope * squared)[..., None]).astype(np.float32)
    frame = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)
    assert measure(frame)["falloff"] == pytest.approx(slope, abs=0.08)


@pytest.mark.parametrize("slope", [-1.0, -2.0, -3.0])
def test_spectrum_of_a_power_law(slope):
    rng = np.random.default_rng(3)
    frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.rfftfreq(256)[None])
    frequency[0, 0] = 1
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((256, 256))) * frequency ** (slope / 2))
    frame = tissue(256, 256) + (0.03 * field / field.std())[..., None].astype(np.float32)
    assert measure(frame)["spectrum"] == pytest.approx(slope, abs=0.35)


def test_spectrum_of_a_wide_frame_is_that_of_all_of_it():
    """Fine detail on one side and coarse detail on the other: the mirrored frame is the same frame."""
    rng = np.random.default_rng(3)
    coarse = cv2.GaussianBlur(rng.standard_normal((256, 256)), (0, 0), 3)
    frame = tissue(256, 512)
    frame[:, :256] += (0.03 * rng.standard_normal((256, 256)))[..., None].astype(np.float32)
    frame[:, 256:] += (0.03 * coarse / coarse.std())[..., None].astype(np.float32)
    slopes = [measure(np.ascontiguousarray(each))["spectrum"][0] for each in (frame, frame[:, ::-1])]
    turned = measure(np.ascontiguousarray(frame.transpose(1, 0, 2)))["spectrum"][0]
    assert slopes[1] == pytest.approx(slopes[0], abs=0.05)
    assert turned == pytest.approx(slopes[0], abs=0.05)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_noise_at_mid_grey(noise):
    """Luma of three channels of white noise."""
    expected = noise * np.linalg.norm([0.299, 0.587, 0.114])
    assert measure(tissue(480, 640, noise=noise))["noise"] == pytest.approx(expected, rel=0.03)
    # A slope of brightness is no noise.
    ramp = tissue(noise=noise) + np.linspace(-0.1, 0.1, 320, dtype=np.float32)[None, :, None]
    assert measure(ramp)["noise"] == pytest.approx(expected, rel=0.05)


def test_vessels_are_green_dark_lines():
    frame = tissue(noise=0.003)
    veined = frame.copy()
    veined[:, 20::40, 1] *= 0.75
    veined[:, 21::40, 1] *= 0.75
    shaded = frame.copy()
    shaded[:, 20::40] *= 0.9
    shaded[:, 21::40] *= 0.9
    plain, vessels, shade = (measure(f)["vessels"][0] for f in (frame, veined, shaded))
    assert vessels > 4 * plain
    assert shade < 2 * plain
    # Of lines that are greener than what lies around them the band leaves less than half.
    dark, pale = frame.copy(), frame.copy()
    for row in range(3):
        dark[:, 20 + row :: 30, 1] *= 0.75
        pale[:, 20 + row :: 30, 1] *= 1.25
    assert measure(pale)["vessels"][0] < 0.5 * measure(dark)["vessels"][0]


def test_a_black_mask_is_no_tissue():
    frame = with_spots(tissue(360, 480, noise=0.004), [(240, 180), (280, 150)])
    rows, columns = np.mgrid[:360, :480]
    masked = np.where(((columns - 240) ** 2 + (rows - 180) ** 2 < 170**2)[..., None], frame, 0).astype(np.float32)
    whole, round_ = measure(frame), measure(masked)
    for name in ("l_mean", "a_mean", "b_mean"):
        assert round_[name] == pytest.approx(whole[name], abs=1.0)
    assert round_["per_megapixel"] > whole["per_megapixel"] * 1.5


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((100, 100), np.float32), "takes colour frames"),
        (np.full((100, 100, 3), 0.5, np.float32), "has no colours"),
        (tissue(40, 100), "100 x 40 px: must be at least 64 px"),
    ],
)
def test_frames_that_cannot_be_measured_are_named(picture, words):
    with pytest.raises(InputError, match=words):
        measure(picture)


@pytest.mark.parametrize("colour", [(0.9, 0.2, 0.1), (0.02, 0.0, 0.0), (1.0, 1.0, 0.98)])
def test_an_even_frame_is_measured_without_a_traceback(colour):
    found = measure(np.broadcast_to(np.float32(colour), (128, 128, 3)).copy())
    assert all(np.isfinite(values).all() for values in found.values())
