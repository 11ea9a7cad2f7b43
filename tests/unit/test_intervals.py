"""Intervals of means, shares and medians whose frames are the independent units."""

import itertools
import math

import numpy as np
import polars as pl
import pytest
from scipy import stats

from simtest.nightly.quantities import setting_figures
from simtest.report.error_figures import bar
from simtest.report.run_folder import Run
from simtest.report.tables import pairs
from simtest.runtime.statistics import (
    bootstrap_interval,
    deviation_of_mean,
    mean_interval,
    median_interval,
    root_mean_square,
    share_interval,
    student_quantile,
    weighted_quantile,
)
from simtest.validation.columns import table
from simtest.validation.comparison import difference_interval
from simtest.validation.guide import guide_of
from simtest.validation.statistics import summarise, units
from tests.unit.given_numbers import of_given_numbers

NONE = np.empty(0)


TRIALS, MOST = 300, 31
"""An interval that misses in 5.7 % of the cases misses in more of so many trials with a probability of 0.001."""


MANY, LOW, HIGH, RATE = 0.1, 8, 30, 0.35


TRUE = MANY * (LOW + HIGH - 1) / 2 / (MANY * (LOW + HIGH - 1) / 2 + (1 - MANY) / RATE)
"""Mean of `drawn_values`: that of frames with many highlights is 1, that of the others 0."""


def reach(values, settings, frames, others=NONE):
    """Return how far the interval reaches below the mean and above it."""
    low, high = mean_interval(values, frames, settings, others=others)
    mean = np.concatenate([values, others]).mean()
    return np.array([mean - low, high - mean])


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
        off = drawn[0].mean() - TRUE
        missed += abs(off) > reach(*drawn)[0 if off > 0 else 1]
        control += abs(off) > of_given_numbers(*drawn)
    assert missed <= MOST
    # Negative control: with the numbers taken as given the interval is too narrow.
    assert control > MOST


