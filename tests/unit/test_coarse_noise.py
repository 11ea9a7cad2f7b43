"""Noise at the scale of the smoothing: white noise is found again, correlated noise shows, shading does not."""

import cv2
import numpy as np
import pytest

from simtest.calibration import Calibration
from simtest.calibration.frame import COLOURED, Frame, estimate_coarse_noise, estimate_noise
from simtest.calibration.photometry import NoiseModel
from simtest.geometry import Camera, smooth

SIGMA = 0.01


def white(seed=0, shape=(240, 320)):
    return (SIGMA * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


def framed(picture, noise=None, smoothing=2.0):
    height, width = picture.shape
    camera = Camera(width, height, 300.0, 300.0, width / 2, height / 2)
    calibration = Calibration(camera) if noise is None else Calibration(camera, noise=noise)
    return Frame(picture.astype(np.float32), calibration, smoothing)


@pytest.mark.parametrize("smoothing", [1.0, 1.5, 2.0, 3.0])
def test_white_noise_is_found_again_after_smoothing(smoothing):
    found = estimate_coarse_noise(smooth(white(), smoothing), smoothing)
    assert found == pytest.approx(SIGMA, rel=0.06)


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_is_found_as_it_is(seed):
    # 76,800 pixels: a standard deviation is good to 0.5 %.
    assert estimate_noise(white(seed)) == pytest.approx(SIGMA, rel=0.02)


def test_correlated_noise_counts_by_what_smoothing_leaves_of_it():
    """Noise averaged over 2 x 2 px and doubled has the same low frequencies as noise of twice the deviation."""
    noise = 2 * cv2.blur(white(1), (2, 2))
    smoothed = smooth(noise, 2.0)
    left = float(smoothed.std()) / float(smooth(white(2), 2.0).std())
    assert left > 1.7
    assert estimate_coarse_noise(smoothed, 2.0) == pytest.approx(left * SIGMA, rel=0.08)
    # Negative control: the finest scale does not show it.
    assert estimate_noise(noise) < 0.6 * left * SIGMA


def test_clipped_and_unseen_pixels_and_small_frames_say_nothing():
    frame = white(3)
    frame[60:90, 100:140] += 1.0
    clipped = frame > 0.5
    smoothed = smooth(frame, 2.0)
    assert estimate_coarse_noise(smoothed, 2.0, clipped=clipped) == pytest.approx(SIGMA, rel=0.06)
    assert estimate_coarse_noise(smoothed, 2.0, seen=np.zeros(frame.shape, dtype=bool)) == 0
    assert estimate_coarse_noise(smooth(white()[:12], 2.0), 2.0) == 0
    assert estimate_coarse_noise(frame, 0.0) == 0


def test_patches_of_a_frame_have_the_noise_that_its_smoothing_leaves():
    y, x = np.mgrid[:240, :320]
    lobe = np.exp(-((x - 160) ** 2 + (y - 120) ** 2) / 200) + 0.3 * np.cos(x / 60)
    plain = framed(lobe + 1 + white(4))
    assert plain.noise_as_smoothed == plain.noise  # the shading is no noise
    coarse = framed(lobe + 1 + 2 * cv2.blur(white(5), (2, 2)))
    assert coarse.noise_as_smoothed > COLOURED * coarse.noise
    assert coarse.patch((100, 60, 120, 120)).noise == coarse.noise_as_smoothed
    # A told noise that differs from pixel to pixel is scaled as a whole.
    told = framed(lobe + 1 + 2 * cv2.blur(white(5), (2, 2)), NoiseModel(0.5 * SIGMA, full_well=40_000))
    ratio = told.noise_as_smoothed / told.noise
    assert ratio.min() == pytest.approx(ratio.max())
    assert ratio.min() > COLOURED


def test_a_coder_that_wipes_the_finest_scale_out_leaves_coarser_noise():
    """8 x 8 blocks of one value each, as strong coding leaves of a flat ground."""
    blocks = cv2.resize(white(6, (30, 40)), (320, 240), interpolation=cv2.INTER_NEAREST)
    frame = framed(1 + blocks)
    assert frame.noise == 0
    assert frame.noise_as_smoothed > 0.5 * SIGMA


def test_a_texture_is_no_noise_where_the_finest_scale_shows_the_told_noise():
    told = NoiseModel(SIGMA)
    texture = 3 * cv2.GaussianBlur(white(7), (0, 0), 3.0) * 3
    frame = framed(1 + white(8) + texture, told)
    assert estimate_coarse_noise(frame.smoothed, 2.0) > COLOURED * SIGMA
    np.testing.assert_array_equal(frame.noise_as_smoothed, frame.noise)
