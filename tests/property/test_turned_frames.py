"""A picture that is turned or mirrored has turned or mirrored answers: normals, covariances, each part of a budget.

The highlight of an oblique cylinder is written out here, so that no transform of the package makes both sides.
"""

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.calibration import Calibration, CameraPrior, Normal, Priors, exactly
from simtest.estimators import motion_signs, photometric
from simtest.estimators.process import messages
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, KannalaBrandt
from simtest.geometry.vectors import basis_across, covariance_across, rotation, tangent_basis
from simtest.reconstruction.pipeline import reconstruct

SIZE = 240
LENSES = {"pinhole": None, "fisheye": KannalaBrandt(0.02, 0.0, 0.0, 0.0)}
LIGHTS = {"at the camera": np.zeros(3), "aside": np.array([3.0, 1.0, 0.5])}
ESTIMATORS = (
    "brightest_point", "cone_axis", "photometric", "bisector", "curved", "inverse_rendering", "circle_pose",
)  # fmt: skip
QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""How directions turn where np.rot90 turns the picture."""

TURNS = {
    "quarter": (QUARTER, lambda frame: np.rot90(frame)),
    "three quarters": (QUARTER.T, lambda frame: np.rot90(frame, 3)),
    "mirrored": (np.diag([-1.0, 1.0, 1.0]), lambda frame: frame[:, ::-1]),
}


OBLIQUE = rotation(np.radians([0.0, 0.0, 37.0]))
"""A turn by no quarter: quarters and mirrors leave a covariance whose mixed term has the wrong sign consistent."""


EXACT = exactly(25.0)


def camera(lens):
    return Camera(SIZE, SIZE, 200.0, 200.0, SIZE / 2, SIZE / 2, distortion=LENSES[lens])


def picture(lens, light, turn):
    """Return the noisy picture of a cylinder, by a camera that is turned."""
    rays = camera(lens).unproject(camera(lens).pixel_centres()).reshape(-1, 3) @ turn
    axis, centre, radius = np.array([0.8, 0.5, 0.33]), np.array([3.0, -2.0, 27.0]), 9.0
    axis /= np.linalg.norm(axis)

    def across(vectors):
        return vectors - np.multiply.outer(vectors @ axis, axis)

    a, b = np.sum(across(rays) ** 2, axis=1), -2 * across(rays) @ across(centre)
    root = b * b - 4 * a * (across(centre) @ across(centre) - radius**2)
    points = (-b - np.sqrt(np.where(root > 0, root, np.nan)))[:, None] / (2 * a[:, None]) * rays
    normals = across(points - centre) / radius
    to_light = light - points
    distance = np.linalg.norm(to_light, axis=1)
    mirrored = 2 * np.sum(normals * to_light, axis=1)[:, None] * normals - to_light
    cosine = np.maximum(-np.sum(mirrored * rays, axis=1) / distance, 0.0)
    values = np.nan_to_num(cosine**60 / distance**2).reshape(SIZE, SIZE)
    noise = 0.01 * np.random.default_rng(1).normal(size=values.shape)
    return (values / values.max() + noise).astype(np.float32)


def known(light, turn, distance=EXACT):
    """Return what is known, in the turned frame."""
    covariance = turn @ np.array([[0.1, 0.05, 0.0], [0.05, 0.4, -0.1], [0.0, -0.1, 0.2]]) @ turn.T
    return Priors(
        lights_mm=(tuple(turn @ light),), lights_covariance_mm2=(tuple(map(tuple, covariance)),),
        distance_mm=distance, lobe_curvature=exactly(240.0), camera=CameraPrior(0.01, 1.0, 0.02),
    )  # fmt: skip


@cache
def answered(lens, light, turn=None):
    """Return the estimates of the one highlight, of the picture turned as `TURNS` names it, or taken obliquely."""
    if turn == "oblique":
        matrix, frame = OBLIQUE, picture(lens, LIGHTS[light], OBLIQUE)
    else:
        matrix, change = TURNS[turn] if turn else (np.eye(3), lambda same: same)
        frame = np.ascontiguousarray(change(picture(lens, LIGHTS[light], np.eye(3))))
    (found,) = reconstruct(frame, Calibration(camera(lens), priors=known(LIGHTS[light], matrix)), ESTIMATORS)
    return found.estimates


def in_space(normal, covariance):
    """Return a covariance of a normal as one of its three coordinates."""
    basis = np.stack(tangent_basis(normal[None]))[:, 0]
    return basis.T @ covariance @ basis


def assert_turned(covariance, of, other, of_other, turn, share=0.02):
    wanted, found = turn @ in_space(of, covariance) @ turn.T, in_space(of_other, other)
    # Ripples beyond the noise are a small difference of large numbers. A part of 0 is that of what is exact.
    assert np.abs(found - wanted).max() <= share * np.abs(wanted).max()


@pytest.mark.render
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("lens", "light"), itertools.product(LENSES, LIGHTS))
def test_answers_turn_with_the_picture(lens, light, turn):
    first, second, matrix = answered(lens, light), answered(lens, light, turn), TURNS[turn][0]
    for name in ESTIMATORS:
        before, after = first[name], second[name]
        assert isinstance(before, Estimate), before
        np.testing.assert_allclose(after.normal, matrix @ before.normal, atol=1e-7)
        np.testing.assert_allclose(after.candidates, before.candidates @ matrix.T, atol=1e-7)
        if before.covariance is None:
            # A region stands in its place; under a light aside that only the bisector allows for, nothing does.
            assert name == "circle_pose" or (light == "aside" and name != "bisector")
            assert after.covariance is None
            continue
        assert sorted(after.budget) == sorted(before.budget)
        assert_turned(before.covariance, before.normal, after.covariance, after.normal, matrix)
        for part in before.budget:
            assert_turned(before.budget[part], before.normal, after.budget[part], after.normal, matrix)
        if before.curvature is not None:
            along = np.abs(after.curvature.directions @ matrix @ before.curvature.directions.T)
            np.testing.assert_allclose(along, np.eye(2), atol=1e-4)


@pytest.mark.render
@pytest.mark.parametrize(("lens", "light"), itertools.product(LENSES, LIGHTS))
def test_answers_turn_with_the_camera(lens, light):
    """Another picture with other noise: normals to some deviations, parts to a tenth."""
    first, second = answered(lens, light), answered(lens, light, "oblique")
    for name in ESTIMATORS:
        before, after = first[name], second[name]
        if before.covariance is None:
            continue
        np.testing.assert_allclose(after.normal, OBLIQUE @ before.normal, atol=0.01)
        for part in {"noise", "light_offset", "camera"} & set(before.budget):
            assert_turned(before.budget[part], before.normal, after.budget[part], after.normal, OBLIQUE, 0.1)


@pytest.mark.render
@pytest.mark.parametrize("turn", ["quarter", "oblique"])
def test_a_covariance_that_is_not_turned_is_noticed(turn):
    """Negative control: the covariances are no circles, and the bases of the two normals differ."""
    matrix = OBLIQUE if turn == "oblique" else QUARTER
    first, second = answered("pinhole", "at the camera"), answered("pinhole", "at the camera", turn)
    for name in ("cone_axis", "photometric", "bisector", "inverse_rendering"):
        before, after = first[name], second[name]
        with pytest.raises(AssertionError):
            assert_turned(before.covariance, before.normal, before.covariance, after.normal, matrix, 0.1)


@pytest.mark.render
@pytest.mark.parametrize("name", ["bisector", "inverse_rendering"])
def test_the_part_of_the_distance_is_how_far_the_normal_moves(name):
    frame, light = picture("pinhole", LIGHTS["aside"], np.eye(3)), LIGHTS["aside"]

    def estimate(distance):
        priors = known(light, np.eye(3), distance)
        return reconstruct(frame, Calibration(camera("pinhole"), priors=priors), [name])[0].estimates[name]

    near, far = (estimate(exactly(25.0 + step)).normal for step in (-1.0, 1.0))
    move = basis_across(near) @ (far - near) / 2
    found = estimate(Normal(25.0, 1.0))
    assert np.trace(found.budget["distance"]) == pytest.approx(move @ move, rel=0.1)


# A basis other than that of the normal ------------------------------------------------------------------------------

COVARIANCE = np.array([[4.0, 1.5], [1.5, 1.0]]) * 1e-4


def bases(seed):
    """Return a unit normal that faces the camera, and a basis across it that is turned by no quarter."""
    random = np.random.default_rng(seed)
    normal = np.array([*random.normal(0, 0.4, 2), -1.0])
    normal /= np.linalg.norm(normal)
    return normal, basis_across(normal) @ rotation((0.3 + random.uniform(0, 1)) * normal).T


@pytest.mark.parametrize("seed", range(4))
def test_covariances_are_turned_out_of_another_basis(seed):
    normal, basis = bases(seed)
    wanted = basis.T @ COVARIANCE @ basis
    assert np.allclose(in_space(normal, photometric.in_tangent_basis(COVARIANCE, normal, basis)), wanted, atol=1e-12)
    assert np.allclose(covariance_across(normal, COVARIANCE), in_space(normal, COVARIANCE)[:2, :2], atol=1e-15)
    # A core states its basis with the covariance.
    fields = {"covariance": COVARIANCE.tolist(), "basis": basis.tolist()}
    assert np.allclose(
        in_space(normal, messages.AnsweredEstimate(normal=normal, **fields).uncertainty(normal)["covariance"]),
        wanted,
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(4))
def test_a_further_pictures_covariance_is_turned_into_the_first_cameras_frame(seed):
    normal, _ = bases(seed)
    first_from_second = rotation(np.array([0.5, -0.8, 0.4]))
    estimate = Estimate(normal, normal[None], np.zeros(2), covariance=COVARIANCE)
    here = first_from_second @ normal
    found = motion_signs._turned(estimate, first_from_second.T, here)
    wanted = first_from_second @ in_space(normal, COVARIANCE) @ first_from_second.T
    assert np.allclose(in_space(here, found), wanted, atol=1e-12)


def test_the_photometric_frame_turns_with_its_step():
    """The tilts whose covariance is reported are those along the frame's own axes."""
    normal, basis = bases(1)
    model = photometric.ColocatedQuadric(-normal[None], np.stack([*basis, -normal]), np.zeros(3), 0.0, 50.0)
    step = np.array([3e-4, -5e-4, 0.0, 0.0, 0.0, 0.0])
    moved = replace(model).moved(step)
    assert np.allclose(basis @ (moved.normal - normal), -step[:2], atol=1e-9)
    assert np.allclose(moved.frame @ moved.frame.T, np.eye(3), atol=1e-12)


