"""Circle pose on exact cones: normal, centre and invariances; many at once are each alone, to the last bit."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from simtest.errors import Failure, Reason
from simtest.geometry import Camera, circle_pose, circle_poses, cone_axes, cone_of_conic, fit_ellipse, fit_ellipses
from tests.example_counts import examples

CAMERA = Camera(640, 480, 500.0, 430.0, 330.0, 225.0, 15.0)
EXACT_DEG = 1e-6
BRANCH_DEG = 1e-4
BRANCH_TILT = 1e-3
"""Nearer than this to the cone's axis, rad, a rounding error eps of the matrix tilts the normal by sqrt(eps)."""


@dataclass(frozen=True)
class Circle:
    """A circle whose centre lies at unit distance along `sight`."""

    sight: np.ndarray
    normal: np.ndarray
    radius: float

    def cone(self):
        """C' from its definition: w meets the circle's plane at x = w (N.s)/(N.w), and |x - s| = r."""
        to_plane = (self.normal @ self.sight) * np.eye(3) - np.outer(self.sight, self.normal)
        return to_plane.T @ to_plane - self.radius**2 * np.outer(self.normal, self.normal)

    def points(self, count):
        first, second = np.linalg.svd(self.normal[None])[2][1:]
        phase = 2 * np.pi * np.arange(count)[:, None] / count
        return self.sight + self.radius * (np.cos(phase) * first + np.sin(phase) * second)

    @property
    def nearest_z(self):
        return self.sight[2] - self.radius * np.hypot(*self.normal[:2])


def unit(v):
    return v / np.linalg.norm(v)


def angle_deg(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1)))


@st.composite
def circles(draw, max_off_axis_deg=89.0):
    """Circles wholly in front of the camera, some of them next to the branch point N = -s."""
    off, azimuth = np.radians(draw(st.floats(0, max_off_axis_deg))), draw(st.floats(0, 2 * np.pi))
    sight = np.array([np.sin(off) * np.cos(azimuth), np.sin(off) * np.sin(azimuth), np.cos(off)])
    slant_limit = np.arccos(0.05)
    slant = draw(st.floats(0, slant_limit) | st.floats(-9, 0).map(lambda e: 10.0**e))
    assume(slant <= slant_limit)
    turn = draw(st.floats(0, 2 * np.pi))
    first, second = np.linalg.svd(sight[None])[2][1:]
    normal = unit(-np.cos(slant) * sight + np.sin(slant) * (np.cos(turn) * first + np.sin(turn) * second))
    angular_radius_deg = draw(st.floats(np.log10(0.05), np.log10(30)).map(lambda e: 10.0**e))
    circle = Circle(sight, normal, float(np.tan(np.radians(angular_radius_deg))))
    assume(circle.nearest_z > 1e-3)
    return circle


def solve(circle):
    """Return the pose, the index of the right candidate, and its error, deg."""
    pose = circle_pose(circle.cone())
    errors = angle_deg(pose.normals, circle.normal)
    return pose, int(errors.argmin()), float(errors.min())


SMALL_GRAZING = Circle(np.array([0.0, 0, 1]), np.array([np.sqrt(1 - 0.05**2), 0, -0.05]), np.tan(np.radians(0.05)))
HEAD_ON = Circle(np.array([0.0, 0, 1]), np.array([0.0, 0, -1]), 0.1)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(circles())
@example(SMALL_GRAZING)
@example(HEAD_ON)
def test_one_candidate_is_the_true_normal(circle):
    pose, best, error = solve(circle)
    tilt = np.radians(angle_deg(-circle.normal, pose.axis))
    assert error < (EXACT_DEG if tilt > BRANCH_TILT else BRANCH_DEG)
    np.testing.assert_allclose(np.linalg.norm(pose.normals, axis=1), 1, atol=1e-14)
    # Facing the camera means facing away along the sightline of the circle's centre.
    assert pose.normals[best] @ circle.sight < 0


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(circles())
@example(SMALL_GRAZING)
def test_both_candidates_lean_alike_in_the_plane_of_e1_and_the_axis(circle):
    pose, _, _ = solve(circle)
    lean = angle_deg(-pose.normals, pose.axis)
    assert abs(lean[0] - lean[1]) < 1e-9
    # They lie on opposite sides: their sum is along the axis.
    assert angle_deg(-pose.normals.sum(axis=0), pose.axis) < 1e-9
    _, vectors = cone_axes(circle.cone())
    np.testing.assert_allclose(pose.normals @ vectors[:, 1], 0, atol=1e-9)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(circles(max_off_axis_deg=80))
