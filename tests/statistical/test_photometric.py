"""`photometric`: derivatives, the Cramer-Rao bound in the published protocol, and curved surfaces in renders."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, NoiseModel
from simtest.errors import Failure
from simtest.estimators.least_squares import fit_lobe
from simtest.estimators.photometric import ColocatedQuadric, HighlightPixels, photometric
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import render_view
from simtest.spec import scene_from_dict
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.plane_from_aside import PlaneFromAside, photometric_plane
from simtest.validation.paper.predictions import cramer_rao_bound
from simtest.validation.paper.protocol import Pipeline
from simtest.validation.scoring import mahalanobis2
from tests.marked import marked

ALPHA = 1e-3


def models():
    rng = np.random.default_rng(3)
    rays = np.concatenate([rng.normal(0, 0.05, (60, 2)), np.ones((60, 1))], axis=1)
    tilted = np.array([0.1, 0.6, -0.79]) / np.linalg.norm([0.1, 0.6, -0.79])
    yield PlaneFromAside(rays, tilted, np.array([0.01, 0.02, 1.0]), np.log(50.0), 0.1)
    turn = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))[0]
    yield ColocatedQuadric(rays, turn * np.sign(turn[2, 2]), np.array([0.4, 0.2, -0.3]), 0.1, 50.0)


@pytest.mark.parametrize("model", models(), ids=lambda model: type(model).__name__)
def test_derivatives_are_those_of_finite_differences(model):
    _, J = model.evaluate()
    for k, step in enumerate(1e-6 * np.eye(6)):
        numeric = (model.moved(step).evaluate()[0] - model.moved(-step).evaluate()[0]) / 2e-6
        np.testing.assert_allclose(J[:, k], numeric, atol=1e-6 * np.abs(J[:, k]).max())


@cache
def pipeline_of(setting):
    return Pipeline(setting)


@cache
def answer(setting, number):
    """The answer to one realisation; realisations of the default setting serve two tests."""
    return photometric_plane.estimate(pipeline_of(setting).patch(from_integer(number)), setting.camera)


def answers(setting, count):
    return [answer(setting, number) for number in range(count)]


@pytest.mark.parametrize(
    "values",
    marked(
        [{}, {"sigma": 0.01}, {"sigma": 0.1}, {"theta_deg": 30.0}, {"theta_deg": 75.0}],
        ci=[{"sigma": 0.01}, {"sigma": 0.1}, {"theta_deg": 30.0}],
    ),
)
def test_published_protocol_is_solved_to_its_bound(values):
    """RMS angle within 1.2 of the Cramer-Rao bound; not below it by more than chance; the right candidate."""
    count, setting = 40, PaperSetting(**values)
    made = answers(setting, count)
    assert not any(isinstance(estimate, Failure) for estimate in made)
    squared = [np.radians(angle_deg(estimate.normal, setting.normal)) ** 2 for estimate in made]
    ratio = np.sqrt(np.mean(squared)) / cramer_rao_bound(setting)
    assert ratio < 1.2
    # Two unequal squares a realisation: at most as spread as one of a chi-square of one degree.
    assert ratio**2 > chi2.ppf(ALPHA, count) / count
    assert all(estimate.choice_margin > 5 for estimate in made)


def test_regions_cover_the_truth():
    """95 % regions: hits of 200 realisations in the binomial's range at alpha 0.001; a halved sigma is found out."""
    setting = PaperSetting()
    distances = np.array([mahalanobis2(estimate, setting.normal) for estimate in answers(setting, 200)])
    quantile = chi2.ppf(0.95, 2)
    assert 0.89 < np.mean(distances < quantile) < 0.99
    assert np.mean(4 * distances < quantile) < 0.6


@pytest.mark.ci
def test_noise_that_coding_or_demosaicing_has_correlated_widens_the_region(monkeypatch):
    """White noise of 3 % blurred by 1 px; the residuals alone show a third of what it does to the normal."""
    camera = Camera(110, 110, 250.0, 250.0, 55.0, 55.0)
    axis = np.array([0.02, 0.03, 1.0]) / np.linalg.norm([0.02, 0.03, 1.0])
    lobe = np.clip(2 * (camera.unproject(camera.pixel_centres()) @ axis) ** 2 - 1, 0, None) ** 60
    known = Calibration(camera, noise=NoiseModel(0.0085), priors=replace(LIGHT_AT_CAMERA, falloff_power=None))
    inside, alone = [], []
    for seed in range(100):
        noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(lobe.shape), None, 1.0)
        found = Frame((lobe + 0.03 * noise).astype(np.float32), known, 2.0).patch((0, 0, 110, 110))
        patch = replace(found, others_px=())
        estimate = photometric.estimate(patch, camera, known.priors)
        assert "misfit" not in estimate.flags
        inside.append(mahalanobis2(estimate, -axis) < chi2.ppf(0.95, 2))
        with monkeypatch.context() as taken_for_white:
            taken_for_white.setattr(HighlightPixels, "correlation", lambda *_: 1.0)
            white = photometric.estimate(patch, camera, known.priors)
        alone.append(mahalanobis2(white, -axis) < chi2.ppf(0.95, 2))
    assert 0.90 <= np.mean(inside) <= 0.99, np.mean(inside)
    # Negative control.
    assert np.mean(alone) < 0.75


