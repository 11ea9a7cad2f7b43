"""The study that fits the factors of ripples and bends: its fields, its glints, and the factor that it reads off."""

import numpy as np
import pytest

from studies.ripples_fit.__main__ import AXES, STATED, Seen, _beyond, _factor, _least, _stated, _table
from studies.ripples_fit.fields import draw


def test_a_field_follows_its_number_and_its_slope_is_a_gradient():
    field, again, other = draw(3), draw(3), draw(4)
    points = np.array([[100.5, 80.5], [33.0, 200.0]])
    np.testing.assert_array_equal(field.slope(points), again.slope(points))
    assert not np.allclose(field.slope(points), other.slope(points))
    step = 1e-4
    for axis in np.eye(2):
        moved = (field.slope(points + step * axis) - field.slope(points - step * axis)) / (2 * step)
        np.testing.assert_allclose(field.bend(points) @ axis, moved, atol=1e-8)
    np.testing.assert_allclose(field.bend(points), field.bend(points).transpose(0, 2, 1))


def test_glints_are_the_points_of_slope_0_among_the_pixels():
    field = draw(3)
    x, y = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    pixels = np.array([x.ravel(), y.ravel()]).T
    brightest = pixels[np.argmin(np.linalg.norm(field.slope(pixels), axis=1))]
    around = pixels[np.abs(pixels - brightest).max(axis=1) < 4]
    glints = field.glints(around)
    assert len(glints) == 1
    assert np.linalg.norm(field.slope(glints)) < 1e-6
    assert np.abs(glints[0] - brightest).max() < 2
    assert not len(field.glints(around + 40.0 * (1 if brightest[0] < 160 else -1)))


def drawn(factor, count=1200, axis=AXES[0]):
    """Errors of which ripples tell the variance to this factor, beside a known noise."""
    rng, made = np.random.default_rng(5), []
    for i in range(count):
        ripples = float(rng.uniform(0.5, 2.0))
        error = rng.standard_normal(2) * np.sqrt(0.2 + factor * ripples)
        none = np.zeros((2, 2))
        made.append(Seen(i % 40, "8 bits", axis, error, 0.2 * np.eye(2), ripples * np.eye(2), none, 0.0))
    return made


@pytest.mark.parametrize("factor", [3.0, 11.0])
def test_a_factor_is_found_again_with_an_interval_about_it(factor):
    seen = drawn(factor)
    least = np.sort(_least(seen, "ripples"))[int(0.95 * len(seen))]
    assert least == pytest.approx(factor, rel=0.15)
    found = _factor(seen, "ripples")
    low, high = (float(part) for part in found.partition("(")[2].rstrip(")").split(" to "))
    assert low < factor < high
    assert high - low < 0.5 * factor


def test_a_region_needs_no_factor_or_none_suffices():
    seen = drawn(0.0, 200)
    assert np.median(_least(seen, "ripples")) == 0
    assert np.isinf(_least(seen, "bends")[_beyond(seen, np.zeros(200), np.zeros(200))]).sum() == 0
    far = [Seen(0, "8 bits", AXES[0], np.array([1.0, 0.0]), 1e-6 * np.eye(2), *[np.zeros((2, 2))] * 2, 0.0)]
    assert np.isinf(_least(far, "bends")).all()
    assert _beyond(far, *_stated(far)).all()


def test_the_table_has_each_axis_and_each_picture():
    text = "\n".join(_table([each for axis in AXES for each in drawn(STATED[axis].ripples, 200, axis)]))
    for name in (*AXES, "8 bits", "all", "colonoscope_hd"):
        assert name in text