@example(SMALL_GRAZING)
@example(HEAD_ON)
def test_centre_of_the_right_candidate_projects_to_the_true_centre(circle):
    pose, best, _ = solve(circle)
    assert angle_deg(pose.centres[best], circle.sight) < EXACT_DEG
    seen = CAMERA.project(circle.sight)
    np.testing.assert_allclose(CAMERA.project(pose.centres[best]), seen, rtol=1e-6, atol=1e-6)
    # The same from the image's conic, as published: the centre is the pole K C'^-1 N.
    pole = CAMERA.K @ np.linalg.solve(circle.cone(), pose.normals[best])
    np.testing.assert_allclose(pole[:2] / pole[2], seen, rtol=1e-6, atol=1e-5)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(circles(), st.floats(-12, 12), st.sampled_from([-1.0, 1.0]))
def test_scale_and_sign_of_the_cone_do_not_matter(circle, exponent, sign):
    first = circle_pose(circle.cone())
    second = circle_pose(sign * 10.0**exponent * circle.cone())
    g = np.radians(angle_deg(-first.normals[0], first.axis))
    assume(g > BRANCH_TILT)
    # e1 is defined up to its sign, so the candidates may change places.
    swapped = angle_deg(first.normals[0], second.normals[0]) > angle_deg(first.normals[0], second.normals[1])
    order = [1, 0] if swapped else [0, 1]
    assert angle_deg(first.normals, second.normals[order]).max() < EXACT_DEG
    assert angle_deg(first.centres, second.centres[order]).max() < EXACT_DEG
    assert angle_deg(first.axis, second.axis) < EXACT_DEG
    np.testing.assert_allclose(first.axis_ratio, second.axis_ratio, rtol=1e-7)


@settings(max_examples=examples(300), deadline=None, derandomize=True)
@given(circles())
def test_axis_points_into_the_scene_and_lies_inside_the_cone(circle):
    pose, _, _ = solve(circle)
    assert pose.axis[2] > 0
    cone = circle.cone()
    assert pose.axis @ cone @ pose.axis * np.linalg.det(cone) > 0  # the cone's inside has the sign of det C'
    values, vectors = cone_axes(cone)
    assert values[0] >= values[1] > 0 > values[2]
    assert np.linalg.det(vectors) > 0.999999
    np.testing.assert_allclose(pose.axis_ratio, np.sqrt(values[1] / values[0]), rtol=1e-12)


def test_axis_ratio_is_that_of_the_half_angles():
    # A circle of slant 60 deg on the axis: cos(60 deg) across, second order in the radius.
    normal = np.array([np.sin(np.pi / 3), 0, -np.cos(np.pi / 3)])
    pose, _, _ = solve(Circle(np.array([0.0, 0, 1]), normal, 1e-3))
    assert abs(pose.axis_ratio - 0.5) < 1e-5


@settings(max_examples=examples(200), deadline=None, derandomize=True)
@given(circles(max_off_axis_deg=60))
def test_pose_from_points_in_the_image(circle):
    """Points, ellipse fit, K^T C K and pose together; a camera with skew and unequal focal lengths."""
    assume(circle.nearest_z > 0.1)
    assume(circle.radius > np.tan(np.radians(0.5)))
    fitted = fit_ellipse(CAMERA.project(circle.points(64)))
    assert not isinstance(fitted, Failure)
    pose = circle_pose(cone_of_conic(fitted, CAMERA.K))
    tilt = np.radians(angle_deg(-pose.normals[0], pose.axis))
    errors = angle_deg(pose.normals, circle.normal)
    assert errors.min() < (1e-5 if tilt > 0.01 else 1e-2)
    assert angle_deg(pose.centres[errors.argmin()], circle.sight) < 1e-4


def test_what_is_no_cone_fails_with_a_reason():
    for matrix in (np.eye(3), -np.eye(3), np.zeros((3, 3)), np.diag([1.0, 0.0, -1.0]), np.diag([1.0, 1.0, 0.0])):
        result = circle_pose(matrix)
        assert isinstance(result, Failure)
        assert result.reason is Reason.DEGENERATE_CONIC
    for bad in (np.nan, np.inf):
        result = circle_pose(np.diag([1.0, bad, -1.0]))
        assert isinstance(result, Failure)
        assert result.reason is Reason.NOT_FINITE


