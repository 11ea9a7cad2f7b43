"""The gate's statistics against plain references, and on tables of any content."""

import itertools

import numpy as np
import polars as pl
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from scipy import stats

from simtest.nightly.compare import compare
from simtest.nightly.contrasts import holm, paired, pooled, unit_sums, unpaired
from simtest.nightly.quantities import QUANTITIES, setting_figures
from simtest.nightly.records import OUTCOMES, NightlyRun, RunRecord
from simtest.runtime.statistics import mean_interval
from simtest.validation.columns import SCHEMA

ERROR = QUANTITIES["mean_deg"]
probabilities = st.lists(st.floats(0, 1), min_size=1, max_size=6)


def closed(p, weights):
    """Correct p-values by closed testing: each is the largest of all families that hold it, of weighted Bonferroni."""
    corrected = []
    for i in range(len(p)):
        others = [j for j in range(len(p)) if j != i]
        families = [(i, *more) for size in range(len(p)) for more in itertools.combinations(others, size)]
        whole = [min(p[j] * sum(weights[k] for k in f) / weights[j] for j in f) for f in families]
        corrected.append(min(max(whole), 1.0))
    return corrected


@given(probabilities, st.data())
@settings(max_examples=60, deadline=None)
def test_holm_is_closed_testing(p, data):
    weights = data.draw(st.lists(st.floats(0.1, 10), min_size=len(p), max_size=len(p)))
    np.testing.assert_allclose(holm(p, weights), closed(p, weights), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(holm(p), closed(p, [1.0] * len(p)), rtol=1e-12, atol=1e-300)


def pairs_of(x, y):
    return pl.DataFrame(
        {"cell": 0, "quantity": "mean_deg", "realisation": np.arange(len(x)), "baseline": x, "tonight": y}
    )


errors = st.lists(st.floats(0.05, 50), min_size=3, max_size=12)


@given(errors, st.data())
@settings(max_examples=60, deadline=None)
def test_one_row_a_unit_is_student_s_test(x, data):
    y = data.draw(st.lists(st.floats(0.05, 50), min_size=len(x), max_size=len(x)))
    x, y = np.array(x), np.array(y)
    assume(min(np.std(y - 1.02 * x), np.std(y - x), np.std(x), np.std(y)) > 1e-3)
    found = paired(unit_sums(pairs_of(x, y)), ERROR)
    # Both margins must be exceeded: the larger p-value counts.
    expected = max(
        stats.ttest_1samp(y - 1.02 * x, 0, alternative="greater").pvalue,
        stats.ttest_1samp(y - x - 0.002, 0, alternative="greater").pvalue,
    )
    np.testing.assert_allclose(found.worse[0], expected, rtol=1e-4, atol=1e-12)
    interval = stats.ttest_1samp(y - x, 0).confidence_interval()
    # Farther on the side to which the differences are skewed, and there as far as `mean_interval` reaches.
    np.testing.assert_allclose([found.low[0], found.high[0]], mean_interval(y - x), rtol=1e-5, atol=1e-6)
    assert found.low[0] < interval.low + 1e-6
    assert found.high[0] > interval.high - 1e-6
    one, two = (
        unit_sums(pl.DataFrame({"cell": 0, "quantity": "q", "realisation": np.arange(len(v)), "value": v}))
        for v in (x, y)
    )

    def welch(first, second):
        return stats.ttest_ind(first, second, equal_var=False, alternative="greater").pvalue

    apart = unpaired(one, two, ERROR)
    worse, better = max(welch(y, 1.02 * x), welch(y, x + 0.002)), max(welch(0.98 * x, y), welch(x - 0.002, y))
    np.testing.assert_allclose([apart.worse[0], apart.better[0]], [worse, better], rtol=1e-4, atol=1e-12)


def test_rows_of_one_unit_count_as_one():
    """Ten copies of each row are ten highlights of one frame that err together: no more evidence than one."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0.5, 1.5, 12)
    y = x * rng.uniform(0.9, 1.3, 12)
    single, table = paired(unit_sums(pairs_of(x, y)), ERROR), pairs_of(x, y)
    copied = paired(unit_sums(pl.concat([table] * 10)), ERROR)
    np.testing.assert_allclose(copied.worse, single.worse, rtol=1e-9)
    apart = table.with_columns(realisation=pl.col("realisation") + 100)
    assert paired(unit_sums(pl.concat([table, apart])), ERROR).worse < single.worse


numbers = st.one_of(st.none(), st.floats(0, 90), st.sampled_from([0.0, float("nan"), float("inf")]))
records = st.lists(
    st.fixed_dictionaries(
        {
            "setting": st.sampled_from("ab"), "estimator": st.sampled_from(["p", "q"]),
            "realisation": st.integers(0, 4), "true_id": st.sampled_from([None, 0, 1]),
            "specularity": st.sampled_from([None, 0, 1]), "status": st.sampled_from(["ok", "missed", "no_peak"]),
            "error_deg": numbers, "mahalanobis2": numbers, "axis_ratio": numbers, "axis_ratio_law": numbers,
            "seed": st.integers(0, 1),
        }
    ),
    max_size=25,
)  # fmt: skip


def table_of(made):
    blank = dict.fromkeys(SCHEMA) | {"experiment": "e", "label": "l", "surface": "s"}
    # A row of a true highlight stands once in a night.
    kept = {(r["setting"], r["estimator"], r["realisation"], r["true_id"]): r for r in made}
    return pl.DataFrame([{**blank, **row} for row in kept.values()], schema=SCHEMA)


@pytest.mark.slow
@given(records, records)
@settings(max_examples=40, deadline=None, phases=[Phase.explicit, Phase.reuse, Phase.generate])
def test_any_two_nights_have_a_verdict_without_a_nan(first, second):
    def of(made):
        table = table_of(made)
        # The figures' own intervals are for errors that are numbers: what is not is the gate's to bear.
        sane = table.with_columns(pl.col(pl.Float64).fill_nan(None).clip(0, 90))
        return NightlyRun(RunRecord(), table, setting_figures(sane))

    verdict = compare(of(first), of(second))
    comparisons = verdict.comparisons
    floats = comparisons.select(pl.col(pl.Float64))
    for name in floats.columns:
        assert not floats[name].is_nan().any(), comparisons
        assert not floats[name].is_infinite().any(), comparisons
    assert set(comparisons["outcome"]) <= set(OUTCOMES)
    p = comparisons["p"].drop_nulls().to_numpy()
    assert ((p >= 0) & (p <= 1)).all()
    assert verdict.state in ("fine", "regression")


CELLS, NIGHTS = 12, 300


def pooled_p(units, factor):
    """Return the pooled p-values of nights of heavy-tailed errors, tonight's times a factor."""
    rng = np.random.default_rng(units)
    shape = (NIGHTS * CELLS, units)
    nights = [np.exp(1.2 * rng.standard_normal(shape)), factor * np.exp(1.2 * rng.standard_normal(shape))]
    cell, realisation = (axis.ravel() for axis in np.indices(shape))
    tables = [
        unit_sums(pl.DataFrame({"cell": cell, "quantity": "q", "realisation": realisation, "value": v.ravel()})).sort(
            "cell"
        )
        for v in nights
    ]
    found = unpaired(*tables, ERROR)
    parts = [np.s_[first : first + CELLS] for first in range(0, NIGHTS * CELLS, CELLS)]
    return np.array([pooled(found[part], ERROR).worse[0] for part in parts])


@pytest.mark.parametrize("units", [*(pytest.param(n, marks=pytest.mark.ci) for n in (1, 2)), 8])
def test_cells_together_keep_their_level_under_heavy_tails(units):
    """At 0.05: as many of 300 nights as have a chance below 1e-3 / 3 are too many; a tenfold error must be seen."""
    most = stats.binom.isf(1e-3 / 3, NIGHTS, 0.05)
    assert (pooled_p(units, 1.0) <= 0.05).sum() <= most
    assert (pooled_p(units, 10.0) <= 0.05).mean() > 0.8


def test_few_cells_of_few_units_say_nothing_together():
    x = pairs_of(np.ones(2), np.array([2.0, 3.0]))
    table = unit_sums(pl.concat([x, x.with_columns(pl.lit(1, x["cell"].dtype).alias("cell"))])).sort("cell")
    found = pooled(paired(table, ERROR), ERROR)
    assert np.isnan(found.worse).all()
    np.testing.assert_allclose(found.difference, [2 * 1.5 / 3.5], rtol=1e-12, atol=1e-300)
