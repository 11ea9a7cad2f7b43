"""What a network sees of a highlight, the normals that its rotations state, and these against the law of reflection."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, Priors
from simtest.estimators import learned
from simtest.estimators.learned import (
    RELIEF_RAD,
    CovarianceScale,
    image_basis,
    median_of_lit,
    normal_of,
    reflection_distances,
    rotation_of,
    turned_normals,
)
from simtest.estimators.learned_dense import interpolated
from simtest.estimators.learned_spot import CUT_FACTOR, CUT_PX, EXTRAS, OUTPUTS, SIDE, STEPS, LearnedSpot, spot_inputs
from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis, tangent_coordinates

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


class Stub:
    """A network that is as sure of all highlights."""

    def __init__(self):
        self.scales = self.ratio_scales = {"base": CovarianceScale((0.0,), (1.0,))}

    def run(self, crops, extras):
        """Return the middle of the range for each crop."""
        return np.zeros((len(crops), 2, len(OUTPUTS))), np.ones(len(crops)), [None] * len(crops)


def test_a_network_is_less_sure_of_spots_that_the_border_cuts(picture):
    core = LearnedSpot()
    vars(core)["_network"] = Stub()
    sides = [[40.0, CUT_PX - 1], [40.0, WIDTH - CUT_PX + 1], [CUT_PX - 1, 40.0], [WIDTH - CUT_PX + 1, 40.0]]
    cut = core._at(frame(picture), np.array(sides))
    (whole,) = core._at(frame(picture), np.array([[40.0, CUT_PX + 1]]))
    assert [each.deviation_deg / whole.deviation_deg for each in cut] == pytest.approx([CUT_FACTOR] * 4, rel=1e-6)


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


# Turned normals -------------------------------------------------------------------------------------------------------


def test_turned_normals_have_the_covariance_of_drawn_rotations():
    ray = np.array([[0.3, -0.2, 0.93]])
    ray /= np.linalg.norm(ray)
    turn, root = np.array([[0.6, -0.3]]), 0.02 * np.array([[[1.0, 0.0], [0.5, 0.7]]])
    normals, covariances = turned_normals(ray, turn, root)
    drawn = turn + np.random.default_rng(1).normal(size=(20000, 2)) @ root[0].T
    others = normal_of(np.repeat(ray, len(drawn), axis=0), drawn)
    off = np.array([tangent_coordinates(normals[0], other) for other in others[:4000]])
    assert np.allclose(np.cov(off.T), covariances[0], rtol=0.1, atol=2e-5)


def test_interpolation_is_exact_at_centres_and_between_them():
    planes = np.arange(12.0).reshape(1, 3, 4)
    points = np.array([[0, 0], [3, 2], [1.5, 1.0], [1.0, 0.5], [-4, 0], [9, 9]], dtype=float)
    assert interpolated(planes, points)[0].tolist() == [0, 11, 5.5, 3, 0, 11]


# The law of reflection ------------------------------------------------------------------------------------------------


PAIR = np.array([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0]])
COUNT = 4000


def highlights(seed, tilt=0.0, stated=0.05, relief=RELIEF_RAD, far=60.0):
    """Return what is stated at highlights of either light: base normals off by relief, noise, and a tilt, rad."""
    rng = np.random.default_rng(seed)
    rays = rng.uniform(-0.5, 0.5, (COUNT, 3))
    rays[:, 2] = 1
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = rng.uniform(far / 4, far, COUNT)
    to_light = PAIR[rng.integers(2, size=COUNT)] - distance[:, None] * rays
    normal = to_light / np.linalg.norm(to_light, axis=1, keepdims=True) - rays
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    basis = np.stack(tangent_basis(normal), axis=1)
    off = rng.normal(0, np.hypot(relief, stated), (COUNT, 2)) + tilt
    made = normal + np.einsum("ni,nij->nj", np.tan(off), basis)
    made /= np.linalg.norm(made, axis=1, keepdims=True)
    covariance = np.broadcast_to(stated**2 * np.eye(2), (COUNT, 2, 2))
    return made, covariance, rays, distance * np.exp(rng.normal(0, 0.2, COUNT)), np.full(COUNT, 0.2), PAIR


def test_normals_that_reflect_the_lights_agree():
    # Slightly below 1: of two lights the nearer one counts.
    assert 0.75 < reflection_distances(*highlights(1)).mean() / 2 < 1.05


def test_normals_that_are_wrong_and_sure_do_not():
    assert reflection_distances(*highlights(2, tilt=0.6)).mean() / 2 > 3.5


@pytest.mark.parametrize("stated", [0.05, 0.3])
def test_what_is_stated_to_be_uncertain_may_be_off(stated):
    assert 0.7 < reflection_distances(*highlights(3, stated=stated)).mean() / 2 < 1.1


def test_a_distance_that_is_uncertain_may_be_off(monkeypatch):
    monkeypatch.setattr(learned, "RELIEF_RAD", 0.01)
    given = highlights(4, stated=0.01, relief=0.01, far=20.0)
    assert 0.7 < reflection_distances(*given).mean() / 2 < 1.2
    # Negative control: the same distances, told as exact.
    assert reflection_distances(*given[:4], np.full(COUNT, 1e-6), PAIR).mean() / 2 > 2