# The basis itself -----------------------------------------------------------------------------------------------------


COORDINATE = st.floats(-1, 1)


@given(st.tuples(COORDINATE, COORDINATE, COORDINATE).filter(lambda drawn: np.linalg.norm(drawn) > 1e-3))
def test_the_basis_is_orthonormal_right_handed_and_one(drawn):
    normal = np.array(drawn) / np.linalg.norm(drawn)
    first, second = (axis[0] for axis in tangent_basis(normal[None]))
    rows = np.stack([first, second, normal])
    np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-14)
    np.testing.assert_array_equal(basis_across(normal), [first, second])


def test_the_basis_is_that_of_every_release():
    """To the letter, since it says what a stored covariance means: also beside the pole where z changes its sign."""
    np.testing.assert_array_equal(basis_across(np.array([0.0, 0.0, 1.0])), [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(basis_across(np.array([0.0, 0.0, -1.0])), [[1, 0, 0], [0, -1, 0]])
    np.testing.assert_allclose(basis_across(np.array([0.6, 0.0, -0.8])), [[0.8, 0, 0.6], [0, -1, 0]], atol=1e-15)
    np.testing.assert_allclose(basis_across(np.array([0.0, 0.6, 0.8])), [[1, 0, 0], [0, 0.8, -0.6]], atol=1e-15)
