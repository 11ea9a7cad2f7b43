"""Which peaks of synthetic frames have the shape of a point highlight."""

import cv2
import numpy as np
import pytest

from simtest.api import reconstruct_picture
from simtest.conventions import HIGHLIGHT_ELLIPSE_RESIDUAL, HIGHLIGHT_WIDTH_EXCESS
from simtest.detection import detect, flat_pixels, peak_shape
from simtest.errors import Failure
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.patch import share_of_noise
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import reconstruct
from tests.marked import marked

SIZE = 160
CAMERA = Camera(SIZE, SIZE, 160.0, 160.0, 80.0, 80.0)


def frame_of(height, pedestal=0.05):
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - 80.0
    return (height(x, y) + pedestal).astype(np.float32)


def gaussian(x, y):
    return np.exp(-(x**2) / (2 * 15**2) - y**2 / (2 * 8**2))


def near_miss(x, y):
    """The lobe where the misfit (x^2 + delta, y) comes closest to 0 without reaching it: theory.md section 3."""
    return np.exp(-((x**2 / 300 + 0.05) ** 2) / 0.3 - y**2 / (2 * 8**2))


def ridge(x, y):
    """A Gaussian bent into an arc."""
    return gaussian(x, y - x**2 / 45)


def shape_of(frame, noise=0.0):
    smoothed = smooth(frame, 2.0)
    (region,) = detect(smoothed, noise, isolated=False)
    patch = Patch.cut(smoothed, region.box, region.peak, smoothing_px=2.0)
    shape = peak_shape(patch, region, noise / 7.1, flat_pixels(frame))
    assert not isinstance(shape, Failure)
    return shape


@pytest.mark.parametrize("pedestal", [0.0, 0.3, 0.7])
def test_a_gaussian_highlight_has_neither_residual_nor_excess_over_any_ground(pedestal):
    shape = shape_of(frame_of(gaussian, pedestal))
    assert shape.residual < 0.002
    assert shape.width_excess == pytest.approx(0.0, abs=0.01)
    assert shape.is_highlight


def test_a_heavy_tail_is_sharper_than_a_gaussian():
    shape = shape_of(frame_of(lambda x, y: 1 / (1 + x**2 / 200 + y**2 / 100) ** 2))
    assert shape.width_excess < 0
    assert shape.is_highlight


def test_a_near_miss_of_the_bisector_is_flat_topped():
    shape = shape_of(frame_of(near_miss))
    assert shape.width_excess > 2 * HIGHLIGHT_WIDTH_EXCESS
    assert not shape.is_highlight


def test_a_bent_ridge_is_no_ellipse():
    shape = shape_of(frame_of(ridge))
    assert shape.residual > 1.5 * HIGHLIGHT_ELLIPSE_RESIDUAL
    assert not shape.is_highlight


@pytest.mark.parametrize("level", [0.4, 0.7])
def test_a_clipped_peak_is_not_taken_for_a_flat_one(level):
    frame = np.minimum(frame_of(gaussian), level).astype(np.float32)
    assert np.isnan(shape_of(frame).width_excess)
    assert len(reconstruct(frame, CAMERA)) == 1
    assert flat_pixels(frame_of(gaussian)) is None


@pytest.mark.parametrize("sigma", marked([0.01, 0.06], ci=[0.06]))
def test_noise_is_allowed_for(sigma):
    """Down to 15 sigma a highlight keeps its place; the predicted noise bounds the residuals."""
    rng, found, residuals, predicted = np.random.default_rng(5), 0, [], []
    for _ in range(40):
        noisy = frame_of(gaussian) + rng.normal(0, sigma, (SIZE, SIZE)).astype(np.float32)
        found += len(reconstruct(noisy, CAMERA, ["brightest_point"]))
        shape = shape_of(noisy, sigma)
        residuals.append(shape.residual)
        predicted.append(shape.residual_noise)
    assert found >= 39
    # The fit takes part of it up: the contour of a spot smoothed at its own scale has few independent points.
    assert 0.3 < np.mean(residuals) / np.mean(predicted) < 1.0


@pytest.mark.parametrize("smoothing_px", [0.0, 1.0, 4.0])
def test_the_noise_that_is_left_follows_the_frame_s_own_smoothing(smoothing_px):
    """White noise that both Gaussians leave, whatever the first one's width; each at its own share of it."""
    smoothed = smooth(frame_of(gaussian), smoothing_px)
    (region,) = detect(smoothed, 0.0, isolated=False)
    patch = Patch.cut(smoothed, region.box, region.peak, smoothing_px=smoothing_px)
    shape = peak_shape(patch, region, share_of_noise(smoothing_px), None)
    width = np.sqrt(np.count_nonzero(patch.inside(0.5)) / np.pi)
    left = share_of_noise(np.hypot(smoothing_px, 0.2 * width))
    height = region.contrast - (patch.peak_value - smooth(patch.values, 0.2 * width).max())
    level = 1 - 0.3 * (height + patch.peak_value - region.contrast) / height
    assert shape.residual_noise == pytest.approx(left / height / (-2 * level * np.log(level)), rel=1e-3)


def test_a_shape_is_measured_inside_the_view_alone():
    """What shines or is dark outside enters neither the smoothed peak nor its isophotes."""
    frame = frame_of(gaussian)
    seen = np.arange(SIZE)[:, None] + np.zeros((1, SIZE)) < 96
    shapes = []
    for outside in (0.0, 5.0):
        smoothed = smooth(np.where(seen, frame, np.float32(outside)), 2.0, seen)
        smoothed[~seen] = outside
        (region,) = [each for each in detect(smooth(frame, 2.0, seen), 0.0, False, seen)]
        patch = Patch.cut(smoothed, region.box, region.peak, seen=seen, smoothing_px=2.0)
        shapes.append(peak_shape(patch, region, 0.0))
    assert not isinstance(shapes[0], Failure)
    assert shapes[0] == shapes[1]


def test_only_what_is_seen_counts_as_clipped():
    frame = np.minimum(frame_of(gaussian), 0.7).astype(np.float32)
    frame[2:8, 2:8] = 1.0
    seen = np.ones(frame.shape, dtype=bool)
    seen[:10] = False
    assert np.array_equal(flat_pixels(frame, seen), (frame == np.float32(0.7)) & seen)
    assert flat_pixels(frame, ~seen)[2:8, 2:8].all()
    assert flat_pixels(frame, np.zeros_like(seen)) is None


@pytest.mark.parametrize("false", [near_miss, ridge])
def test_only_isolated_highlights_are_asked_for_their_shape(false):
    frame = frame_of(false)
    assert reconstruct(frame, CAMERA) == []
    assert len(reconstruct(frame, CAMERA, isolated=False)) == 1


def test_the_command_takes_every_peak_where_it_is_asked_to(tmp_path):
    picture = tmp_path / "ridge.png"
    cv2.imwrite(str(picture), np.rint(230 * frame_of(ridge) / frame_of(ridge).max()).astype(np.uint8))
    for every, expected in ((False, 0), (True, 1)):
        options = Options(fov_deg=50.0, encoding="linear", every=every)
        with pytest.warns(UserWarning, match="no calibration|no specularity"):
            record, _ = reconstruct_picture(picture, tmp_path / "out", options)
        assert len(record) == expected
