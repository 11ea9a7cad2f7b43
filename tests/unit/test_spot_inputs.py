"""What a network sees of a highlight: mirrored and turned with the picture, and the same whatever the detector."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, Priors
from simtest.estimators.learned import image_basis, median_of_lit, normal_of, rotation_of
from simtest.estimators.learned_spot import EXTRAS, SIDE, STEPS, spot_inputs
from simtest.geometry import Camera

WIDTH = 121
LIGHTS = np.array([[3.0, 1.0, 0.0], [-2.0, 1.5, 0.5]])
PEAK = np.array([70.5, 41.5])


def frame(picture, lights=LIGHTS):
    camera = Camera(WIDTH, WIDTH, 150.0, 150.0, WIDTH / 2, WIDTH / 2)
    return Frame(picture, Calibration(camera, priors=Priors(lights_mm=tuple(map(tuple, lights)))), 1.0)


@pytest.fixture
def picture():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:WIDTH, :WIDTH] + 0.5
    lobe = 0.9 * np.exp(-((x - PEAK[0]) ** 2 + 2 * (y - PEAK[1]) ** 2) / 40)
    return (lobe + rng.uniform(0.05, 0.1, (WIDTH, WIDTH))).astype(np.float32)


def test_crops_show_the_frame_around_the_peak(picture):
    crops, extras = spot_inputs(frame(picture), [PEAK])
    assert crops.shape == (1, len(STEPS), SIDE, SIDE)
    assert extras.shape == (1, len(EXTRAS))
    light = frame(picture).channels
    own = np.log(light / np.median(light) + 0.02)
    # Between four centres of pixels each value is their mean.
    row, column = int(PEAK[1]), int(PEAK[0])
    assert np.isclose(crops[0, 0, 16, 16], own[row : row + 2, column : column + 2].mean(), atol=1e-4)
    # The widest crop reaches over the border, where it is dark.
    assert crops[0, 2, 0, 0] == pytest.approx(np.log(0.02))
    assert np.isfinite(crops).all()


def test_a_dark_background_does_not_set_the_scale_of_the_light(picture):
    before = picture.copy()
    # A liver before an unlit background: three fifths of the picture are nearly black.
    before[: WIDTH // 5, :], before[3 * WIDTH // 5 :, :] = 1e-4, 1e-4
    crop, alone = (spot_inputs(frame(each), [PEAK])[0][0, 0, 12:20, 12:20] for each in (before, picture))
    assert np.median(frame(before).channels) < 0.01 * np.median(frame(picture).channels)
    assert np.abs(crop - alone).max() < 0.1
    assert median_of_lit(np.zeros(9, np.float32)) == median_of_lit(np.zeros(0, np.float32)) == 1.0


def test_rotations_and_normals_are_each_other_s_inverse():
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(50, 3)) * [0.5, 0.5, 0.1] + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rotation = rng.normal(0, 0.4, (50, 2))
    normals = normal_of(rays, rotation)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.allclose(rotation_of(rays, normals), rotation)
    assert np.allclose(normal_of(rays, np.zeros((50, 2))), -rays)
    frames = np.concatenate([image_basis(rays), rays[:, None]], axis=1)
    assert np.allclose(frames @ frames.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(frames), 1)
