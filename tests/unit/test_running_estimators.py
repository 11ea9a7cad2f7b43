"""Running an estimator: on one highlight, on several at once, on the whole frame."""

import re
import warnings
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, Normal, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.detection import Detection, Region
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import BatchEstimator, Estimate, Estimator, FrameEstimator, load_estimators
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.circle_pose import circle_pose
from simtest.estimators.cone_axis import ConeAxis
from simtest.estimators.dispatch import prepare, run, run_each, run_in_frame
from simtest.estimators.protocol import EstimatedCurvature, check
from simtest.geometry import Camera, Patch, smooth
from simtest.reconstruction.pipeline import UNRESOLVED, _flagged, reconstruct
from simtest.validation.scoring import match

CAMERA = Camera(400, 100, 406.0, 406.0, 200.0, 50.0)
SIGMA, SMOOTHING_PX = 0.02, 2.0
CENTRES = ((50.3, 49.6), (151.2, 52.2), (252.7, 47.9))


def picture():
    y, x = np.mgrid[:100, :400] + 0.5
    lobes = sum(np.exp(-((x - cx) ** 2 + (1 + k) * (y - cy) ** 2) / 400) for k, (cx, cy) in enumerate(CENTRES))
    return (lobes + SIGMA * np.random.default_rng(0).standard_normal(lobes.shape)).astype(np.float32)


@pytest.fixture(scope="module")
def patches():
    frame = picture()
    smoothed = smooth(frame, SMOOTHING_PX)
    made = [
        Patch.cut(smoothed, (left, 0, 100, 100), raw=frame, noise=SIGMA, smoothing_px=SMOOTHING_PX)
        for left in (0, 100, 200)
    ]
    return [made[0], Failure(Reason.NO_PEAK, "none"), *made[1:]]


def test_the_order_of_isovalues_is_irrelevant():
    """Two touching highlights: the lower isophotes, which hold both, are left out whatever their place in the list."""
    y, x = np.mgrid[:120, :120] + 0.5
    left_out = 0
    for angle in range(12):
        gap = (20 + angle % 6) * np.array([np.cos(angle), np.sin(angle)])
        second = np.exp(-((x - 60 - gap[0]) ** 2 + (y - 60 - gap[1]) ** 2) / 120)
        patch = Patch.cut(np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / 162) + 0.7 * second, (10, 10, 100, 100))
        first, *others = (
            ConeAxis(order).estimate(replace(patch), CAMERA)
            for order in (
                CONE_AXIS_ISOVALUES,
                CONE_AXIS_ISOVALUES[::-1],
                (*CONE_AXIS_ISOVALUES[2:], *CONE_AXIS_ISOVALUES),
            )
        )
        left_out += len(first.isophotes) < len(CONE_AXIS_ISOVALUES)
        for other in others:
            np.testing.assert_array_equal(other.normal, first.normal)
            assert [i.isovalue for i in other.isophotes] == [i.isovalue for i in first.isophotes]
    assert left_out >= 3


# `replace` leaves what was fitted to a patch behind.
@pytest.mark.parametrize("name", ["cone_axis", "curved", "brightest_point", "bisector", "photometric", "circle_pose"])
def test_no_other_highlight_of_a_batch_changes_a_digit(patches, name):
    (estimator,) = load_estimators([name]).values()
    priors = Priors(lights_mm=((3.0, 0.0, 0.0),), distance_mm=Normal(30.0, 2.0), plane=name == "circle_pose")
    fresh = [patch if isinstance(patch, Failure) else replace(patch) for patch in patches]
    prepare([estimator], fresh, CAMERA)
    together = run_each(estimator, fresh, CAMERA, priors)
    answered = 0
    for patch, found in zip(patches, together, strict=True):
        alone = run(estimator, patch if isinstance(patch, Failure) else replace(patch), CAMERA, priors)
        if isinstance(alone, Failure):
            assert found == alone
            continue
        answered += 1
        np.testing.assert_array_equal(found.candidates, alone.candidates)
        np.testing.assert_array_equal(found.look_px, alone.look_px)
        assert (found.choice_margin, found.flags) == (alone.choice_margin, alone.flags)
        assert (found.region is None) == (alone.region is None) == (name != "circle_pose")
        if alone.region is not None:
            apart = alone.candidates + 0.01
            assert found.region.statistic(apart) == pytest.approx(alone.region.statistic(apart))
        assert (found.covariance is None) == (alone.covariance is None)
        if alone.covariance is not None:
            np.testing.assert_array_equal(found.covariance, alone.covariance)
    assert answered == 3


