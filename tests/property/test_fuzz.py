"""Random conics, contours and patches: whatever they are, an estimate that holds numbers, or a Failure."""

import numpy as np
import pytest

from simtest.calibration import Normal, Priors, exactly
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.bisector import bisector
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.circle_pose import circle_pose as circle_pose_estimator
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.dispatch import run
from simtest.estimators.highlight import fit_highlight
from simtest.estimators.photometric import photometric
from simtest.geometry import Camera, FittedArc, FittedConic, KannalaBrandt, Patch, circle_pose, fit_arc, fit_ellipse
from simtest.validation.paper.plane_from_aside import photometric_plane
from tests.marked import marked

ESTIMATORS = {
    "cone_axis": cone_axis,
    "curved": curved,
    "bisector": bisector,
    "circle_pose": circle_pose_estimator,
    "brightest_point": brightest_point,
    "photometric": photometric,
    "photometric_plane": photometric_plane,
}
KNOWN = Priors(((1.0, 0.0, 0.0), (-1.0, 0.5, 0.0)), Normal(10.0, 1.0), exactly(200.0))
FISHEYE = Camera(48, 40, 30.0, 30.0, 24.0, 20.0, distortion=KannalaBrandt(0.01, 0.0, 0.0, 0.0))
CAMERAS = (Camera(48, 40, 60.0, 60.0, 24.0, 20.0), FISHEYE)
KINDS = 8


def conic(rng):
    """Symmetric or not quite, of any signature and size, now and then with a bad entry."""
    C = rng.normal(size=(3, 3))
    match rng.integers(5):
        case 0:
            C = C + C.T
        case 1:
            C = C @ C.T
        case 2:
            C = np.outer(C[0], C[0])
        case 3:
            C = np.diag(rng.integers(-1, 2, 3).astype(float))
        case _:
            C[rng.integers(3), rng.integers(3)] = rng.choice([np.nan, np.inf, -np.inf, 0.0])
    return C * 10.0 ** rng.uniform(-200, 200)


def contour(rng):
    """Arcs, lines, hyperbolas, few points, bad points, huge and tiny coordinates."""
    count = int(rng.integers(0, 40))
    t = rng.uniform(0, rng.uniform(0.1, 6.3), count)
    points = np.stack([rng.uniform(0.01, 9) * np.cos(t), np.sin(t)], axis=1)
    match rng.integers(8):
        case 0:
            points = points + 0.1 * rng.normal(size=points.shape)
        case 1:
            points = np.stack([np.cosh(t), np.sinh(t)], axis=1)
        case 2:
            points = np.outer(t, rng.normal(size=2)) + rng.normal(size=2)
        case 3:
            points = rng.normal(size=(2, 2))
        case 4 if count:
            points[rng.integers(count), rng.integers(2)] = rng.choice([np.nan, np.inf, 1e308, -1e200])
        case 5:
            points = points * 10.0 ** rng.uniform(-300, 300) + 10.0 ** rng.uniform(-5, 15)
        case 6 if count:
            points = points[rng.integers(0, count, 12)]
        case _:
            points = np.round(points)
    return points


def patch(rng):
    """Noise, lobes whole and cut, plateaus, streaks, two lobes, slopes, steps, bad values; with or without a mask."""
    y, x = np.mgrid[:40, :48].astype(float)
    cx, cy = rng.uniform(-5, 53), rng.uniform(-5, 45)
    wide, narrow = rng.uniform(0.3, 25, 2)
    lobe = np.exp(-((x - cx) ** 2) / wide**2 - (y - cy) ** 2 / narrow**2)
    values = lobe + rng.choice([0.0, 1e-3, 0.05, 0.5]) * rng.normal(size=lobe.shape)
    saturated = seen = None
    match rng.integers(KINDS):
        case 0:
            values = rng.normal(size=lobe.shape)
        case 1:
            values = np.minimum(values, rng.uniform(0.05, 0.9))
            saturated = values >= values.max()
        case 2:
            values = values + np.roll(lobe, int(rng.integers(-20, 20)), axis=1)
        case 3:
            values = x * rng.normal() + y * rng.normal() + 0.1 * values
        case 4:
            values[rng.integers(40), rng.integers(48)] = rng.choice([np.nan, np.inf, 1e30, -1e30])
        case 5:
            values = np.round(values * rng.integers(1, 5))
        case 6:
            seen = (x - 24) ** 2 + (y - 20) ** 2 < rng.uniform(2, 30) ** 2
        case _:
            values = values * 10.0 ** rng.uniform(-30, 30)
    if seen is not None:
        values = np.where(seen, values, 0.0)
    noise = rng.choice([None, 0.0, 0.02])
    raw = values if rng.random() < 0.5 else None
    return Patch.cut(
        values, (0, 0, 48, 40), saturated=saturated, seen=seen, raw=raw, noise=noise,
        smoothing_px=float(rng.choice([0.0, 2.0])),
    )  # fmt: skip


