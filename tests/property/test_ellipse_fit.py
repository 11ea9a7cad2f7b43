"""Fits of ellipses and arcs: exact recovery, invariances, other implementations, refusals."""

import cv2
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from skimage.measure import EllipseModel

from simtest.errors import Failure, InputError, Reason
from simtest.estimators.isophotes import FittedIsophote, fit_cut_isophote
from simtest.geometry import (
    Camera,
    FittedArc,
    FittedConic,
    Patch,
    ellipse_of_conic,
    fit_arc,
    fit_ellipse,
    fit_ellipses,
    smooth,
)
from simtest.geometry.ellipse_fit import _residuals
from tests.example_counts import examples


def ellipse_points(centre, a, b, angle, phase):
    cos, sin = np.cos(angle), np.sin(angle)
    local = np.stack([a * np.cos(phase), b * np.sin(phase)], axis=1)
    return np.asarray(centre) + local @ np.array([[cos, sin], [-sin, cos]])


def phases(count, start=0.3):
    return start + 2 * np.pi * np.arange(count) / count


def parameters(fitted):
    """Return centre, half-axes and angle in pixels, through the centred coordinates, which keep their digits."""
    assert isinstance(fitted, FittedConic), fitted
    ellipse = ellipse_of_conic(fitted.normalised)
    T = fitted.normalised_from_image
    scale, turn = np.sqrt(np.linalg.det(T[:2, :2])), np.arctan2(T[0, 1], T[0, 0])
    centre = np.linalg.solve(T[:2, :2], ellipse.centre - T[:2, 2])
    return centre, ellipse.semi_major / scale, ellipse.semi_minor / scale, ellipse.angle + turn


def check(points, centre, a, b, angle, digits):
    """Compare a fit with the truth; `digits` is the relative error allowed, per half-axis."""
    found_centre, found_a, found_b, found_angle = parameters(fit_ellipse(points))
    assert np.abs(found_centre - centre).max() < digits * a
    assert abs(found_a / a - 1) < digits
    assert abs(found_b / b - 1) < digits * (a / b)
    if a / b > 1.01:
        assert abs((found_angle - angle + np.pi / 2) % np.pi - np.pi / 2) < digits * 10 / (1 - b / a)


@settings(max_examples=examples(400), deadline=None, derandomize=True)
@given(
    st.floats(-1000, 1000), st.floats(-1000, 1000), st.floats(0, 3), st.floats(0.05, 1), st.floats(-1.57, 1.57),
    st.integers(6, 60), st.floats(0, 6),
)  # fmt: skip
def test_exact_points_are_recovered(x, y, log_a, ratio, angle, count, start):
    a = 10**log_a
    points = ellipse_points((x, y), a, ratio * a, angle, phases(count, start))
    # The points themselves are rounded to 1e-16 of their coordinates.
    check(points, (x, y), a, ratio * a, angle, digits=1e-9 / ratio**2 + 1e-12 * (abs(x) + abs(y)) / a / ratio**2)


@pytest.mark.parametrize(("ratio", "count"), [(1.0, 6), (0.7, 7), (0.3, 24)])
def test_small_ellipse_far_from_the_origin(ratio, count):
    points = ellipse_points((5000, 5000), 3, 3 * ratio, 0.4, phases(count))
    check(points, (5000, 5000), 3, 3 * ratio, 0.4, digits=1e-11 / ratio**2)


@pytest.mark.parametrize("scale", [1e-9, 1e30, 1e100])
def test_scale_does_not_matter(scale):
    points = ellipse_points((2, -1), 3, 1.5, -0.7, phases(20))
    check(points * scale, np.array([2, -1]) * scale, 3 * scale, 1.5 * scale, -0.7, digits=1e-12)


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.floats(-3, 3), st.floats(-3, 3), st.floats(-500, 500), st.floats(-500, 500))
def test_a_similarity_of_the_points_is_one_of_the_fit(seed, turn, log_scale, shift_x, shift_y):
    """4 a c - b^2 changes by a factor under a similarity, so the minimum moves along, noise included."""
    rng = np.random.default_rng(seed)
    points = ellipse_points((0, 0), 2, 1, 0.5, phases(30)) + 0.05 * rng.normal(size=(30, 2))
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    scale, shift = 10**log_scale, np.array([shift_x, shift_y])
    centre, a, b, angle = parameters(fit_ellipse(points))
    moved = parameters(fit_ellipse(scale * points @ rotation.T + shift))
    digits = 1e-9 + 1e-11 * np.abs(shift).max() / scale
    np.testing.assert_allclose(moved[0], scale * rotation @ centre + shift, atol=digits * scale, rtol=1e-12)
    np.testing.assert_allclose(moved[1:3], [scale * a, scale * b], rtol=digits)
    assert abs((moved[3] - angle - turn + np.pi / 2) % np.pi - np.pi / 2) < 10 * digits


