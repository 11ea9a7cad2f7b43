"""Relief below a pixel is roughness (theory.md, 7.6): widths of rendered highlights, by `studies.unresolved_relief`."""

import math

import pytest

from studies import unresolved_relief as study

pytestmark = [pytest.mark.render, pytest.mark.slow]

LIMIT = 0.03


def test_the_relief_lies_below_a_third_of_a_pixel():
    assert study.WAVELENGTH_MM < study.DISTANCE_MM / study.FOCAL_PX / 3


@pytest.mark.parametrize("slope_deg", study.SLOPES_DEG)
@pytest.mark.parametrize("distribution", study.DISTRIBUTIONS)
def test_the_highlight_is_as_wide_as_theory_says(distribution, slope_deg):
    """Beckmann: as that of a rougher film; GGX: as the film's own lobe convolved with the slopes."""
    found = study.widening(distribution, slope_deg)
    assert abs(found.error) < LIMIT
    # Without the relief, or with s in place of 2 s^2, it would be seen to fail.
    assert found.smooth_deg < (1 - 5 * LIMIT) * found.seen_deg
    halved = study.convolved_half_width_deg(study.ALPHA, distribution, slope_deg / math.sqrt(2))
    assert halved < (1 - LIMIT) * found.seen_deg


@pytest.mark.parametrize("distribution", study.DISTRIBUTIONS)
def test_without_relief_the_width_is_the_closed_forms(distribution):
    rendered = study.half_width_deg(study.ALPHA, distribution, 0.0)
    assert rendered == pytest.approx(study.convolved_half_width_deg(study.ALPHA, distribution, 0.0), rel=5e-3)


@pytest.mark.parametrize("slope_deg", study.SLOPES_DEG)
def test_the_rule_of_variances_misses_ggx(slope_deg):
    """By more than 16 %: why the convolution is taken there."""
    found = study.widening("ggx", slope_deg)
    assert found.variances_deg < (1 - 0.16) * found.seen_deg


@pytest.mark.parametrize("alpha", [0.02, 0.05, 0.1])
def test_the_numerical_convolution_of_a_gaussian_lobe_is_the_rule(alpha):
    """Beckmann's lobe over slopes: alpha^2 + 2 s^2, but for terms of the order of the slopes squared."""
    for slope_deg in (1.0, 3.0):
        rougher = math.sqrt(alpha**2 + 2 * math.radians(slope_deg) ** 2)
        expected = study.convolved_half_width_deg(rougher, "beckmann", 0.0)
        assert study.convolved_half_width_deg(alpha, "beckmann", slope_deg) == pytest.approx(expected, rel=rougher**2)
