"""Peaks: their regions and contrast, how far they must stand above the noise, and which have a highlight's shape."""

import numpy as np
import pytest

from simtest.conventions import HIGHLIGHT_ELLIPSE_RESIDUAL, HIGHLIGHT_WIDTH_EXCESS
from simtest.detection import flat_pixels, peak_shape
from simtest.detection.peaks import MAX_PEAKS, contrast, detect, half_height_component
from simtest.errors import Failure
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.patch import share_of_noise
from simtest.reconstruction.pipeline import reconstruct
from tests.marked import marked

SIGMA, PLACE = 6.0, (70, 45)


def spot(height=1.0, base=0.0, place=PLACE):
    y, x = np.mgrid[:100, :140]
    lobe = np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * SIGMA**2))
    return (base + height * lobe).astype(np.float32)


def test_a_region_holds_the_pixels_above_half_height():
    found = half_height_component(spot(), PLACE[1], PLACE[0])
    # exp(-r^2 / 2 s^2) = 1/2; whole pixels
    assert np.count_nonzero(found.mask) == pytest.approx(np.pi * 2 * np.log(2) * SIGMA**2, rel=0.07)
    assert found.closed
    assert found.mask[PLACE[1] - found.y, PLACE[0] - found.x]


@pytest.mark.parametrize(("sigmas", "count"), [(9.8, 0), (10.2, 1)])
def test_ten_sigma_make_a_detection(sigmas, count):
    found = detect(spot(0.01 * sigmas), 0.01)
    assert len(found) == count
    for region in found:
        assert region.peak == PLACE
        assert region.contrast == pytest.approx(0.01 * sigmas, rel=0.1)


def test_a_box_lies_about_its_peak_wherever_it_is():
    for place in ((70, 45), (30, 70)):
        (region,) = detect(spot(place=place), 0.001)
        x, y, width, height = region.box
        assert abs(x + (width - 1) / 2 - place[0]) <= 1
        assert abs(y + (height - 1) / 2 - place[1]) <= 1
        # Twice the half-height region and more.
        assert min(width, height) > 2 * 2 * np.sqrt(2 * np.log(2)) * SIGMA


def test_contrast_counts_from_the_surroundings():
    image = spot(0.5, base=0.4)
    found = half_height_component(image, PLACE[1], PLACE[0])
    assert contrast(image, found, 0.9) == pytest.approx(0.5, rel=0.1)


def test_a_region_that_the_border_cuts_is_open():
    image = spot(place=(2, 45))
    assert not half_height_component(image, 45, 2).closed
    assert not detect(image, 0.001)
    assert len(detect(image, 0.001, isolated=False)) == 1


def test_a_clipped_plateau_does_not_crowd_out_other_peaks():
    """Each of its 3,000 pixels is a local maximum, and only so many are examined."""
    image = spot(0.8)
    image[5:35, 5:105] = 1.0
    assert image[5:35, 5:105].size > MAX_PEAKS
    assert [region.peak for region in detect(image, 0.001)] == [(5, 5), PLACE]


def test_what_shines_outside_the_view_is_no_peak():
    image, seen = spot(0.5) + spot(place=(20, 20)), np.ones((100, 140), dtype=bool)
    seen[:40, :40] = False
    for isolated in (True, False):
        assert [region.peak for region in detect(image, 0.001, isolated, seen)] == [PLACE]


# The shape of a peak --------------------------------------------------------------------------------------------------


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


def heavy(x, y):
    return 1 / (1 + x**2 / 200 + y**2 / 100) ** 2


ANY = (0.0, np.inf)
SHAPES = {
    "a Gaussian": (gaussian, 0.0, (0.0, 0.002), (-0.01, 0.01), True),
    "on a ground": (gaussian, 0.7, (0.0, 0.002), (-0.01, 0.01), True),
    "a heavy tail": (heavy, 0.05, ANY, (-np.inf, 0.0), True),
    "flat-topped": (near_miss, 0.05, ANY, (2 * HIGHLIGHT_WIDTH_EXCESS, np.inf), False),
    "bent": (ridge, 0.05, (1.5 * HIGHLIGHT_ELLIPSE_RESIDUAL, np.inf), (-np.inf, np.inf), False),
}


@pytest.mark.parametrize("name", SHAPES)
def test_residual_and_excess_tell_a_highlight_from_a_near_miss_and_a_ridge(name):
    height, pedestal, residual, excess, is_highlight = SHAPES[name]
    shape = shape_of(frame_of(height, pedestal))
    assert residual[0] <= shape.residual <= residual[1]
    assert excess[0] <= shape.width_excess <= excess[1]
    assert shape.is_highlight == is_highlight


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
