"""What isophotes show of their own errors: noise carried through smoothing, ripples as drawn, bends of melted ones."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.calibration import LIGHT_AT_CAMERA
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.budget import (
    HARMONICS,
    MELTED,
    MELTED_RESIDUAL,
    bend_variance,
    excess,
    gram,
    raw_moves,
    ripples,
    spectrum,
)
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.family import OF_MEAN, OF_PEAK, fit_isophote_family
from simtest.estimators.isophotes import IsophotesAcross
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime import chi_squared

# Ripples: measured as drawn, silent under white noise, and covering what correlated noise does ------------------------


CAMERA = Camera(120, 100, 300.0, 300.0, 60.0, 50.0)
CENTRE = np.array([59.3, 50.8])
QUANTILE = chi_squared.quantile(0.95, 2)


def cut(values, seed, noise, smoothing_px, blur_px=0.0, **given):
    """Return a patch of values with noise of a standard deviation; blurred noise keeps it, and is told as white."""
    drawn = np.random.default_rng(seed).standard_normal(values.shape).astype(np.float32)
    if blur_px:
        drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px)
        drawn /= drawn.std()
    raw = (values + noise * drawn).astype(np.float32)
    patch = Patch.cut(
        smooth(raw, smoothing_px), (0, 0, 120, 100), raw=raw, noise=noise, smoothing_px=smoothing_px, **given
    )
    assert isinstance(patch, Patch)
    return patch


def lobe(seed, noise, blur_px=0.0):
    """Return an elliptic lobe."""
    x, y = np.moveaxis(CAMERA.pixel_centres() - CENTRE, -1, 0)
    values = np.exp(-(x**2 / 9.0**2 + y**2 / 7.0**2 + x * y / 20.0**2) / 2)
    return cut(values, seed, noise, 2.0, blur_px, others_px=())


def melted(seed, noise, second=None):
    """Return a round lobe, perhaps with a second one: its offset, px, and its height."""
    pixels = CAMERA.pixel_centres() - CENTRE
    values = np.exp(-np.sum(pixels**2, axis=-1) / (2 * 4.0**2))
    if second is not None:
        values += second[2] * np.exp(-np.sum((pixels - second[:2]) ** 2, axis=-1) / (2 * 3.0**2))
    return cut(values, seed, noise, 1.0)


def distance2(estimate, without=()):
    """Return the squared Mahalanobis distance of the true normal by the budget's parts but some."""
    covariance = sum(part for name, part in estimate.budget.items() if name not in without)
    miss = tangent_coordinates(estimate.normal, -CAMERA.unproject(CENTRE))
    return float(miss @ np.linalg.solve(covariance, miss))


def coverage(estimator, patches, without=()):
    made = [estimator.estimate(patch, CAMERA, LIGHT_AT_CAMERA) for patch in patches]
    return np.mean([distance2(estimate, without) <= QUANTILE for estimate in made])


@pytest.mark.parametrize("points", [40, 203])
def test_a_ripple_is_measured_as_it_was_drawn(points):
    rng = np.random.default_rng(points)
    phase = np.sort(rng.uniform(0, 2 * np.pi, points) / 20 + np.arange(points) * 2 * np.pi / points)
    # An ellipse of half-axes 0.05 and 0.03 about (0.01, -0.02); phases are those in which it is the unit circle.
    a, c = 1 / 0.05**2, 1 / 0.03**2
    conic = np.array([a, 0.0, c, -2 * a * 0.01, 2 * c * 0.02]) / (1 - a * 0.01**2 - c * 0.02**2)
    for harmonic in range(3, 8):
        radius = 1 + 0.01 * np.cos(harmonic * phase) - 0.02 * np.sin(harmonic * phase)
        x, y = [[0.05], [0.03]] * radius * [np.cos(phase), np.sin(phase)] + [[0.01], [-0.02]]
        order = rng.permutation(points)
        found = ripples(np.array([x, y])[:, order], conic[None], np.array([points]))[0]
        np.testing.assert_allclose(found, np.where(harmonic == HARMONICS, 0.01 + 0.02j, 0), atol=3e-3)