def plain_fit(points):
    """Fit as in the 1999 paper: the 6 x 6 generalised eigenproblem S a = l C a, the one positive l."""
    x, y = points.T
    D = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
    C = np.zeros((6, 6))
    C[0, 2] = C[2, 0] = 2
    C[1, 1] = -1
    values, vectors = scipy.linalg.eig(C, D.T @ D)
    a, b, c, d, e, f = np.real(vectors[:, int(np.argmax(values.real))])
    return np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])


@pytest.mark.parametrize("seed", range(4))
def test_agreement_with_other_implementations(seed):
    rng = np.random.default_rng(seed)
    a, b, angle = rng.uniform(5, 60), rng.uniform(3, 5), rng.uniform(-1.5, 1.5)
    # Half of the cases are arcs, where algebraic fits are biased: all must be biased alike.
    arc = phases(80) if seed % 2 else np.linspace(0, 4, 80)
    points = ellipse_points((300, 200), a, b, angle, arc) + rng.normal(0, 0.1, (80, 2))
    centre, found_a, found_b, found_angle = parameters(fit_ellipse(points))

    offset = points.mean(axis=0)
    other = ellipse_of_conic(plain_fit((points - offset) / 20))
    np.testing.assert_allclose(other.centre * 20 + offset, centre, atol=1e-7)
    np.testing.assert_allclose([other.semi_major * 20, other.semi_minor * 20], [found_a, found_b], rtol=1e-8)

    model = EllipseModel.from_estimate(points)
    np.testing.assert_allclose(model.center, centre, atol=1e-6)
    np.testing.assert_allclose(sorted(model.axis_lengths), [found_b, found_a], rtol=1e-6)

    (x, y), diameters, degrees = cv2.fitEllipseDirect(points.astype(np.float32))
    np.testing.assert_allclose((x, y), centre, atol=2e-3 * a)
    np.testing.assert_allclose(sorted(diameters), [2 * found_b, 2 * found_a], rtol=1e-2)
    # OpenCV counts the angle of the first diameter from the image's x axis.
    turned = np.radians(degrees) + (0 if diameters[0] > diameters[1] else np.pi / 2)
    assert abs((turned - found_angle + np.pi / 2) % np.pi - np.pi / 2) < 0.01


def test_conic_in_pixels_vanishes_on_the_points_and_is_positive_outside():
    points = ellipse_points((40, 30), 12, 5, 1.0, phases(40))
    conic = fit_ellipse(points).image
    on = np.column_stack([points, np.ones(40)])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", on, conic, on), 0, atol=1e-13)
    assert np.array([90, 90, 1]) @ conic @ [90, 90, 1] > 0
    assert np.array([40, 30, 1]) @ conic @ [40, 30, 1] < 0
    ellipse = ellipse_of_conic(-3 * conic)
    np.testing.assert_allclose(ellipse.centre, [40, 30], atol=1e-9)
    np.testing.assert_allclose([ellipse.semi_major, ellipse.semi_minor, ellipse.angle], [12, 5, 1.0], atol=1e-9)
    around = ellipse_points(ellipse.centre, ellipse.semi_major, ellipse.semi_minor, ellipse.angle, phases(30))
    around = np.column_stack([around, np.ones(30)])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", around, conic, around), 0, atol=1e-12)


LINE = np.stack([np.arange(20.0), 2 * np.arange(20.0) + 1], axis=1)
REFUSED = {
    "none": (np.empty((0, 2)), Reason.TOO_FEW_POINTS),
    "five": (ellipse_points((0, 0), 2, 1, 0, phases(5)), Reason.TOO_FEW_POINTS),
    "collinear": (LINE, None),
    "collinear, along x": (LINE * [1, 0], None),
    "collinear, far": (LINE * 1e-3 + 5000, None),
    "three points": (np.repeat([[1.0, 2], [3, 4], [0, 7]], 6, axis=0), None),
    "coincident": (np.full((9, 2), 3.7), Reason.DEGENERATE_CONIC),
    "a line but for its digits": (ellipse_points((0, 0), 1, 5e-5, 0.3, phases(40)), Reason.DEGENERATE_CONIC),
    "nan": (np.where(np.eye(9, 2) > 0, np.nan, 1.0), Reason.NOT_FINITE),
    "huge": (ellipse_points((0, 0), 2, 1, 0, phases(9)) * 1e200, None),
    "largest": (ellipse_points((0, 0), 0.9, 0.5, 0, phases(9)) * 1.7e308, None),
    "mixed": (ellipse_points((0, 0), 2, 1, 0, phases(9)) * [1e250, 1], None),
    "tiny": (ellipse_points((0, 0), 2, 1, 0, phases(9)) * 1e-200, None),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_ellipse_is_refused(name):
    points, reason = REFUSED[name]
    result = fit_ellipse(points)
    assert isinstance(result, Failure)
    assert reason is None or result.reason is reason


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((10, 3)), r"contour 0 has shape \(10, 3\): must be \(N, 2\)"),
        (5.0, r"shape \(\)"),
        (None, "contour 0"),
        ([[1.0, 2.0], [3.0]], "contour 0: must be numbers"),
    ],
    ids=range(4),
)
def test_what_is_no_list_of_points_is_malformed(points, message):
    with pytest.raises(InputError, match=message):
        fit_ellipse(points)
    good = ellipse_points((0, 0), 2, 1, 0, phases(9))
    with pytest.raises(InputError, match="contour 1"):
        fit_ellipses([good, points])