@pytest.mark.ci
def test_noise_that_grows_with_the_light_is_covered(monkeypatch):
    """100 electrons at the peak: the flanks, which place the lobe, are noisier than the pixels of the mean residual."""
    camera = Camera(110, 110, 250.0, 250.0, 55.0, 55.0)
    axis = np.array([0.002, 0.003, 1.0]) / np.linalg.norm([0.002, 0.003, 1.0])
    lobe = np.clip(2 * (camera.unproject(camera.pixel_centres()) @ axis) ** 2 - 1, 0, None) ** 60
    known = Calibration(camera, noise=NoiseModel(full_well=100.0), priors=replace(LIGHT_AT_CAMERA, falloff_power=None))
    inside, white = [], []
    for seed in range(300):
        noise = np.sqrt(lobe / 100) * np.random.default_rng(seed).standard_normal(lobe.shape)
        patch = replace(Frame((lobe + noise).astype(np.float32), known, 2.0).patch((0, 0, 110, 110)), others_px=())
        inside.append(mahalanobis2(photometric.estimate(patch, camera, known.priors), -axis) < chi2.ppf(0.95, 2))
        with monkeypatch.context() as taken_for_white:
            taken_for_white.setattr(HighlightPixels, "covariance", lambda _, fitted: fitted.covariance)
            alike = photometric.estimate(patch, camera, known.priors)
        white.append(mahalanobis2(alike, -axis) < chi2.ppf(0.95, 2))
    assert 0.92 <= np.mean(inside) <= 0.98, np.mean(inside)
    # Negative control.
    assert np.mean(white) < 0.91, np.mean(white)


SURFACES = {
    "plane": {"type": "plane", "tilt_deg": 10.0},
    "cylinder": {"type": "cylinder", "radius_mm": 10.0, "tilt_deg": 10.0, "spin_deg": 30.0},
    "sphere": {"type": "sphere", "radius_mm": 4.0, "tilt_deg": 10.0},
    "inside": {"type": "sphere", "radius_mm": 25.0, "side": "inside", "tilt_deg": 10.0},
}


def frames(surface, count, **sensor):
    scene = scene_from_dict({"surface": SURFACES[surface], "sensor": {"noise_sigma": 0.05, **sensor}})
    seen = render_view(Session(scene), scene)
    return seen, [seen.frame(seed) for seed in range(count)]


@pytest.mark.render
@pytest.mark.parametrize("surface", marked(SURFACES, ci=["plane", "inside"]))
def test_curved_surfaces_with_the_light_at_the_camera(surface):
    seen, noisy = frames(surface, 12)
    truth, errors, ratios = seen.highlights[0], [], []
    for frame in noisy:
        (found,) = reconstruct(frame, seen.calibration, {"photometric": photometric})
        estimate = found.estimates["photometric"]
        errors.append(float(angle_deg(estimate.normal, truth.normal)))
        ratios.append(estimate.axis_ratio)
    gains = sorted(abs(1 + np.array([truth.kd_min, truth.kd_max])))
    assert np.mean(errors) < 0.02
    assert np.mean(ratios) == pytest.approx(gains[0] / gains[1], abs=0.02)


@pytest.mark.render
def test_clipped_pixels_count_as_at_least_as_bright():
    """With the peak clipped the fit stays; taken at their value, the clipped pixels bend the fitted shape."""
    seen, noisy = frames("cylinder", 4, saturation=True, exposure={"gain": 2.0})
    truth = seen.highlights[0]
    for frame in noisy:
        (found,) = reconstruct(frame, seen.calibration, {"photometric": photometric})
        estimate = found.estimates["photometric"]
        assert "saturated" in estimate.flags
        assert angle_deg(estimate.normal, truth.normal) < 0.02
        assert estimate.axis_ratio == pytest.approx(0.5, abs=0.02)


def test_censoring_recovers_a_clipped_lobe():
    model = next(iter(models()))
    intensity, _ = model.evaluate()
    clipped = intensity > 0.5 * intensity.max()
    observed = np.minimum(intensity, 0.5 * intensity.max())
    start = model.moved(np.array([0.01, -0.01, 1e-3, 1e-3, 0.05, 0.05]))
    censored, naive = fit_lobe(start, observed, clipped), fit_lobe(start, observed)
    assert angle_deg(censored.model.normal, model.normal) < 1e-3
    assert naive is None or angle_deg(naive.model.normal, model.normal) > 0.1