# A batch --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Faulty:
    """Estimates as brightest_point does; its batch has a fault."""

    how: str

    def estimate(self, patch, camera, priors):
        if self.how == "raises alone too" and patch.origin_px[0] == 100:
            raise KeyError("this one")
        return brightest_point.estimate(patch, camera, priors)

    def estimate_batch(self, patches, camera, priors):
        if "raises" in self.how:
            raise ValueError("spoilt by one of them")
        results = [brightest_point.estimate(patch, camera, priors) for patch in patches]
        return results[1:]


@pytest.mark.parametrize(
    ("how", "why"),
    [("raises", "ValueError: spoilt by one of them"), ("loses one", "ValueError: 2 results for 3 patches")],
)
def test_a_batch_that_fails_is_told_and_each_patch_is_run_alone(patches, how, why):
    with pytest.warns(RuntimeWarning, match=f"Faulty.estimate_batch failed.*{why}"):
        found = run_each(Faulty(how), patches, CAMERA)
    assert found[1] is patches[1]
    for i in (0, 2, 3):
        np.testing.assert_array_equal(found[i].normal, brightest_point.estimate(patches[i], CAMERA).normal)


def test_where_a_patch_alone_raises_too_it_is_a_failure_with_its_text(patches):
    with pytest.warns(RuntimeWarning, match="spoilt by one of them"):
        found = run_each(Faulty("raises alone too"), patches, CAMERA)
    assert found[2].reason == Reason.ESTIMATOR_ERROR
    # The exception's own line, so that its author finds it.
    assert re.fullmatch(r"KeyError: 'this one' \(test_running_estimators\.py:\d+\)", found[2].detail)
    assert isinstance(found[0], Estimate)
    assert isinstance(found[3], Estimate)


# The whole frame ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Peaks:
    """Looks from the whole frame at given pixels, or does something else."""

    looks: tuple[tuple[float, float], ...] = ()
    does: str = "estimates"

    def estimate_frame(self, frame, camera, priors):
        if self.does == "raises":
            raise ZeroDivisionError("somewhere in the frame")
        if self.does == "refuses":
            return Failure(Reason.NOT_CONVERGED, "nowhere")
        assert frame.smoothed.shape == frame.encoded.shape == (camera.height, camera.width)
        assert isinstance(frame.noise, float)
        normals = [-camera.unproject(look) for look in self.looks]
        if self.does == "is crooked":
            normals[0] = 2 * normals[0]
        return [
            Estimate(normal, normal[None], np.array(look)) for normal, look in zip(normals, self.looks, strict=True)
        ]


def in_frame(estimator, patches):
    return run_in_frame(estimator, Frame(picture(), Calibration(CAMERA), SMOOTHING_PX), patches)


def test_estimates_of_a_frame_go_to_the_patches_that_they_look_into(patches):
    # Two near the first peak, the nearer one second; one by the third; one where no patch is.
    looks = ((55.0, 50.0), (51.0, 50.0), (253.0, 48.0), (390.0, 50.0))
    found = in_frame(Peaks(looks), patches)
    first, none, second, third = found.of_patches
    assert first.look_px.tolist() == [51.0, 50.0]
    assert none is patches[1]
    assert second == Failure(Reason.NO_ESTIMATE, "the estimator has none in this region")
    assert third.look_px.tolist() == [253.0, 48.0]
    assert [estimate.look_px.tolist() for estimate in found.elsewhere] == [[55.0, 50.0], [390.0, 50.0]]


