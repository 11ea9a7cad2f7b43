"""Intervals of means whose frames are the independent units."""

import math

import numpy as np
import pytest

from simtest.geometry import student_t
from simtest.validation.paired import deviation_of_mean, difference_interval, half_width
from tests.unit.given_numbers import of_given_numbers

TRIALS, MOST = 300, 31
"""An interval that misses in 5.7 % of the cases misses in more of so many trials with a probability of 0.001."""

MANY, LOW, HIGH, RATE = 0.1, 8, 30, 0.35

TRUE = MANY * (LOW + HIGH - 1) / 2 / (MANY * (LOW + HIGH - 1) / 2 + (1 - MANY) / RATE)
"""Mean of `drawn_values`: that of frames with many highlights is 1, that of the others 0."""


def drawn_values(rng, settings, each):
    """Draw skewed values of frames, few or many of each, the frames with many larger; with settings and frames."""
    made = []
    for frame in range(settings * each):
        many = rng.uniform() < MANY
        size = int(rng.integers(LOW, HIGH)) if many else int(rng.geometric(RATE))
        setting = frame // each
        middle = 0.3 * (setting - (settings - 1) / 2) + rng.normal(0, 0.5) + float(many)
        values = middle + np.exp(rng.normal(0, 0.6, size)) - math.exp(0.18)
        made.append(np.column_stack([values, np.full(size, setting), np.full(size, frame)]))
    values, kinds, frames = np.concatenate(made).T
    return values, kinds.astype(int), frames.astype(int)


@pytest.mark.parametrize(("settings", "each"), [(8, 3), (4, 5), (1, 20)])
def test_the_interval_holds_where_the_number_of_highlights_varies(settings, each):
    rng, missed, control = np.random.default_rng(settings), 0, 0
    for _ in range(TRIALS):
        drawn = drawn_values(rng, settings, each)
        off = abs(drawn[0].mean() - TRUE)
        missed += off > half_width(*drawn)
        control += off > of_given_numbers(*drawn)
    assert missed <= MOST
    # Negative control: with the numbers taken as given the interval is too narrow.
    assert control > MOST


@pytest.mark.parametrize(("settings", "each"), [(1, 6), (3, 4)])
def test_with_as_many_highlights_in_each_frame_it_is_students_interval(settings, each):
    rng = np.random.default_rng(3)
    kinds = np.repeat(np.arange(settings), 2 * each)
    frames = np.repeat(np.arange(settings * each), 2)
    values = rng.normal(0, 1, len(frames))
    assert half_width(values, kinds, frames) == pytest.approx(of_given_numbers(values, kinds, frames), rel=1e-12)
    # Highlights without spread make the mean one of more values.
    others = np.full(3 * len(values), 7.0)
    assert half_width(values, kinds, frames, others) == pytest.approx(half_width(values, kinds, frames) / 4)


def test_frames_that_are_alone_in_their_setting():
    one = np.array([1.0, 2.0, 4.0]), np.zeros(3, int), np.zeros(3, int)
    assert half_width(*one) is None
    # One frame a setting: the spread between settings is all that is known.
    single = np.array([1.0, 2.0, 4.0]), np.arange(3), np.arange(3)
    assert half_width(*single) == pytest.approx(half_width(single[0], np.zeros(3, int), np.arange(3)))
    # Two frames show a spread; the third, alone in its setting, is taken to have the same.
    mixed = half_width(np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]), np.arange(3))
    pair = deviation_of_mean(np.array([1.0, 2.0, 4.0]), np.ones(3), np.array([0, 0, 1]))
    assert mixed == pytest.approx(student_t.quantile(0.975, 1) * pair * math.sqrt(1.5))


def test_the_jackknife_is_that_of_leaving_frames_out():
    totals, counts, strata = np.array([2.0, 3.0, 9.0, 1.0, 4.0]), np.array([1.0, 1.0, 3.0, 1.0, 2.0]), np.zeros(5, int)
    without = [np.delete(totals, i).sum() / np.delete(counts, i).sum() for i in range(5)]
    expected = math.sqrt(4 / 5 * np.sum((np.array(without) - totals.sum() / counts.sum()) ** 2))
    assert deviation_of_mean(totals, counts, strata) == pytest.approx(expected)


@pytest.mark.parametrize("other", [0.0, 6.0])
def test_values_without_spread_leave_the_spread_of_the_mean_of_all(other):
    """Where they differ from the drawn ones, the number of those moves the mean too."""
    rng, means, stated, shares = np.random.default_rng(8), [], [], []
    others, strata = np.full(60, other), np.zeros(20, int)
    for _ in range(600):
        counts = rng.integers(1, 20, 20).astype(float)
        totals = counts * rng.normal(0, 0.5, 20)
        means.append((totals.sum() + others.sum()) / (counts.sum() + 60))
        stated.append(deviation_of_mean(totals, counts, strata, others) ** 2)
        shares.append((deviation_of_mean(totals, counts, strata) * counts.sum() / (counts.sum() + 60)) ** 2)
    # 600 trials tell a deviation within 2.9 %; four of these.
    assert np.sqrt(np.mean(stated)) == pytest.approx(np.std(means), rel=0.12)
    # Negative control.
    assert (np.sqrt(np.mean(shares)) < 0.8 * np.std(means)) == (other > 0)


def test_the_interval_of_differences_is_that_of_their_mean_over_frames():
    rng = np.random.default_rng(4)
    values, frames = rng.normal(0.0, 1.0, 40), np.arange(40) // 2
    settings, certain = np.zeros(40, int), np.zeros(40, bool)
    half, mean = half_width(values, settings, frames), values.mean()
    assert difference_interval(values, frames, settings, certain) == pytest.approx((mean - half, mean + half))
    assert difference_interval(values, frames, settings, ~certain) == (mean, mean)
    assert difference_interval(values[:0], frames[:0], settings[:0], certain[:0]) == (None, None)
    assert difference_interval(values[:2], frames[:2], settings[:2], certain[:2]) == (None, None)
