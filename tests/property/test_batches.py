"""Fits and poses of many conics at once are those of each alone, to the last bit, failures included."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.errors import Failure
from simtest.geometry import Camera, backproject_conic, circle_poses, fit_ellipse, fit_ellipses
from simtest.geometry.circle_pose import circle_pose

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
    poses = circle_poses(backproject_conic(fitted, CAMERA))
    assert len(fitted) == count
    for i, points in enumerate(contours):
        alone = fit_ellipse(points)
        if isinstance(alone, Failure):
            assert fitted[i] == alone
            continue
        np.testing.assert_array_equal(fitted[i].normalised, alone.normalised)
        np.testing.assert_array_equal(fitted[i].normalised_from_image, alone.normalised_from_image)
        pose, single = poses[i], circle_pose(backproject_conic(alone, CAMERA))
        np.testing.assert_array_equal(pose.normals, single.normals)
        np.testing.assert_array_equal(pose.centres, single.centres)
        assert pose.axis_ratio == single.axis_ratio


def test_a_batch_holds_every_kind_of_outcome():
    """So that the test above cannot pass by meeting failures alone, or none."""
    rng = np.random.default_rng(0)
    fitted = fit_ellipses([contour(rng) for _ in range(400)])
    reasons = {failure.reason for failure in fitted.failures.values()}
    assert len(reasons) >= 3
    assert len(fitted.failures) < 200
