"""The gradient-weighted fit of arcs: derivatives, exact recovery, less bias than the algebraic fit, refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.errors import Failure, Reason
from simtest.estimators.isophotes import FittedIsophote, fit_cut_isophote
from simtest.geometry import Camera, FittedArc, Patch, ellipse_of_conic, fit_arc, fit_ellipse, smooth
from simtest.geometry.ellipse_fit import _residuals
from tests.example_counts import examples


def arc_points(a, b, extent_deg, count=60, centre=(30.0, 20.0), middle=0.4, turn=0.7):
    phase = middle + np.radians(extent_deg) * (np.linspace(0, 1, count) - 0.5)
    local = np.stack([a * np.cos(phase), b * np.sin(phase)], axis=1)
    cos, sin = np.cos(turn), np.sin(turn)
    return np.asarray(centre) + local @ np.array([[cos, sin], [-sin, cos]])


def test_derivatives_are_those_of_finite_differences():
    xy, parameters = arc_points(1.2, 0.8, 200, centre=(0.1, -0.2)), np.array([0.05, -0.1, 0.9, 0.2, 1.1])
    _, J = _residuals(xy, parameters)
    for k, step in enumerate(1e-6 * np.eye(5)):
        numeric = (_residuals(xy, parameters + step)[0] - _residuals(xy, parameters - step)[0]) / 2e-6
        np.testing.assert_allclose(J[:, k], numeric, atol=1e-7)


@settings(max_examples=examples(60), deadline=None, derandomize=True)
@given(st.floats(0.2, 1), st.floats(150, 360), st.floats(0, 6), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_exact_arcs_are_recovered(ratio, extent, middle, turn, log_scale):
    scale = 10**log_scale
    points = scale * arc_points(10.0, 10.0 * ratio, extent, middle=middle, turn=turn)
    found = fit_arc(points)
    assert isinstance(found, FittedArc)
    ellipse = ellipse_of_conic(found.conic.image)
    np.testing.assert_allclose(ellipse.centre, [30 * scale, 20 * scale], rtol=1e-5)
    np.testing.assert_allclose([ellipse.semi_major, ellipse.semi_minor], [10 * scale, 10 * ratio * scale], rtol=1e-5)
    assert found.residual < 1e-6
    assert np.degrees(found.arc) == pytest.approx(extent if extent < 355 else 354.5, abs=6.5)


@pytest.mark.parametrize("extent", [180, 150])
def test_arcs_shrink_less_than_by_the_algebraic_fit(extent):
    """Negative control of the choice of fit: over noise of 2 % the algebraic major axis is too short by far."""
    rng, lengths = np.random.default_rng(5), {"arc": [], "algebraic": []}
    for _ in range(150):
        points = arc_points(10.0, 8.0, extent, middle=np.pi / 2, count=80) + 0.2 * rng.normal(size=(80, 2))
        whole, arc = fit_ellipse(points), fit_arc(points)
        if not isinstance(whole, Failure) and not isinstance(arc, Failure):
            lengths["arc"].append(ellipse_of_conic(arc.conic.image).semi_major)
            lengths["algebraic"].append(ellipse_of_conic(whole.image).semi_major)
    assert len(lengths["arc"]) > 140
    bias = {name: abs(np.median(values) / 10 - 1) for name, values in lengths.items()}
    assert bias["arc"] < 0.02
    assert bias["algebraic"] > 2 * bias["arc"]


def test_short_arcs_lines_and_hyperbolas_are_refused():
    short = fit_arc(arc_points(10, 8, 90))
    assert isinstance(short, Failure)
    assert short.reason is Reason.TOO_FEW_POINTS
    t = np.linspace(-1, 1, 30)
    for points in (np.stack([t, 2 * t], axis=1), np.stack([np.cosh(t), np.sinh(t)], axis=1), np.zeros((9, 2))):
        assert isinstance(fit_arc(points), Failure)


def test_a_cut_isophote_is_the_whole_one_away_from_the_cut():
    y, x = np.mgrid[:80, :100] + 0.5
    values = np.exp(-((x - 50.3) ** 2) / 200 - (y - 39.6) ** 2 / 300)
    whole, part = Patch.cut(values, (0, 0, 100, 80)), Patch.cut(values, (0, 0, 52, 80), smoothing_px=2.0)
    assert isinstance(part.crossings(0.5), Failure)
    points = part.arc(0.5)
    seen = {tuple(point) for point in np.round(whole.crossings(0.5 * part.peak_value / whole.peak_value), 9)}
    assert {tuple(point) for point in np.round(points, 9)} <= seen
    # 1.5 times the smoothing's width from the cut.
    assert 52 - 4.5 <= points[:, 0].max() <= 52 - 3
    moved = part.traced([0.5], [True])
    assert len(moved.by_level) == len(points)
    outline = part.inside(0.5, cut=True)
    assert outline[40, 51]
    assert not outline[2, 51]


@pytest.mark.parametrize(("noise", "radius", "seed"), [(0.004, 120, 4), (0.02, 115, 0), (0.02, 120, 0), (0.02, 120, 1)])
def test_an_isophote_seen_in_one_far_corner_alone_is_refused(noise, radius, seed):
    # A wide lobe over a bright base: at t = 0.4 its isophote passes through one corner of the frame, and what is seen
    # of it there fits streaks whose axis is off by 20 to 30 deg.
    side = 160
    camera = Camera(side, side, 160.0, 160.0, 80.0, 80.0)
    y, x = np.mgrid[:side, :side] + 0.5
    squared = ((x - 56) ** 2 + (y - 66) ** 2) / radius**2
    light = 0.35 + 0.65 * np.exp(squared * np.log(0.05 / 0.65))
    light += np.random.default_rng(seed).normal(0, noise, light.shape)
    patch = Patch.cut(smooth(light, 2.0), (0, 0, side, side))
    assert isinstance(fit_cut_isophote(patch, camera, 0.4), Failure)
    assert isinstance(fit_cut_isophote(patch, camera, 0.6), FittedIsophote)
