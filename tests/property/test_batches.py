"""Fits and poses of many conics at once are those of each alone, to the last bit, failures included."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.errors import Failure
from simtest.geometry import Camera, circle_poses, cone_of_conic, fit_ellipse, fit_ellipses
from simtest.geometry.cones import circle_pose

CAMERA = Camera(406, 406, 406.0, 420.0, 203.0, 190.0, 1.5)


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
    poses = circle_poses(cone_of_conic(fitted, CAMERA.K))
    assert len(fitted) == count
    for i, points in enumerate(contours):
        alone = fit_ellipse(points)
        if isinstance(alone, Failure):
            assert fitted[i] == alone
            continue
        np.testing.assert_array_equal(fitted[i].normalised, alone.normalised)
        np.testing.assert_array_equal(fitted[i].normalised_from_image, alone.normalised_from_image)
        pose, single = poses[i], circle_pose(cone_of_conic(alone, CAMERA.K))
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
    cones = cone_of_conic(fit_ellipses(rings), CAMERA.K)
    turns, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    turns *= np.linalg.det(turns)[:, None, None]
    turned = turns @ cones @ turns.transpose(0, 2, 1)
    inside = CAMERA.unproject(np.array([ring[:-1].mean(axis=0) for ring in rings]))
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