def check_conic(rng):
    result = circle_pose(conic(rng))
    if isinstance(result, Failure):
        return False
    assert np.isfinite(result.normals).all()
    assert np.isfinite(result.axis).all()
    assert np.isfinite(result.axis_ratio)
    assert np.allclose(np.linalg.norm(result.normals, axis=1), 1)
    return True


def check_contour(rng):
    points = contour(rng)
    whole, arc = fit_ellipse(points), fit_arc(points)
    for result in (whole, arc):
        if isinstance(result, Failure):
            continue
        fitted = result.conic if isinstance(result, FittedArc) else result
        assert isinstance(fitted, FittedConic)
        assert np.isfinite(fitted.normalised).all()
        assert np.isfinite(fitted.normalised_from_image).all()
        assert np.linalg.eigvalsh(fitted.normalised[:2, :2])[0] > 0
    if isinstance(arc, FittedArc):
        assert np.isfinite([arc.arc, arc.residual]).all()
    return not isinstance(arc, Failure)


def check_patch(rng):
    made, camera = patch(rng), CAMERAS[rng.integers(2)]
    name = list(ESTIMATORS)[rng.integers(len(ESTIMATORS))]
    result = run(ESTIMATORS[name], made, camera, KNOWN if rng.random() < 0.5 else Priors())
    if isinstance(result, Failure):
        # `run` turns what an estimator raises, and numbers that are none, into these: ours must do neither.
        assert result.reason not in (Reason.ESTIMATOR_ERROR,), (name, result)
        assert not (result.reason == Reason.NOT_FINITE and "holds NaN" in result.detail and "region" not in
                    result.detail and "points" not in result.detail), (name, result)  # fmt: skip
        return False
    for value in (result.normal, result.candidates, *([] if result.covariance is None else [result.covariance])):
        assert np.isfinite(value).all(), name
    if result.curvature is not None:
        assert np.isfinite(result.curvature.directions).all()
        assert np.isfinite(result.curvature.axis_ratio)
        assert result.curvature.hypotheses is None or np.isfinite(result.curvature.hypotheses).all()
    if result.covariance is not None:
        assert np.linalg.eigvalsh(result.covariance)[0] >= -1e-12 * abs(result.covariance).max(), name
    return True


CHECKS = {"conics": check_conic, "contours": check_contour, "patches": check_patch}


OFTEN = [("conics", 10**6, 60_000), ("contours", 10**6, 25_000), ("patches", 10**6, 15_000)]


@pytest.mark.parametrize(
    ("kind", "first", "count"),
    marked([("conics", 0, 300), ("contours", 0, 150), ("patches", 0, 150), *OFTEN], slow=OFTEN),
)
def test_nothing_raises_and_nothing_ok_holds_nan(kind, first, count):
    answered = sum(CHECKS[kind](np.random.default_rng([first + i, 7])) for i in range(count))
    # Both outcomes must occur, or the inputs are not what they are meant to be.
    assert 0.02 * count < answered < 0.98 * count


def test_an_isophote_that_is_no_ellipse_across_the_axis_is_a_failure():
    # An arc through a fisheye: an ellipse in the picture, and a hyperbola across the mean axis of all isophotes.
    rng = np.random.default_rng([10**6 + 1035, 7])
    made, camera = patch(rng), CAMERAS[rng.integers(2)]
    family = fit_highlight(made, camera, CONE_AXIS_ISOVALUES)
    assert family.are_ellipses.all()
    assert Reason.NOT_AN_ELLIPSE in [failure.reason for failure in family.failures]
    assert "missing_isovalues" in run(cone_axis, made, camera, Priors()).flags