def sound(result):
    assert np.isfinite(result.normalised).all()
    assert np.isfinite(result.normalised_from_image).all()
    np.testing.assert_array_equal(result.normalised, result.normalised.T)
    values = parameters(result)
    assert np.isfinite(np.hstack(values)).all()
    assert values[1] >= values[2] > 0


def test_nothing_makes_it_raise():
    """Thousands of bad inputs: a conic that is an ellipse, or a Failure; no exception, no warning, no NaN."""
    rng = np.random.default_rng(0)
    kinds = {"ok": 0, "failure": 0}
    for i in range(1600):
        count = int(rng.integers(0, 20))
        points = rng.normal(size=(count, 2)) * 10.0 ** rng.uniform(-12, 12, 2)
        match i % 8:
            case 0:
                points = np.round(points)
            case 1 if count:
                points = points[rng.integers(0, count, count)]  # repeated points
            case 2:
                points[:, 1] = points[:, 0] * rng.normal() + 1e-13 * rng.normal(size=count)
            case 3:
                points = points + 10.0 ** rng.uniform(0, 18)
            case 4 if count:
                points[rng.integers(count), rng.integers(2)] = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e-308])
            case 5:
                t = rng.normal(size=count)
                points = np.stack([np.cosh(t), np.sinh(t)], axis=1) * 10.0 ** rng.uniform(-3, 3)
            case 6:
                points = rng.integers(0, 3, (count, 2)).astype(float)
            case 7:
                points = points * 10.0 ** rng.uniform(-300, 290)
        result = fit_ellipse(points)
        if isinstance(result, Failure):
            assert isinstance(result.reason, Reason)
            kinds["failure"] += 1
        else:
            sound(result)
            kinds["ok"] += 1
    assert min(kinds.values()) > 200


# Arcs -----------------------------------------------------------------------------------------------------------------


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


def test_arcs_are_fitted_as_by_minpack():
    """An independent check: MINPACK's lmder on the same residuals, over noise up to a seventh of the minor axis."""
    rng, compared = np.random.default_rng(6), 0
    for ratio, extent, noise in rng.uniform((0.3, 150, 0.01), (1, 330, 0.4), (60, 3)):
        points = arc_points(10.0, 10.0 * ratio, extent, count=60) + noise * rng.normal(size=(60, 2))
        arc, start = fit_arc(points), fit_ellipse(points)
        assert isinstance(start, FittedConic)
        if isinstance(arc, Failure):
            continue
        ellipse, T = ellipse_of_conic(start.normalised), start.normalised_from_image
        cos, sin = np.cos(ellipse.angle), np.sin(ellipse.angle)
        turn = np.array([[cos, -sin], [sin, cos]])
        L = np.linalg.cholesky(turn @ np.diag([ellipse.semi_major**-2, ellipse.semi_minor**-2]) @ turn.T)
        xy, p = points @ T[:2, :2].T + T[:2, 2], np.array([*ellipse.centre, L[0, 0], L[1, 0], L[1, 1]])
        found = least_squares(lambda q, xy=xy: _residuals(xy, q)[0], p, method="lm", xtol=1e-12, ftol=1e-12)
        L = np.array([[found.x[2], 0], found.x[3:]])
        np.testing.assert_allclose(
            -np.linalg.solve((C := arc.conic.normalised)[:2, :2], C[:2, 2]), found.x[:2], atol=1e-5
        )
        np.testing.assert_allclose(C[:2, :2] / C[0, 0], L @ L.T / (L @ L.T)[0, 0], rtol=1e-4, atol=1e-5)
        compared += 1
    assert compared > 50


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