@dataclass(frozen=True)
class Regions(Peaks):
    """Answers region by region, and for what no region holds."""

    results: tuple = ()
    others: tuple = ()

    def estimate_regions(self, frame, patches):
        if self.does == "raises":
            raise ZeroDivisionError("in a region")
        return list(self.results), list(self.others)


@pytest.mark.parametrize(
    ("estimator", "reason", "said"),
    [
        (Peaks(does="raises"), Reason.ESTIMATOR_ERROR, "ZeroDivisionError: somewhere in the frame"),
        (Peaks(does="refuses"), Reason.NOT_CONVERGED, "nowhere"),
        (Regions(does="raises"), Reason.ESTIMATOR_ERROR, "ZeroDivisionError: in a region"),
        (Regions(results=(None,)), Reason.ESTIMATOR_ERROR, "ValueError: 1 results for 4 regions"),
    ],
)
def test_a_frame_that_fails_is_the_failure_of_every_patch(patches, estimator, reason, said):
    found = in_frame(estimator, patches)
    assert found.of_patches[1] is patches[1]
    for i in (0, 2, 3):
        assert (found.of_patches[i].reason, said in found.of_patches[i].detail) == (reason, True)
    assert found.elsewhere == []


def test_one_malformed_estimate_of_a_frame_leaves_the_others(patches):
    crooked = in_frame(Peaks(CENTRES, "is crooked"), patches)
    assert crooked.of_patches[0] == Failure(
        Reason.ESTIMATOR_ERROR, "estimate 0: normal of length 2: must be a unit vector"
    )
    assert isinstance(crooked.of_patches[2], Estimate)
    assert isinstance(crooked.of_patches[3], Estimate)
    # One that looks far away is at no highlight: those without an estimate say so, or else a warning.
    astray = in_frame(Peaks(((900.0, 50.0), CENTRES[1])), patches)
    assert [astray.of_patches[i].reason for i in (0, 3)] == [Reason.ESTIMATOR_ERROR] * 2
    assert isinstance(astray.of_patches[2], Estimate)
    with pytest.warns(RuntimeWarning, match=r"Peaks: 1 malformed at no highlight: estimate 0: look_px: .* \(900, 50\)"):
        in_frame(Peaks(((900.0, 50.0), *CENTRES)), patches)
    # A rounded pixel beside the frame, where a border cuts a highlight, is none.
    assert len(in_frame(Peaks(((-0.4, 50.0), *CENTRES)), patches).elsewhere) == 1


def test_what_a_region_estimator_states_elsewhere_is_checked(patches):
    normal = np.array([0.0, 0.0, -1.0])
    good, bad, other = (Estimate(scale * normal, scale * normal[None], np.array([9.0, 9.0])) for scale in (1, 5, 4))
    with pytest.warns(RuntimeWarning, match="Regions: 1 malformed at no highlight: normal of length 4"):
        found = in_frame(Regions(results=(good, None, bad, None), others=(good, other)), patches)
    assert found.of_patches[2].reason == Reason.ESTIMATOR_ERROR
    assert (found.of_patches[0], found.elsewhere) == (good, [good])


# The contract ---------------------------------------------------------------------------------------------------------

