"""Regions of peaks: their area, box and contrast, and how far above the noise a peak must stand."""

import numpy as np
import pytest

from simtest.detection.peaks import MAX_PEAKS, contrast, detect, half_height_component

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
