"""Convex against concave from two views: on rendered pairs, and against the exact geometry of a circle."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Normal, Priors, exactly
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved, sign_hypotheses
from simtest.estimators.motion_signs import MovedView, rank_by_motions
from simtest.estimators.protocol import Estimate, EstimatedCurvature
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.seeds import from_integer
from simtest.spec import scene_from_dict
from tests.marked import marked

D, EXPONENT = 10.0, 50.0
LOBE = 4 * EXPONENT

# d k along both principal directions: convex, concave within the centre, concave beyond the centre, saddle.
SHAPES = {
    "convex": (0.6, 0.2),
    "concave": (-0.5, -0.2),
    "beyond the centre": (-2.4, -3.0),
    "saddle": (0.6, -0.5),
    "saddle beyond the centre": (0.6, -3.2),
}


def rank_by_motion(first, second, second_from_first, priors):
    return rank_by_motions(first, [MovedView([second], second_from_first)], priors)


def signs_of(kd):
    return np.sign(1 + np.array(kd))


@pytest.fixture(scope="module")
def view():
    """Return a function from a shape and a place of the camera to estimates of the anchor's highlight and the pose."""
    held = []

    def look(kd, tilt_deg, azimuth_deg, sigma, seed, distance=D):
        surface = {
            "type": "quadric", "distance_mm": distance, "k1_per_mm": kd[0] / D, "k2_per_mm": kd[1] / D,
            "tilt_deg": tilt_deg, "azimuth_deg": azimuth_deg, "spin_deg": 20.0,
        }  # fmt: skip
        scene = scene_from_dict({"surface": surface, "camera": {"width": 400, "height": 400}})
        if held:
            held[0].update(scene)
        else:
            held.append(Session(scene))
        session = held[0]
        radiance = session.radiance()
        truth = min(session.highlights(radiance), key=lambda h: np.linalg.norm(h.position - [0, 0, distance]))
        peak = radiance.total[int(truth.bp_px[1]), int(truth.bp_px[0])]
        frame = radiance.total / peak + sigma * from_integer(seed).standard_normal(radiance.total.shape)
        priors = replace(LIGHT_AT_CAMERA, lobe_curvature=exactly(LOBE))
        found = reconstruct(
            np.minimum(frame, 1.5).astype(np.float32), Calibration(session.camera, priors=priors),
            {"curved": curved, "cone_axis": cone_axis}, isolated=False,
        )  # fmt: skip
        answered = [s for s in found if not isinstance(s.estimates["curved"], Failure)]
        own = min(answered, key=lambda s: np.linalg.norm(s.patch.peak_px - truth.bp_px))
        return own.estimates, np.array(session.surface.model_from_camera), truth

    return look


@pytest.mark.render
@pytest.mark.parametrize("name", marked(SHAPES, ci=["beyond the centre", "saddle", "saddle beyond the centre"]))
def test_rendered_pairs_tell_the_signs(view, name):
    kd = SHAPES[name]
    first, model_from_first, truth = view(kd, 0.0, 0.0, 0.02, 1)
    # Beyond the centre the highlight runs ahead of the camera: a smaller motion keeps it in the picture.
    tilt = 3.0
    for azimuth, seed in ((35.0, 2), (250.0, 3)):
        second, model_from_second, _ = view(kd, tilt, azimuth, 0.02, seed)
        motion = np.linalg.inv(model_from_second) @ model_from_first
        priors = Priors(distance_mm=Normal(truth.distance, 0.05 * truth.distance))
        ranked = rank_by_motion(first["curved"], second["cone_axis"], motion, priors)
        # Along the directions of the smaller and the larger abs(1 + d k).
        order = np.argsort(np.abs(1 + np.array(kd)))
        np.testing.assert_array_equal(np.sign(ranked.hypotheses[0]), signs_of(kd)[order])
        assert ranked.is_clear
        assert ranked.distance2[0] < 13.8
        assert np.degrees(np.arccos(min(ranked.predicted[0] @ second["cone_axis"].normal, 1))) < 0.5


@pytest.mark.render
def test_without_motion_nothing_is_told(view):
    first, _, truth = view(SHAPES["saddle"], 0.0, 0.0, 0.02, 1)
    second, _, _ = view(SHAPES["saddle"], 0.0, 0.0, 0.02, 2)
    ranked = rank_by_motion(
        first["curved"], second["cone_axis"], np.eye(4), Priors(distance_mm=exactly(truth.distance))
    )
    assert not ranked.is_clear