UP = np.array([0.0, 0.0, -1.0])
MALFORMED = {
    "target": ({"target": "rough"}, "target 'rough'; must be fine or base"),
    "long": ({"normal": 1.1 * UP}, "normal of length 1.1"),
    "another first": ({"candidates": np.array([[0.0, 0.6, -0.8]])}, "the first candidate must be"),
    "no candidate": ({"candidates": np.empty((0, 3))}, "0 candidates; must be 1 to 64"),
    "asymmetric": ({"covariance": 1e-4 * np.array([[1.0, 0.5], [-0.5, 1.0]])}, "must be symmetric"),
    "negative": ({"budget": {"noise": np.eye(2), "shape": np.diag([-0.5, 0.5])}}, "budget shape .*no negative"),
    "degrees": ({"covariance": 25 * np.eye(2)}, "covariance: holds 25; must be at most 9.87 rad"),
    "singular": ({"covariance": np.diag([1e-4, 0.0])}, "covariance: singular"),
    "no budget": ({"budget": {}}, "budget: must be 1 to 16 parts"),
    "part of 3": ({"budget": {"noise": np.eye(3)}}, r"budget noise: must be an array of shape \(2, 2\)"),
    "part of NaN": ({"budget": {"noise": np.full((2, 2), np.nan)}}, "holds NaN or infinity"),
    "another sum": (
        {"budget": {"noise": 1e-6 * np.eye(2)}, "covariance": 1e-4 * np.eye(2)},
        "be the sum of the",
    ),
    "ratio": ({"axis_ratio": 7.0}, r"axis_ratio: 7; must be in \(0, 1\]"),
    "deviation": ({"axis_ratio_deviation": -1.0}, "axis_ratio_deviation: -1; must be above 0"),
    "far away": ({"look_px": np.array([1e7, -5.0])}, r"look_px: looks at the pixel \(1e\+07, -5\)"),
    "away": ({"normal": -UP, "candidates": -UP[None]}, "the normal faces away from the camera"),
    "curvature": ({"curvature": EstimatedCurvature(np.eye(3)[:2], 2.0)}, "curvature axis_ratio: 2"),
    "flag": ({"flags": ("a,b",)}, r"flags: \('a,b',\); must be a tuple of at most 16 texts"),
    "not finite": ({"normal": np.array([np.nan, 0.0, -1.0])}, "normal holds NaN"),
    "nowhere": ({"look_px": np.array([np.nan, 1.0])}, "look_px holds NaN"),
}


@pytest.mark.parametrize("fault", MALFORMED)
def test_a_malformed_estimate_is_refused_alone_in_a_batch_in_a_frame_and_elsewhere(patches, fault):
    changes, said = MALFORMED[fault]
    sound = Estimate(UP, UP[None], np.array([50.0, 50.0]))
    bad = replace(sound, **changes)
    alone = run(SimpleNamespace(estimate=lambda *_: bad), patches[0], CAMERA)
    assert re.search(said, alone.detail)
    batch = SimpleNamespace(estimate=lambda *_: sound, estimate_batch=lambda *_: [bad, sound, sound])
    assert run_each(batch, patches, CAMERA) == [alone, patches[1], sound, sound]
    frame = SimpleNamespace(estimate_frame=lambda *_: [bad])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert in_frame(frame, patches).of_patches[0] == replace(alone, detail=f"estimate 0: {alone.detail}")
        found = in_frame(Regions(results=(bad, None, None, None), others=(bad,)), patches)
    assert (found.of_patches[0], found.elsewhere, found.refused) == (alone, [], [alone])


def test_few_digits_are_made_exact_and_exact_ones_stay():
    rounded = Estimate(
        1.0004 * UP, 0.9996 * UP[None], np.array([50.0, 50.0]), covariance=np.array([[1, 0.5], [0.5001, 1]])
    )
    made = check(rounded, CAMERA)
    np.testing.assert_array_equal(made.normal, UP)
    np.testing.assert_array_equal(made.candidates, UP[None])
    np.testing.assert_array_equal(made.covariance, made.covariance.T)
    assert check(made, CAMERA) is made
    other = np.array([[3e-4, 0.0, -np.sqrt(1 - 9e-8)], [0.0, 0.6, -0.8]])
    np.testing.assert_array_equal(check(replace(made, candidates=other), CAMERA).candidates, [UP, other[1]])


