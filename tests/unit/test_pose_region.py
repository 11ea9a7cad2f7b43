"""The region of circle pose, on cones whose noise is Gaussian by construction."""

import numpy as np
import pytest
from scipy import stats

from simtest.estimators.circle_pose import _conic, _ellipse
from simtest.geometry import circle_pose
from simtest.geometry.cones import PoseRegion

FRAME = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0].T


def circle_cone(tilt, radius=0.1):
    """(a, b, c, d, e) of the cone of a circle at unit distance, its normal tilted from the cone's axis, and N."""
    N = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    centre, u, v = np.array([0.0, 0, 1]), np.array([np.cos(tilt), 0, np.sin(tilt)]), np.array([0.0, 1, 0])
    M = np.linalg.inv(np.stack([u * radius, v * radius, centre], axis=1))
    C = M.T @ np.diag([1.0, 1, -1]) @ M
    C /= -C[2, 2]
    return np.array([C[0, 0], 2 * C[0, 1], C[1, 1], 2 * C[0, 2], 2 * C[1, 2]]), N


def cone_of(conic):
    a, b, c, d, e = conic
    return FRAME.T @ np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, -1.0]]) @ FRAME


@pytest.mark.parametrize("tilt_deg", [0.5, 20.0, 70.0])
def test_both_members_lie_at_zero_and_others_do_not(tilt_deg):
    conic, N = circle_cone(np.radians(tilt_deg))
    region = PoseRegion(FRAME, conic, np.diag(1e-4 * conic**2 + 1e-3))
    pose = circle_pose(cone_of(conic), FRAME[2])
    assert np.abs(pose.normals @ FRAME.T - N).max(axis=1).min() < 1e-6
    np.testing.assert_allclose(region.statistic(pose.normals), 0, atol=1e-9)
    assert region.statistic(N @ FRAME) == pytest.approx(0, abs=1e-9)
    assert region.statistic(np.array([0.0, np.sin(1.0), -np.cos(1.0)]) @ FRAME) > 10


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0, 40.0])
def test_it_holds_the_truth_as_often_as_it_says(tilt_deg):
    """Chi-squared with two degrees of freedom, at the branch point as far from it; half the noise is not."""
    conic, N = circle_cone(np.radians(tilt_deg))
    rng = np.random.default_rng(11)
    root = np.diag(0.01 * np.array([100, 100, 100, 3, 3.0])) @ (np.eye(5) + 0.3 * rng.standard_normal((5, 5)))
    covariance = root @ root.T
    drawn = conic + rng.standard_normal((4000, 5)) @ root.T
    T = np.array([PoseRegion(FRAME, own, covariance).statistic(N @ FRAME) for own in drawn])
    assert stats.kstest(T, stats.chi2(2).cdf).pvalue > 0.003
    assert 0.935 < np.mean(stats.chi2.ppf(0.95, 2) >= T) < 0.965
    assert np.mean(stats.chi2.ppf(0.95, 2) >= T / 0.25) < 0.6


def test_regions_merge_where_the_members_meet():
    """Between the members, along the way from one to the other, lies the axis."""
    for tilt_deg, merged in ((1.0, True), (40.0, False)):
        conic, N = circle_cone(np.radians(tilt_deg))
        region = PoseRegion(FRAME, conic, np.diag([1.0, 1, 1, 1e-3, 1e-3]))
        assert region.contains(N @ FRAME)
        assert bool(region.contains(-FRAME[2])) == merged


def test_wider_confidence_holds_more():
    conic, _ = circle_cone(0.3)
    region = PoseRegion(FRAME, conic, np.diag([1.0, 1, 1, 1e-3, 1e-3]))
    normals = np.random.default_rng(0).standard_normal((500, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    assert region.contains(normals, 0.5).sum() <= region.contains(normals, 0.99).sum()
    assert (region.contains(normals, 0.99) | ~region.contains(normals, 0.5)).all()


def test_conic_and_ellipse_are_inverse():
    conic = np.array([90.0, 12, 60, 3, -2])
    np.testing.assert_allclose(_conic(_ellipse(conic)), conic, rtol=1e-10)


@pytest.mark.parametrize("azimuth_deg", [25.0, 110.0, 250.0])
def test_members_of_cones_turned_about_their_axis_lie_at_zero(azimuth_deg):
    """Then all of the conic's five parameters count, the mixed ones too."""
    (a, b, c, d, e), N = circle_cone(np.radians(30.0))
    s, t = np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))
    R = np.array([[t, -s, 0.0], [s, t, 0.0], [0.0, 0.0, 1.0]])
    C = R @ np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, -1.0]]) @ R.T
    conic = np.array([C[0, 0], 2 * C[0, 1], C[1, 1], 2 * C[0, 2], 2 * C[1, 2]])
    region = PoseRegion(FRAME, conic, np.diag(1e-4 * conic**2 + 1e-3))
    assert region.statistic(R @ N @ FRAME) == pytest.approx(0, abs=1e-9)
    assert region.statistic(R.T @ N @ FRAME) > 10
