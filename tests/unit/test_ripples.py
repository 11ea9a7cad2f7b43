"""Ripples of isophotes: measured as drawn, silent under white noise, and covering what correlated noise does."""

import cv2
import numpy as np
import pytest

from simtest.calibration import LIGHT_AT_CAMERA
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.budget import HARMONICS, excess, ripples, spectrum
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.family import fit_isophote_family
from simtest.geometry import Camera, Patch, smooth
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime import chi_squared

CAMERA = Camera(120, 100, 300.0, 300.0, 60.0, 50.0)
SMOOTHING_PX = 2.0
CENTRE = np.array([59.3, 50.8])
QUANTILE = chi_squared.quantile(0.95, 2)


def lobe(seed: int, noise: float, blur_px: float = 0.0) -> Patch:
    """Return an elliptic lobe with noise of a standard deviation; blurred noise keeps it, and is told as white."""
    x, y = CAMERA.pixel_centres()[..., 0] - CENTRE[0], CAMERA.pixel_centres()[..., 1] - CENTRE[1]
    values = np.exp(-(x**2 / 9.0**2 + y**2 / 7.0**2 + x * y / 20.0**2) / 2)
    drawn = np.random.default_rng(seed).standard_normal(values.shape).astype(np.float32)
    if blur_px:
        drawn = cv2.GaussianBlur(drawn, (0, 0), blur_px)
        drawn /= drawn.std()
    raw = (values + noise * drawn).astype(np.float32)
    patch = Patch.cut(
        smooth(raw, SMOOTHING_PX), (0, 0, 120, 100), raw=raw, noise=noise, smoothing_px=SMOOTHING_PX, others_px=()
    )
    assert isinstance(patch, Patch)
    return patch


def coverage(estimator, patches, without: tuple[str, ...] = ()) -> float:
    truth, held = -CAMERA.unproject(CENTRE), []
    for patch in patches:
        estimate = estimator.estimate(patch, CAMERA, LIGHT_AT_CAMERA)
        assert not isinstance(estimate, Failure)
        covariance = sum(part for name, part in estimate.budget.items() if name not in without)
        miss = tangent_coordinates(estimate.normal, truth)
        held.append(miss @ np.linalg.solve(covariance, miss) <= QUANTILE)
    return float(np.mean(held))


@pytest.mark.parametrize("harmonic", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("points", [40, 203])
def test_a_ripple_is_measured_as_it_was_drawn(harmonic, points):
    rng = np.random.default_rng(points)
    phase = np.sort(rng.uniform(0, 2 * np.pi, points) / 20 + np.arange(points) * 2 * np.pi / points)
    radius = 1 + 0.01 * np.cos(harmonic * phase) - 0.02 * np.sin(harmonic * phase)
    # An ellipse of half-axes 0.05 and 0.03 about (0.01, -0.02); phases are those in which it is the unit circle.
    circle = radius * np.array([np.cos(phase), np.sin(phase)])
    x, y = 0.05 * circle[0] + 0.01, 0.03 * circle[1] - 0.02
    a, c = 1 / 0.05**2, 1 / 0.03**2
    conic = np.array([a, 0.0, c, -2 * a * 0.01, 2 * c * 0.02]) / (1 - a * 0.01**2 - c * 0.02**2)
    order = rng.permutation(points)
    found = ripples(np.array([x, y])[:, order], conic[None], np.array([points]))[0]
    drawn = np.where(harmonic == HARMONICS, 0.01 + 0.02j, 0)
    np.testing.assert_allclose(found, drawn, atol=3e-3)


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