def test_estimators_of_patches_and_of_frames_meet_in_the_specularities():
    estimators = {"brightest_point": brightest_point, "frame": Peaks((*CENTRES, (390.0, 50.0)))}
    made = reconstruct(picture(), CAMERA, estimators)
    assert len(made) == 4
    for spot in made[:3]:
        assert spot.region.contrast > 0
        assert list(spot.estimates) == ["brightest_point", "frame"]
        assert np.hypot(*(spot.estimates["frame"].look_px - spot.patch.peak_px)) < 2
    alone = made[3]
    assert (alone.region, list(alone.estimates)) == (Region((390, 50, 1, 1), (390, 50), None), ["frame"])
    assert isinstance(alone.patch, Failure)
    assert isinstance(alone.estimates["frame"], Estimate)


def test_a_region_of_interest_keeps_what_a_frame_estimator_sees_in_it():
    x, y = (int(value) for value in CENTRES[0])
    beside = (CENTRES[0][0] + 18.0, CENTRES[0][1])
    found = reconstruct(picture(), CAMERA, {"frame": Peaks((*CENTRES, beside))}, roi=(x - 20, y - 20, 40, 40))
    looks = [spot.estimates["frame"].look_px.tolist() for spot in found]
    assert looks == [list(CENTRES[0]), list(beside)]


def test_without_specularities_a_frame_estimator_is_asked_all_the_same():
    class Blind:
        def detect(self, frame, camera, priors):
            return Detection((), frame)

    made = reconstruct(
        picture(), CAMERA, {"frame": Peaks(((10.0, 90.0),))}, detector=Blind(), smoothing_px=SMOOTHING_PX
    )
    assert [list(spot.estimates) for spot in made] == [["frame"]]


def test_what_a_frame_estimator_alone_sees_is_described_and_matched_last():
    class Blind:
        def detect(self, frame, camera, priors):
            return Detection((Region((0, 0, 100, 100), (50, 49), 1.0),), frame)

    made = reconstruct(
        picture(), CAMERA, {"frame": Peaks(((50.2, 49.5), (50.4, 49.6)))}, detector=Blind(), smoothing_px=SMOOTHING_PX
    )
    detected, alone = made
    assert len(made.to_json()["specularities"]) == 2
    # The truth lies at the second estimate's pixel; the detection keeps it all the same.
    true = SimpleNamespace(bp_px=np.array([50.45, 49.6]))
    assert match([alone, detected], [true.bp_px]) == {1: 0}
    assert match([alone], [true.bp_px]) == {0: 0}


# What counts as an estimator ------------------------------------------------------------------------------------------


def test_the_protocols_tell_the_kinds_apart():
    assert isinstance(circle_pose, BatchEstimator)
    assert isinstance(brightest_point, Estimator)
    assert not isinstance(brightest_point, BatchEstimator)
    assert isinstance(Peaks(), FrameEstimator)
    assert not isinstance(Peaks(), Estimator)


@pytest.mark.parametrize(
    ("given", "said"),
    [(3, "3 has neither estimate"), (Peaks, "is a class"), (len, "has neither estimate")],
)
def test_what_is_no_estimator_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        load_estimators({"given": given})


def test_flags_of_the_frame_stand_behind_those_of_the_estimator_in_one_order():
    y, x = np.mgrid[:40, :40] + 0.5
    patch = Patch.cut(np.exp(-((x - 20) ** 2 + (y - 18) ** 2) / 50), (5, 5, 30, 30))
    patch = replace(patch, saturated=np.ones((30, 30), bool))
    frame = SimpleNamespace(corrected=SimpleNamespace(limited=np.ones((40, 40), bool)))
    normal = np.array([0.0, 0.0, -1.0])
    given = Estimate(normal, normal[None], np.array([20.0, 18.0]), flags=("round", "dim"))
    made = _flagged(given, patch, frame, small=True, dim=True)
    assert made.flags == ("round", "dim", "saturated", "vignetted", "small")
    # An unresolved highlight states no shape that smoothing could have changed; nothing is limited where all light is.
    clear = SimpleNamespace(corrected=SimpleNamespace(limited=None))
    unresolved = replace(given, flags=(UNRESOLVED,))
    assert _flagged(unresolved, replace(patch, saturated=None), clear, small=True, dim=True).flags == (
        UNRESOLVED,
        "dim",
    )