def test_spectrum_of_white_noise_on_a_circle():
    """A simulation: the harmonics of smoothed white noise along a circle of 6 px radius."""
    rng, s, r = np.random.default_rng(0), 2.0, 6.0
    angle = np.arange(64) * 2 * np.pi / 64
    at = np.array([32 + r * np.cos(angle), 32 + r * np.sin(angle)]).astype(np.float32)
    power = np.zeros(7)
    for _ in range(1500):
        field = cv2.GaussianBlur(rng.standard_normal((64, 64)).astype(np.float32), (0, 0), s)
        power += np.abs(np.fft.rfft(cv2.remap(field, at[0], at[1], cv2.INTER_CUBIC).ravel())[:7]) ** 2
    np.testing.assert_allclose(spectrum((r / s) ** 2), power[4:] / power[1], rtol=0.15)
    np.testing.assert_allclose(spectrum(1e6), 1)


def test_white_noise_alone_says_nothing():
    patches = [lobe(seed, 0.02) for seed in range(60)]
    silent = [not fit_isophote_family(patch, CAMERA, CONE_AXIS_ISOVALUES).ripple_error.any() for patch in patches]
    assert np.mean(silent) > 0.8
    # Without noise, what interpolation leaves counts for less than a fiftieth of a pixel.
    family = fit_isophote_family(lobe(0, 1e-7), CAMERA, CONE_AXIS_ISOVALUES)
    assert np.sqrt(17 * np.trace(family.ripple_error)) < 0.02 / 300
    one = np.zeros((3, 3), dtype=complex)
    assert excess(one, np.full(3, 1 / 3), np.ones(3), 0.0, 100.0, 0.0) == 0


def test_correlated_noise_that_is_told_as_white_is_covered():
    patches = [lobe(seed, 0.02, blur_px=2.0) for seed in range(80)]
    assert coverage(cone_axis, patches) > 0.88
    # Negative control: by the noise alone it is not.
    assert coverage(cone_axis, patches, without=("resolution", "shape")) < 0.7


def test_the_peak_states_what_noise_does_to_it():
    patches = [lobe(seed, 0.02) for seed in range(120)]
    assert 0.9 <= coverage(brightest_point, patches) <= 1
    semi = [np.trace(brightest_point.estimate(p, CAMERA, LIGHT_AT_CAMERA).covariance) / 2 for p in patches]
    errors = [tangent_coordinates(-CAMERA.unproject(p.peak_px), -CAMERA.unproject(CENTRE)) for p in patches]
    assert np.sqrt(np.median(semi)) < 2 * np.sqrt(np.mean(np.square(errors)))


# Bends: melted highlights state a share of their size, single ones nothing --------------------------------------------


ROUND = np.diag([1e-4, 1e-4])


@pytest.mark.parametrize("estimator", [cone_axis, curved], ids=["cone_axis", "curved"])
@pytest.mark.parametrize("second", [(6.0, 2.0, 0.5), (5.5, -3.0, 0.6), (-4.0, 6.0, 0.5)])
def test_a_near_miss_beside_the_glint_is_in_the_budget(estimator, second):
    estimate = estimator.estimate(melted(1, 0.002, second), CAMERA, LIGHT_AT_CAMERA)
    assert distance2(estimate) < QUANTILE
    # Negative control: noise and ripples alone are wrong and sure.
    assert distance2(estimate, ("shape",)) > QUANTILE


def test_a_single_highlight_has_no_bend_whatever_the_noise():
    for noise in (0.0005, 0.005, 0.03):
        for seed in range(20):
            family = fit_isophote_family(melted(seed, noise), CAMERA, CONE_AXIS_ISOVALUES)
            assert np.trace(family.bend_error()) < 0.1 * np.trace(family.axis_budget["noise"])
    both = fit_isophote_family(melted(0, 0.005, (6.0, 2.0, 0.5)), CAMERA, CONE_AXIS_ISOVALUES)
    assert np.trace(both.bend_error()) > 10 * np.trace(both.axis_budget["noise"])


