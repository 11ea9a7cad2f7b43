"""The score of a detection: a lobe on its ground against what is taken for one."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame
from simtest.detection.score import LEAST_SCORE, NAMES, WEIGHTS, features, highlight_scores
from simtest.errors import Failure
from simtest.geometry import Camera

SIZE = 120
Y, X = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2


def score_of(light, smoothing_px=2.0, box=(10, 10, 100, 100), scale=1.0):
    noise = np.random.default_rng(1).normal(0, 0.003, light.shape)
    frame = Frame(
        (scale * (light + noise)).astype(np.float32), Calibration(Camera.from_fov(30.0, SIZE, SIZE)), smoothing_px
    )
    patch = frame.patch(box)
    assert not isinstance(patch, Failure), patch
    return highlight_scores([patch], frame)[0]


def lobe(width_px=6.0, longer=1.0, x=0.0, y=0.0):
    return 0.6 * np.exp(-(((X - x) / longer) ** 2 + (Y - y) ** 2) / (2 * width_px**2))


def lit_sphere(radius_px=30.0, aside=0.8):
    height = np.sqrt(np.maximum(1 - (X**2 + Y**2) / radius_px**2, 0))
    return 0.9 * np.maximum(aside * X / radius_px + np.sqrt(1 - aside**2) * height, 0) * (height > 0)


def texture(seed=3):
    grid = np.random.default_rng(seed).normal(size=(SIZE, SIZE))
    spectrum = np.fft.rfft2(grid) * np.exp(-((np.fft.fftfreq(SIZE)[:, None] ** 2 + np.fft.rfftfreq(SIZE) ** 2) * 2e3))
    pattern = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.exp(0.9 * pattern / pattern.std()) * 0.1


LOBES = {
    "on a ground": lobe() + 0.15,
    "alone": lobe(),
    "small": lobe(1.5) + 0.1,
    "of an ellipse": lobe(longer=2.0) + 0.1,
    "clipped": np.minimum(1.6 * lobe(), 0.9),
}
FOOLERS = {"a lit sphere": lit_sphere(), "one lit from behind": lit_sphere(aside=0.98)}


@pytest.mark.parametrize("name", LOBES)
def test_a_lobe_passes(name):
    assert score_of(LOBES[name]) > LEAST_SCORE


@pytest.mark.parametrize("name", FOOLERS)
def test_shading_is_refused(name):
    assert score_of(FOOLERS[name]) < LEAST_SCORE


def test_maxima_of_textures_score_lower():
    of_textures = [score_of(texture(seed)) for seed in range(3, 9)]
    assert np.mean(of_textures) < min(map(score_of, LOBES.values())) - 0.1


def test_a_score_does_not_depend_on_the_frames_scale():
    light = lobe() + 0.15
    assert score_of(light) == pytest.approx(score_of(light, scale=1e-4), abs=1e-4)


def test_what_lowers_a_score():
    plain = score_of(lobe() + 0.15)
    brighter = np.where(np.hypot(X + 45, Y + 45) < 5, 3.0, lobe() + 0.15)
    rough = lobe() + 0.15 + 0.1 * texture() / texture().std()
    assert 1 - score_of(brighter, box=(25, 25, 80, 80)) > 2 * (1 - plain)
    assert 1 - score_of(rough) > 2 * (1 - plain)


def test_too_little_tells_nothing():
    light = np.full((SIZE, SIZE), 0.1)
    light[60, 60] = 1.0
    assert score_of(light, 0.0, (58, 58, 5, 5)) is None


def test_each_feature_has_its_weight():
    assert len(NAMES) == len(WEIGHTS)
    assert WEIGHTS.all()
    assert 0 < LEAST_SCORE < 1
    frame = Frame(lobe().astype(np.float32), Calibration(Camera.from_fov(30.0, SIZE, SIZE)), 2.0)
    assert features([frame.patch((10, 10, 100, 100))], frame)[0].shape == WEIGHTS.shape