# Many at once ---------------------------------------------------------------------------------------------------------


EYE = Camera(406, 406, 406.0, 420.0, 203.0, 190.0, 1.5)


def contour(rng):
    """A noisy ellipse, or now and then what is none."""
    count = int(rng.integers(6, 300))
    phase = rng.uniform(0, 2 * np.pi, count)
    a, b = rng.uniform(2, 80, 2)
    points = np.stack([200 + a * np.cos(phase), 180 + b * np.sin(phase)], axis=1) + rng.normal(0, 0.2, (count, 2))
    match int(rng.integers(12)):
        case 0:
            return points[:4]
        case 1:
            points[count // 2] = np.nan
        case 2:
            points[:, 1] = 3 * points[:, 0]
        case 3:
            points[:] = points[0]
        case 4:
            points *= 1e160
    return points


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 40))
def test_a_batch_is_its_members(seed, count):
    rng = np.random.default_rng(seed)
    contours = [contour(rng) for _ in range(count)]
    fitted = fit_ellipses(contours)
    poses = circle_poses(cone_of_conic(fitted, EYE.K))
    assert len(fitted) == count
    for i, points in enumerate(contours):
        alone = fit_ellipse(points)
        if isinstance(alone, Failure):
            assert fitted[i] == alone
            continue
        np.testing.assert_array_equal(fitted[i].normalised, alone.normalised)
        np.testing.assert_array_equal(fitted[i].normalised_from_image, alone.normalised_from_image)
        pose, single = poses[i], circle_pose(cone_of_conic(alone, EYE.K))
        np.testing.assert_array_equal(pose.normals, single.normals)
        np.testing.assert_array_equal(pose.centres, single.centres)
        assert pose.axis_ratio == single.axis_ratio


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_cones_that_look_backwards_are_those_that_look_forwards_turned(seed, count):
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 2 * np.pi, 40)
    rings = [
        rng.uniform(100, 300, 2) + np.stack([rng.uniform(5, 40) * np.cos(phase), 20 * np.sin(phase)], 1)
        for _ in range(count)
    ]
    cones = cone_of_conic(fit_ellipses(rings), EYE.K)
    turns, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    turns *= np.linalg.det(turns)[:, None, None]
    turned = turns @ cones @ turns.transpose(0, 2, 1)
    inside = EYE.unproject(np.array([ring[:-1].mean(axis=0) for ring in rings]))
    sightlines = np.einsum("nij,nj->ni", turns, inside)
    forward, back = circle_poses(cones), circle_poses(turned, sightlines)
    for i in range(count):
        first, second, alone = forward[i], back[i], circle_pose(turned[i], sightlines[i])
        np.testing.assert_allclose(second.axis, turns[i] @ first.axis, atol=1e-9)
        # Which of the two normals comes first is a matter of an eigenvector's sign.
        expected = first.normals @ turns[i].T
        expected = expected if abs(second.normals[0] - expected[0]).max() < 1e-4 else expected[::-1]
        np.testing.assert_allclose(second.normals, expected, atol=1e-4)
        np.testing.assert_array_equal(second.normals, alone.normals)
        np.testing.assert_array_equal(second.axis, alone.axis)
    # Negative control: taken to look forwards, those that look backwards have the opposite axis.
    wrong = circle_poses(turned)
    behind = (back.axes[:, 2] < 0)[:, None]
    np.testing.assert_array_equal(wrong.axes, np.where(behind, -back.axes, back.axes))


def test_a_batch_holds_every_kind_of_outcome():
    """So that the test above cannot pass by meeting failures alone, or none."""
    rng = np.random.default_rng(0)
    fitted = fit_ellipses([contour(rng) for _ in range(400)])
    poses = circle_poses(np.where(rng.random((400, 1, 1)) < 0.5, np.eye(3), np.diag([1.0, 1.0, -1.0])))
    for batch in (fitted, poses):
        for i in (0, *list(batch.failures)[:3]):
            assert isinstance(batch[i], Failure) == isinstance(batch[i - len(batch)], Failure) == (i in batch.failures)
        for outside in (400, -401):
            with pytest.raises(IndexError):
                batch[outside]
        with pytest.raises(TypeError):
            batch[1:3]
    reasons = {failure.reason for failure in fitted.failures.values()}
    assert len(reasons) >= 3
    assert len(fitted.failures) < 200
