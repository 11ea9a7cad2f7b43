"""The noise behind the whole camera chain at highlights' peaks, against frames that are drawn again and again."""

import itertools

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import examine
from simtest.simulation.sensor import capture, noise_at
from simtest.spec import load_scene
from simtest.spec.sensor import PRESETS, Sensor

pytestmark = pytest.mark.render

SCENE = {
    "camera.width": 120, "camera.height": 90, "camera.fx": 110.0, "camera.fy": 110.0, "surface.radius_mm": 40.0,
    "reflectance.exponent": 60.0, "reflectance.diffuse": 0.4,
}  # fmt: skip


@pytest.fixture(scope="module")
def session():
    return Session(load_scene("sphere", SCENE), "llvm_ad_rgb")


def drawn_sigma(view, row, column, draws=150):
    """The deviation of the channels' mean over draws of the whole frame, mean of the variances of 3 x 3 pixels."""
    decode = view.scene.sensor.response.model().decode
    around = np.s_[row - 1 : row + 2, column - 1 : column + 2]
    values = np.stack([decode(view.frame(seed))[around] for seed in range(draws)])
    values = values if values.ndim == 3 else values.mean(axis=3)
    return np.sqrt(values.var(axis=0, ddof=1).mean()) * view.full_scale


COLOURS = ((0.9, 0.4, 0.3), (1.0, 1.0, 1.0))
SENSORS = {name: {"preset": name} for name in PRESETS} | {
    "plain": {"full_well": 4000.0, "read_noise": 5.0},
    "mosaic": {"full_well": 4000.0, "mosaic": {}, "colour": {"white_balance": [1.8, 1.0, 2.2]}},
}


@pytest.mark.parametrize(("name", "colour"), zip(SENSORS, itertools.cycle(COLOURS)))
def test_the_noise_at_a_peak_is_that_of_frames_drawn_again(name, colour, session):
    sensor = {**SENSORS[name], "exposure": {"percentile": 100.0, "gain": 0.5}}
    scene = load_scene("sphere", {**SCENE, "reflectance.colour": list(colour), "sensor": sensor})
    view = render_view(session, scene)
    light = view.light.mean(axis=2)
    row, column = np.unravel_index(light.argmax(), light.shape)
    found = noise_at(view.light, view.full_scale, scene.sensor, np.array([row]), np.array([column]), 64)
    assert found[0] == pytest.approx(drawn_sigma(view, row, column), rel=0.15)
    [highlight] = view.highlights
    [examined] = examine(view.highlights, light)
    assert highlight.peak_snr == pytest.approx(examined.height / found[0], rel=0.2)


def test_without_light_there_is_no_noise():
    sensor = Sensor(preset="old_sd")
    assert noise_at(np.zeros((40, 40)), 0.0, sensor, np.array([3]), np.array([3]), 4) == [0.0]
    assert noise_at(np.ones((40, 40)), 1.0, sensor, np.array([], int), np.array([], int), 4).shape == (0,)
    # At the border, and in more pictures than one.
    border = np.zeros(300, dtype=int), np.full(300, 39)
    assert (noise_at(np.full((40, 40), 0.3, np.float32), 1.0, sensor, *border, 8) > 0).all()


def test_a_chain_that_draws_no_noise_has_that_of_its_steps():
    sensor = Sensor(bits=8, scaling={"factor": 0.6}, sharpening={"amount": 1.0})
    light = np.linspace(0.1, 0.9, 1600, dtype=np.float32).reshape(40, 40)
    found = noise_at(light, 1.0, sensor, np.array([20]), np.array([20]), 8)
    assert found == pytest.approx(1 / 255 / np.sqrt(12), rel=1e-3)


@pytest.mark.parametrize(
    ("factor", "coding"), [(0.45, None), (0.6, {"type": "jpeg", "quality": 85}), (1.5, {"type": "jpeg", "quality": 85})]
)
def test_scaling_a_small_highlight_is_no_noise(factor, coding):
    # Each draw falls otherwise between the recorded pixels of a row of cells that were scaled as one picture.
    sensor = Sensor(full_well=5000, scaling={"factor": factor}, coding=coding, bits=8 if coding else None)
    at, (y, x) = np.arange(24, 200, 24), np.mgrid[:216, :216]
    spots = sum(np.exp(-((x - i) ** 2 + (y - j) ** 2) / 3) for i in at for j in at)
    light = (0.2 + 0.6 * spots).astype(np.float32)
    rows, columns = (each.ravel() for each in np.meshgrid(at, at))
    found = noise_at(light, 1.0, sensor, rows, columns, 32)
    rng = np.random.default_rng(0)
    variance = np.var([capture(light, 1.0, sensor, rng) for _ in range(40)], axis=0, ddof=1)
    around = [
        variance[row - 1 : row + 2, column - 1 : column + 2].mean() for row, column in zip(rows, columns, strict=True)
    ]
    assert np.median(found / np.sqrt(around)) == pytest.approx(1, abs=0.15)


def test_a_clipped_channel_has_the_noise_below_the_clip():
    light = np.full((40, 40, 3), [1.3, 0.5, 0.4], dtype=np.float32)
    sensor = Sensor(full_well=5000, saturation=True, colour={})
    found = noise_at(light, 1.0, sensor, np.array([20]), np.array([20]), 200)
    assert found == pytest.approx(np.sqrt((1 + 0.5 + 0.4) / 5000) / 3, rel=0.15)
