"""Signs of curvature from one and several moved views: how often they are told, and how often they are wrong."""

from dataclasses import replace
from math import comb

import numpy as np
import pytest

from simtest.calibration import Normal, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.motion_signs import EXACT, WRONG_SHARE, FirstPicture, MovedView, PoseError, rank_by_motions
from simtest.estimators.protocol import Estimate, EstimatedCurvature
from simtest.geometry.vectors import basis_across, rotation
from tests.marked import marked

D, GAIN_SD, DISTANCE_SD, NORMAL_SD = 10.0, 0.03, 0.05, 1e-3
PRIORS = Priors(distance_mm=Normal(D, DISTANCE_SD * D))
AXES = np.eye(3)[:2]


def estimate(normal, curvature=None):
    return Estimate(normal, normal[None], np.zeros(2), covariance=NORMAL_SD**2 * np.eye(2), curvature=curvature)


def pushed(normal, rng):
    made = normal + NORMAL_SD * rng.standard_normal(2) @ basis_across(normal)
    return made / np.linalg.norm(made)


def draw(rng, motions, pose=EXACT, backwards=False):
    """Draw a patch, its estimate, and the views of it after some motions, mm; all as the method supposes."""
    gains = rng.choice([-1, 1], 2) * np.sort(rng.uniform([0.4, 1.2], [1.0, 2.5]))
    distance = D * (1 + DISTANCE_SD * rng.standard_normal())
    truth = np.array([0.0, 0, -1])
    true = FirstPicture(estimate(truth, EstimatedCurvature(AXES, 0.5)), distance, gains)
    views = []
    for length in motions:
        angle = rng.uniform(0, 2 * np.pi)
        step = length * np.array([np.cos(angle), np.sin(angle), 0])
        seen = true.predict(step)
        if seen is None:
            return None
        told = np.eye(4)
        told[:3, 3] = -step * (-1 if backwards else 1) + pose.translation * length * rng.standard_normal(3)
        turn = rotation(pose.rotation * rng.standard_normal(3))
        views.append(MovedView([estimate(turn @ pushed(seen.normal, rng))], told, pose))
    sizes = np.abs(gains) * (1 + GAIN_SD * rng.standard_normal(2))
    hypotheses = np.array([[a * sizes[0], b * sizes[1]] for a in (1, -1) for b in (1, -1)])
    first = estimate(pushed(truth, rng), EstimatedCurvature(AXES, 0.5, hypotheses))
    return gains, first, views


def count(trials, seed, motions, blind=False, **options):
    """Return how many signs were told, and how many of these were wrong; `blind` hides the poses' errors."""
    told = wrong = 0
    for i in range(trials):
        made = draw(np.random.default_rng([seed, i]), motions, **options)
        if made is None:
            continue
        gains, first, views = made
        views = [replace(view, error=EXACT) for view in views] if blind else views
        ranked = rank_by_motions(first, views, PRIORS)
        if isinstance(ranked, Failure):
            continue
        signs = np.array(ranked.told_signs)
        told += int(np.count_nonzero(signs))
        wrong += int(np.count_nonzero(signs * np.sign(gains) < 0))
    return told, wrong


def beyond(wrong, trials, share=WRONG_SHARE):
    """Return the probability of at least so many wrong signs, were their share the stated one."""
    return 1 - sum(comb(trials, k) * share**k * (1 - share) ** (trials - k) for k in range(wrong))


CASES = {
    "short": ([0.05], EXACT),
    "one": ([0.3], PoseError(0.01, 0.0035)),
    "three": ([0.1, 0.2, 0.2], PoseError(0.01, 0.0035)),
}


@pytest.mark.parametrize("name", marked(CASES, ci=["short", "one"]))
def test_a_told_sign_is_wrong_no_more_often_than_stated(name):
    motions, pose = CASES[name]
    trials = 100 // len(motions)
    told, wrong = count(trials, 11, motions, pose=pose)
    assert told > 15
    assert beyond(wrong, 2 * trials) > 1e-3


def test_errors_of_the_pose_that_nobody_tells_break_it():
    """Negative control: the same test fails where the method is not told how wrong the poses are."""
    _, wrong = count(200, 12, [0.1], pose=PoseError(0.0, 0.01), blind=True)
    assert beyond(wrong, 400) < 1e-6
    # Told of them, it says that it does not know.
    told, wrong = count(100, 12, [0.1], pose=PoseError(0.0, 0.01))
    assert beyond(wrong, 200) > 1e-3
    assert told < 30


def test_a_motion_told_backwards_is_noticed():
    told, _ = count(60, 13, [0.5])
    reversed_told, _ = count(60, 13, [0.5], backwards=True)
    assert told > 60
    assert reversed_told < told / 3


def test_more_views_tell_more():
    shares = [count(40, 14, [0.2] * views)[0] for views in (1, 3)]
    assert shares[1] > shares[0]


def test_views_share_the_errors_of_the_first_picture():
    """The same view twice is hardly more evidence than once: the distance is that of the joint covariance."""
    _, first, (view,) = draw(np.random.default_rng(1), [0.3])
    once, twice = rank_by_motions(first, [view], PRIORS), rank_by_motions(first, [view] * 20, PRIORS)
    # Where the gains and the distance are not known the margin stays finite, however many views there are.
    loose = [rank_by_motions(first, [view] * n, PRIORS, gain_sd=0.3).margin for n in (1, 20)]
    assert loose[1] < 3 * loose[0]
    assert twice.freedom == 20 * once.freedom
    assert twice.margin < 20 * once.margin


def test_a_hypothesis_takes_the_highlight_that_it_explains():
    _, first, (view,) = draw(np.random.default_rng(3), [0.3])
    other = estimate(rotation([0.05, 0.2, 0]) @ view.estimates[0].normal)
    alone, among = (rank_by_motions(first, [replace(view, estimates=held)], PRIORS)
                    for held in (view.estimates, [other, *view.estimates]))  # fmt: skip
    assert among.distance2[0] == pytest.approx(alone.distance2[0])
    assert among.margin <= alone.margin


def test_what_tells_nothing_is_a_failure():
    _, first, (view,) = draw(np.random.default_rng(5), [0.3])
    assert rank_by_motions(first, [replace(view, estimates=[])], PRIORS).reason == Reason.NO_ESTIMATE
    far = np.eye(4)
    far[0, 3] = 1e4
    assert rank_by_motions(first, [replace(view, view_from_first=far)], PRIORS).reason == Reason.UNDECIDED


def test_bends_are_told_of_signs_and_sizes():
    _, first, (view,) = draw(np.random.default_rng(7), [0.3])
    ranked = rank_by_motions(first, [view], PRIORS)
    for gains, signs, bends in (
        ([[1.5, 0.5]], (1, 1), (1, -1)),
        ([[1.5, 0.5], [-1.5, 0.5]], (0, 1), (0, -1)),
        # Below 1 both signs are those of a concave surface; near 1 it may be flat.
        ([[0.5, 1.01], [-0.5, 1.01]], (0, 1), (-1, 0)),
        ([[-1.5, -1.0]], (-1, -1), (-1, -1)),
    ):
        made = replace(ranked, hypotheses=np.array(gains), distance2=np.zeros(len(gains)),
                       deviance=np.zeros(len(gains)))  # fmt: skip
        if len(gains) == 1:
            assert made.told_signs == signs
        assert made.told_bends() == bends
