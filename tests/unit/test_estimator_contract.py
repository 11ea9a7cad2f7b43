"""What every estimator of highlights must do: turn and mirror with the picture, and not depend on how bright it is."""

from importlib.metadata import entry_points

import numpy as np
import pytest

from simtest.calibration import CameraPrior, Normal, Priors
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.estimators.budget import PARTS
from simtest.estimators.dispatch import run, run_each
from simtest.estimators.names import load_estimators
from simtest.geometry import BrownConrady, Camera, Patch, smooth
from simtest.geometry.vectors import angle_deg, basis_across
from simtest.validation.paper.plane_from_aside import photometric_plane

ELSEWHERE = {"cloud", "inverse_rendering", "learned_dense", "learned_spot"}
"""Those that take whole frames, a renderer or a network's runtime."""

NAMES = sorted(
    each.name
    for each in entry_points(group="simtest.estimators")
    if each.dist.name == "simtest" and each.name not in ELSEWHERE
)
"""All others that are registered: one that is added gets these tests by its line there."""

SIDE, NOISE = 161, 0.01
CAMERAS = {
    "pinhole": Camera(SIDE, SIDE, 150.0, 150.0, SIDE / 2, SIDE / 2),
    "lens": Camera(SIDE, SIDE, 150.0, 150.0, SIDE / 2, SIDE / 2, distortion=BrownConrady(k1=-0.1)),
}
LIGHT = np.array([3.0, 1.0, 0.0])
MOVES = {
    "mirrored": (lambda p: p[:, ::-1], np.diag([-1.0, 1, 1])),
    "upside down": (lambda p: p[::-1], np.diag([1.0, -1, 1])),
    "transposed": (lambda p: p.T, np.eye(3)[[1, 0, 2]]),
    "turned": (lambda p: p.T[:, ::-1], np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])),
}


def picture(size=1.0):
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    u, v = (x - 101.3) / size, (y - 92.6) / size
    lobe = np.exp(-(u**2 / 11.0**2 + v**2 / 8.0**2 + u * v / 25.0**2) / 2)
    return (lobe + NOISE * np.random.default_rng(2).standard_normal(lobe.shape)).astype(np.float32)


def estimator_of(name):
    return photometric_plane if name == "photometric_plane" else load_estimators([name])[name]


def answer(name, frame, camera, noise=NOISE, turn=None):
    """Return the answer to a frame of which nothing is told exactly."""
    raw = np.ascontiguousarray(frame)
    whole = (0, 0, SIDE, SIDE)
    patch = Patch.cut(smooth(raw, 1.5), whole, raw=raw, noise=noise, smoothing_px=1.5, others_px=())
    # The bisector needs the lights; beside one of them the others state no uncertainty.
    light = (tuple((np.eye(3) if turn is None else turn) @ LIGHT),) if name == "bisector" else ()
    priors = Priors(light, Normal(40.0, 8.0), camera=CameraPrior(0.03, 2.0, 0.01), plane=True)
    return run(estimator_of(name), patch, camera, priors)


def in_space(normal, covariance):
    basis = basis_across(normal)
    return basis.T @ covariance @ basis


@pytest.mark.parametrize("lens", CAMERAS)
@pytest.mark.parametrize("name", NAMES)
def test_an_answer_turns_with_the_picture(name, lens):
    camera = CAMERAS[lens]
    before = answer(name, picture(), camera)
    assert isinstance(before, Estimate), before
    assert set(before.budget or {}) <= set(PARTS)
    for what, (move, turn) in MOVES.items():
        after = answer(name, move(picture()), camera, turn=turn)
        assert angle_deg(after.normal, turn @ before.normal) < 1e-3, what
        assert after.flags == before.flags
        if before.axis_ratio is not None:
            assert after.axis_ratio == pytest.approx(before.axis_ratio, rel=1e-3), what
        assert (after.budget or {}).keys() == (before.budget or {}).keys()
        for part, covariance in (before.budget or {}).items():
            wanted = turn @ in_space(before.normal, covariance) @ turn.T
            found = in_space(after.normal, after.budget[part])
            assert np.abs(found - wanted).max() < 0.02 * np.abs(wanted).max() + 1e-12, (what, part)


@pytest.mark.parametrize("name", NAMES)
def test_twice_the_light_changes_nothing(name):
    one = answer(name, picture(), CAMERAS["pinhole"])
    two = answer(name, 2 * picture(), CAMERAS["pinhole"], noise=2 * NOISE)
    assert angle_deg(one.normal, two.normal) < 1e-4
    assert one.flags == two.flags
    if one.covariance is not None:
        np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("name", [*NAMES, "photometric_plane"])
def test_what_holds_no_highlight_gets_no_answer(name):
    assert run_each(estimator_of(name), [], CAMERAS["pinhole"]) == []
    for dark in (np.zeros((SIDE, SIDE)), np.arange(SIDE) + 0.1 * np.arange(SIDE)[:, None]):
        made = answer(name, dark.astype(np.float32), CAMERAS["pinhole"])
        assert isinstance(made, Failure), made
        assert made.reason in (Reason.NO_PEAK, Reason.NO_CLOSED_ISOPHOTE)


@pytest.mark.parametrize("name", [*NAMES, "photometric_plane"])
def test_where_the_noise_is_not_known_no_uncertainty_is_stated(name):
    for size in (1.0,) if name == "photometric_plane" else (1.0, 0.15):
        told, untold = (answer(name, picture(size), CAMERAS["pinhole"], noise=noise) for noise in (NOISE, None))
        if name == "circle_pose":
            # It states a region in place of a covariance, and nothing of a highlight too small for a shape.
            assert (size == 1) == isinstance(untold, Estimate) == (getattr(told, "region", None) is not None)
            assert getattr(untold, "region", None) is None
        else:
            assert told.covariance is not None
            assert untold.covariance is None