# Exact geometry ------------------------------------------------------------------------------------------------------


def exact(normal, **given):
    return Estimate(normal, normal[None], np.zeros(2), covariance=1e-8 * np.eye(2), **given)


def sphere_estimate(kd, normal):
    m = 1 + kd
    other = -2 / LOBE - m
    hypotheses = np.array([[a, b] for a in (m, other) for b in (m, other)])
    directions = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    return exact(normal, curvature=EstimatedCurvature(directions, 1.0, hypotheses))


@pytest.mark.parametrize("turn_deg", [(0, 0, 0), (40, -70, 25)])
@pytest.mark.parametrize("kd", [0.5, 3.0, -0.4, -1.6, -3.0])
def test_small_motions_on_spheres_are_predicted_exactly(kd, turn_deg):
    """The highlight of a sphere lies on the line from the camera to its centre, wherever the camera looks."""
    first = sphere_estimate(kd, np.array([0.0, 0, -1]))
    centre = np.array([0, 0, D + D / kd])
    place = np.array([0.03, -0.02, 0.01])
    turn = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, -turn @ place
    towards = place - centre
    # Within the centre's distance the camera lies between the highlight and the centre.
    normal = turn @ (towards / np.linalg.norm(towards)) * np.sign(kd * (1 + kd))
    second = exact(normal)
    ranked = rank_by_motion(first, second, T, Priors(distance_mm=exactly(D)))
    np.testing.assert_allclose(ranked.hypotheses[0], 1 + kd)
    np.testing.assert_allclose(ranked.predicted[0], normal, atol=3e-6)
    assert ranked.distance2[0] < 1e-2


def test_a_motion_along_one_principal_direction_tells_that_sign_only():
    first = sphere_estimate(0.5, np.array([0.0, 0, -1]))
    T = np.eye(4)
    T[0, 3] = -0.5
    normal = np.array([0.5, 0, -30.0]) / np.hypot(0.5, 30.0)
    ranked = rank_by_motion(first, exact(normal), T, Priors(distance_mm=exactly(D)))
    assert (ranked.hypotheses[:2, 0] == 1.5).all()
    assert sorted(np.sign(ranked.hypotheses[:2, 1])) == [-1, 1]
    assert ranked.distance2[2] - ranked.distance2[1] > 9
    assert not ranked.is_clear


def test_what_is_missing_or_malformed_is_said():
    bare = Estimate(np.array([0.0, 0, -1]), np.array([[0.0, 0, -1]]), np.zeros(2))
    full = sphere_estimate(0.5, bare.normal)
    for first, priors in ((bare, Priors(distance_mm=exactly(D))), (full, Priors())):
        result = rank_by_motion(first, bare, np.eye(4), priors)
        assert isinstance(result, Failure)
        assert result.reason == Reason.NOT_KNOWN
    for motion in (np.eye(3), np.diag([1.0, 1, 2, 1]), np.diag([1.0, 1, -1, 1]), np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match="view_from_first"):
            rank_by_motion(full, exact(bare.normal), motion, Priors(distance_mm=exactly(D)))


def test_without_an_uncertainty_nothing_is_told():
    normal = np.array([0.0, 0, -1])
    first, T, priors = sphere_estimate(0.5, normal), np.eye(4), Priors(distance_mm=exactly(D))
    silent = [each.without_uncertainty() for each in (first, exact(normal))]
    assert rank_by_motion(silent[0], exact(normal), T, priors).reason == Reason.NOT_KNOWN
    assert rank_by_motion(first, silent[1], T, priors).reason == Reason.NO_ESTIMATE


@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_a_plane_is_not_told_to_bend_by_a_lobe_that_may_be_narrower(spread):
    """With the lobe taken for 1.4 times as curved as it is, a plane's gain is 0.845."""
    hypotheses = sign_hypotheses(np.full(2, LOBE + 2), 1.4 * LOBE)
    normal, T = np.array([0.0, 0, -1]), np.eye(4)
    first = exact(normal, curvature=EstimatedCurvature(np.eye(3)[:2], 1.0, hypotheses))
    T[:2, 3] = -0.3, 0.2
    told = Normal(1.4 * LOBE, spread * 1.4 * LOBE)
    ranked = rank_by_motion(first, exact(normal), T, Priors(distance_mm=exactly(D), lobe_curvature=told))
    # A lobe that is given as exact is taken at its word.
    assert ranked.fits == (spread > 0)
    assert ranked.told_bends() == ((0, 0) if spread else (-1, -1))
