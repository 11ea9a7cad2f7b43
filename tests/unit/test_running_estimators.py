"""Running an estimator on several highlights: its own way for all at once gives what it gives one by one."""

from dataclasses import replace

import numpy as np
import pytest

from simtest.errors import Failure, Reason
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.execution_guard import run, run_each
from simtest.estimators.protocol import answers_each
from simtest.geometry import Camera, Patch, smooth

CAMERA = Camera(400, 100, 406.0, 406.0, 200.0, 50.0)
SIGMA, SMOOTHING_PX = 0.02, 2.0
CENTRES = ((50.3, 49.6), (151.2, 52.2), (252.7, 47.9))


@pytest.fixture(scope="module")
def patches():
    y, x = np.mgrid[:100, :400] + 0.5
    lobes = sum(np.exp(-((x - cx) ** 2 + (1 + k) * (y - cy) ** 2) / 400) for k, (cx, cy) in enumerate(CENTRES))
    frame = (lobes + SIGMA * np.random.default_rng(0).standard_normal(lobes.shape)).astype(np.float32)
    smoothed = smooth(frame, SMOOTHING_PX)
    made = [
        Patch.cut(smoothed, (left, 0, 100, 100), raw=frame, noise=SIGMA, smoothing_px=SMOOTHING_PX)
        for left in (0, 100, 200)
    ]
    return [made[0], Failure(Reason.NO_PEAK, "none"), *made[1:]]


def test_circle_pose_gives_the_same_of_all_at_once(patches):
    together = run_each(circle_pose, patches, CAMERA)
    for patch, found in zip(patches, together, strict=True):
        alone = run(circle_pose, patch, CAMERA)
        if isinstance(alone, Failure):
            assert found == alone
            continue
        np.testing.assert_array_equal(found.candidates, alone.candidates)
        assert found.choice_margin == alone.choice_margin
        assert found.flags == alone.flags
        assert found.region.statistic(alone.candidates + 0.01) == pytest.approx(
            alone.region.statistic(alone.candidates + 0.01)
        )


def faulty(how):
    def each(patches, camera):
        if how == "raises":
            raise ValueError("spoilt by one of them")
        results = [patch if isinstance(patch, Failure) else brightest_point(patch, camera) for patch in patches]
        if how == "loses one":
            return results[1:]
        results[0] = replace(results[0], normal=np.array([np.nan, 0.0, -1.0]))
        return results

    return answers_each(each)(lambda patch, camera: brightest_point(patch, camera))


@pytest.mark.parametrize("how", ["raises", "loses one"])
def test_each_patch_is_run_alone_where_all_at_once_fails(patches, how):
    found = run_each(faulty(how), patches, CAMERA)
    assert isinstance(found[1], Failure)
    for i in (0, 2, 3):
        np.testing.assert_array_equal(found[i].normal, brightest_point(patches[i], CAMERA).normal)


def test_what_comes_of_all_at_once_is_checked(patches):
    found = run_each(faulty("not finite"), patches, CAMERA)
    assert found[0].reason == Reason.NOT_FINITE
    assert not isinstance(found[2], Failure)