@pytest.mark.parametrize(("settings", "each"), [(1, 6), (3, 4)])
def test_with_as_many_highlights_in_each_frame_it_is_students_interval(settings, each):
    rng = np.random.default_rng(3)
    kinds = np.repeat(np.arange(settings), 2 * each)
    frames = np.repeat(np.arange(settings * each), 2)
    values = np.tile(rng.normal(0, 1, len(frames) // 2), 2)
    # Mirrored errors are not skewed.
    values, kinds, frames = np.concatenate([values, -values]), np.tile(kinds, 2), np.concatenate([frames, 99 - frames])
    of_students = of_given_numbers(values, kinds, frames)
    assert reach(values, kinds, frames) == pytest.approx([of_students] * 2, rel=1e-12)
    # Highlights without spread make the mean one of more values.
    others = np.full(3 * len(values), 7.0)
    assert reach(values, kinds, frames, others) == pytest.approx([of_students / 4] * 2)


def test_skewed_values_reach_farther_on_their_side_and_never_less_far_than_students():
    values = np.array([0.1, 0.2, 0.2, 0.3, 0.3, 0.4, 0.5, 0.7, 1.1, 2.9])
    below, above = reach(values, np.zeros(10), np.arange(10))
    of_students = student_quantile(9) * values.std(ddof=1) / math.sqrt(10)
    assert below == pytest.approx(of_students)
    # Hall's transform of the studentised error at the upper end is Student's quantile.
    a = np.mean((values - values.mean()) ** 3) / values.std(ddof=1) ** 3 / math.sqrt(10)
    t = -above / (values.std(ddof=1) / math.sqrt(10))
    assert t + a * t**2 / 3 + a**2 * t**3 / 27 + a / 6 == pytest.approx(-student_quantile(9))
    assert reach(-values, np.zeros(10), np.arange(10)) == pytest.approx([above, below])


def test_frames_that_are_alone_in_their_setting():
    assert mean_interval(np.array([1.0, 2.0, 4.0]), np.zeros(3, int)) == (None, None)
    # One frame a setting: the spread between settings is all that is known.
    single = np.array([1.0, 2.0, 4.0])
    assert mean_interval(single, np.arange(3), np.arange(3)) == mean_interval(single)
    # Two frames show a spread; the third, alone in its setting, is taken to have the same.
    low, high = mean_interval(single, np.arange(3), np.array([0, 0, 1]))
    pair = np.std([1.0, 2.0], ddof=1) / math.sqrt(2) * 2 / 3
    assert (high - low) / 2 == pytest.approx(student_quantile(1) * pair * math.sqrt(1.5))


def test_sums_over_numbers_are_means_of_the_values():
    values, frames = np.array([1.0, 2.0, 3.0, 5.0, 4.0, 7.0]), np.array([0, 0, 0, 1, 2, 2])
    grouped = mean_interval(np.array([6.0, 5.0, 11.0]), counts=np.array([3.0, 1.0, 2.0]))
    assert grouped == pytest.approx(mean_interval(values, frames))


@pytest.mark.parametrize(("hits", "n"), [(0, 7), (3, 7), (7, 7), (19, 20)])
def test_a_share_of_frames_of_one_highlight_has_its_exact_interval(hits, n):
    exact = stats.binomtest(hits, n).proportion_ci(method="exact")
    assert share_interval(np.arange(n) < hits) == pytest.approx((exact.low, exact.high))


def test_highlights_that_are_all_alike_in_their_frame_count_as_one():
    alone = share_interval(np.arange(10) < 7)
    assert share_interval(np.repeat(np.arange(10) < 7, 8), np.repeat(np.arange(10), 8)) == pytest.approx(alone)
    assert share_interval(np.ones(80), np.repeat(np.arange(10), 8)) == pytest.approx(share_interval(np.ones(10)))


def test_a_single_frame_tells_no_spread():
    assert mean_interval(np.array([3.0, 0.0, 0.0]), counts=np.array([2.0, 0.0, 0.0])) == (None, None)
    # Twenty highlights of one frame are worth one.
    low, high = share_interval(np.arange(20) < 10, np.zeros(20, int))
    assert low < 0.01
    assert high > 0.99


def test_a_median_lies_between_two_of_its_values():
    values = np.arange(100.0)
    low, high = median_interval(values)
    # Of 100 values 95 % of the medians lie between the 40th and the 61st.
    assert 39 <= low <= 41
    assert low + high == pytest.approx(99)
    # Five frames of neighbouring values tell no more than five values.
    low, high = median_interval(values, np.arange(100) // 20)
    assert low < 10
    assert high > 89


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


def test_the_interval_of_differences_is_that_of_a_mean():
    rng = np.random.default_rng(4)
    values, frames = rng.normal(0.0, 1.0, 40), np.arange(40)
    settings, certain = np.zeros(40, int), np.zeros(40, bool)
    assert difference_interval(values, frames, settings, certain) == mean_interval(values, frames, settings)
    assert difference_interval(values[:0], frames[:0], settings[:0], certain[:0]) == (None, None)
    assert difference_interval(values, frames, settings, ~certain) == (values.mean(), values.mean())


def rows_of(each):
    """Return results of two estimators in ten frames, whose highlights are all alike, so many in each."""
    rng, rows = np.random.default_rng(2), []
    errors = {"cone_axis": rng.gamma(2.0, 0.5, 10), "curved": rng.gamma(2.0, 0.6, 10)}
    for frame, number, name in itertools.product(range(10), range(each), errors):
        error = float(errors[name][frame])
        rows.append(dict(
            experiment="e", label="a", surface="a", setting="s", realisation=frame, specularity=number, true_id=number,
            estimator=name, status="ok" if error < 1.5 else "no_peak", target="fine", error_deg=error,
            mahalanobis2=12 * error, axis_ratio=1 + error / 9, axis_ratio_law=1.0,
        ))  # fmt: skip
    return table(rows, {})


def of_nightly_run(rows, path):
    found = setting_figures(rows).drop_nulls("low")
    assert {"mean_deg", "failed", "unanswered", "coverage95", "axis_ratio"} <= set(found["quantity"])
    return found.select("low", "high").rows()


PRINTED = {
    "summary": lambda rows, _: [found.ci95_deg for found in summarise(rows)["s"].values()],
    "curves": lambda rows, _: [bar(own, "error_deg") for _, own in rows.filter(status="ok").group_by("estimator")],
    "pairs": lambda rows, path: [pair.interval_deg for _, pair in pairs(Run(path, rows))],
    "guide": lambda rows, _: [own.interval_deg for each in guide_of(rows).advice for own in each.methods.values()],
    "nightly run": of_nightly_run,
}


def test_a_median_between_two_strata_has_a_width():
    """The share below it is a half whatever is drawn, and which value is the next one is not."""
    rng, held = np.random.default_rng(4), 0
    strata = np.repeat([0, 1], 8)
    for _ in range(200):
        values = np.concatenate([-rng.standard_exponential(8), rng.standard_exponential(8)])
        low, high = median_interval(values, np.arange(16), strata)
        held += low <= 0.0 <= high
        assert low < high
    assert held >= 180


def test_samples_of_one_anatomy_are_one_unit():
    rows = rows_of(1)
    frames, settings = units(rows)
    assert len(set(frames.tolist())) == 10
    anatomies, strata = units(rows.with_columns(anatomy=pl.format("0.{}", pl.col("realisation") // 5)))
    np.testing.assert_array_equal(anatomies, frames // 5)
    np.testing.assert_array_equal(strata, settings)


@pytest.mark.parametrize("where", PRINTED)
def test_each_printed_interval_counts_equal_highlights_of_a_frame_once(where, tmp_path):
    # A median lies between two values, of few frames farther apart.
    allowed = 0.25 if where == "guide" else 1e-6
    once, often = (PRINTED[where](rows_of(each), tmp_path) for each in (1, 20))
    assert len(once) > 0
    np.testing.assert_allclose(sorted(often), sorted(once), rtol=allowed)


def test_students_quantile_of_many_degrees_of_freedom_at_once():
    freedom = np.array([1.0, 2.5, 9.0, 300.0])
    np.testing.assert_array_equal(student_quantile(freedom), stats.t.ppf(0.975, freedom))
    assert student_quantile(9) == stats.t.ppf(0.975, 9)


def test_a_bootstrap_interval_of_normal_means_is_students():
    rng = np.random.default_rng(4)
    values = np.array([3.0, 50.0]) + stats.norm.ppf((np.arange(8) + 0.5) / 8)[:, None] * [1.0, 4.0]
    samples = values[rng.integers(8, size=(40_000, 8))].mean(axis=1)
    mean, half = values.mean(axis=0), student_quantile(7) * values.std(axis=0, ddof=1) / math.sqrt(8)
    np.testing.assert_allclose(bootstrap_interval(mean, samples, 8), [mean - half, mean + half], rtol=0.01)


def test_a_weighted_quantile_is_that_of_repeated_values():
    values, weights = np.array([4.0, 1.0, 3.0, np.nan, 2.0]), np.array([1.0, 5.0, 2.0, 9.0, 0.0])
    repeated = np.repeat(values[[0, 1, 2]], [1, 5, 2])
    for share in (0.1, 0.5, 0.63, 0.87, 0.88, 0.99):
        assert weighted_quantile(values, weights, share) == np.quantile(repeated, share, method="inverted_cdf")
    assert math.isnan(weighted_quantile(values, np.array([0, 0, 0, 1.0, 0]), 0.5))


def test_a_root_mean_square_of_none_is_none():
    assert root_mean_square(np.array([3.0, -4.0])) == math.sqrt(12.5)
    assert root_mean_square(np.empty(0)) is None