@given(st.floats(0.001, 0.3), st.floats(0, 0.3), st.sampled_from([OF_MEAN.bends, OF_PEAK.bends]))
def test_more_bend_is_never_less_error_and_noise_is_no_bend(residual, more, slope):
    def share(bend, noise=0.0):
        return np.sqrt(bend_variance(np.array([bend, 2 * bend]), np.array([noise, noise]), ROUND, slope) / 1e-4)

    assert share(residual + more) >= share(residual) * (1 - 1e-12)
    assert share(residual, residual) == 0
    assert share(MELTED_RESIDUAL) == pytest.approx(MELTED)
    assert share(MELTED_RESIDUAL / 2) < MELTED / 10
    assert share(0.2) == pytest.approx(0.2 * slope)


def test_moments_that_are_none_give_no_error():
    assert bend_variance(np.array([0.1]), np.array([0.0]), np.diag([1e-4, -1e-5]), OF_MEAN.bends) == 0


# Noise of quantities that are linear in smoothed pixels, against the smoothing written out as a matrix ----------------


SIZE, SMOOTHING = 41, 2.0


def test_the_product_with_the_transpose_is_the_covariance():
    rows = np.random.default_rng(0).normal(size=(3, 500)).astype(np.float32)
    np.testing.assert_allclose(gram(rows), rows.astype(float) @ rows.T.astype(float), rtol=1e-5)


@pytest.mark.parametrize("kind", ["one number", "a map"])
def test_raw_pixels_move_what_smoothed_pixels_move(kind):
    random = np.random.default_rng(1)
    # The margin of the kernel lies inside the patch.
    rows, columns = random.integers(15, 26, 12), random.integers(15, 26, 12)
    moves = random.normal(size=(2, 12))
    # A map that changes slowly: beyond the pixels the value at their edge is taken.
    slow = np.float32(0.02) * (1 + np.linspace(-0.3, 0.3, SIZE, dtype=np.float32)) * np.ones((SIZE, 1), np.float32)
    noise = 0.02 if kind == "one number" else slow
    found = gram(raw_moves(rows * SIZE + columns, moves, SIZE, noise, SMOOTHING))
    impulses = np.eye(SIZE * SIZE, dtype=np.float32).reshape(-1, SIZE, SIZE)
    near = [i for i in range(SIZE * SIZE) if 5 <= i // SIZE < 36 and 5 <= i % SIZE < 36]
    smoothed = np.stack([smooth(impulses[i], SMOOTHING)[rows, columns] for i in near]).astype(float)
    each = (smoothed @ moves.T) * np.broadcast_to(noise, (SIZE, SIZE)).ravel()[near, None]
    wanted = each.T @ each
    assert np.abs(found - wanted).max() < (5e-3 if kind == "one number" else 0.02) * np.abs(wanted).max()


@pytest.mark.parametrize(("square", "expected"), [(1.0, True), (-1.0, False)])
@pytest.mark.parametrize("centre", [(0.1, -0.2), (1.0, 2.0), (-3.0, 0.5)])
def test_ellipses_are_told_from_those_without_a_real_point(centre, square, expected):
    """(x - m)^T A (x - m) = square has real points where A and the square are positive, wherever it lies."""
    A, m = np.array([[0.6, 0.25], [0.25, 1.1]]), np.array(centre)
    right = square - m @ A @ m
    a, b, c, d, e = np.array([A[0, 0], 2 * A[0, 1], A[1, 1], *(-2 * A @ m)]) / right
    given = SimpleNamespace(conics=np.array([[a, b, c, d, e], [1.0, 3.0, 1.0, 0.0, 0.0]]))
    assert IsophotesAcross.are_ellipses.func(given).tolist() == [expected, False]
