"""Results that were edited without touching the code are never called fine."""

import numpy as np
import polars as pl
import pytest
from gate_nights import changed, night, whole

from simtest.nightly.gate.checks import RULES, broken_rules, inconsistent
from simtest.nightly.gate.compare import compare
from studies.gate.edits import EDITS, MEDIANS, edited, run_of

TONIGHT, OTHER = whole(), whole(seed=1)


@pytest.fixture(scope="module")
def found():
    """Return what the gate says of each edit against the same seeds."""
    return {one.name: one for one in edited(TONIGHT, None)}


@pytest.fixture(scope="module")
def found_fresh():
    """The same against other seeds too, which takes twice as long."""
    return {one.name: one for one in edited(TONIGHT, OTHER)}


def test_results_as_they_are_are_fine(found):
    assert (found["none"].same.state, found["none"].same.bit_equal) == ("fine", True)
    assert found["none"].fresh is None
    assert compare(run_of(TONIGHT), run_of(OTHER)).state == "fine"


@pytest.mark.parametrize("name", [*EDITS, MEDIANS])
def test_no_edit_is_called_fine_and_the_cause_is_named(found, name):
    verdict = found[name].same
    assert verdict.state in ("regression", "changed")
    assert verdict.exit_code == 1
    blamed = pl.concat([verdict.regressions, verdict.unexplained])
    assert (blamed["experiment"] == "e").any()
    assert blamed["estimator"].is_in(["cone_axis", "curved"]).any()
    first = verdict.causes[0]
    assert "in e, " in first
    assert first.startswith(("cone_axis", "curved"))


@pytest.mark.parametrize(
    "name",
    [
        "all estimators failing in 4 settings", "all errors 0", "every law off by 5 deg", "regions x 0.01",
        "regions x 1.25", "seeds shared between settings", "realisations duplicated", "normals replaced by the truth",
        "a setting dropped", "flags removed", "axis ratio constant", MEDIANS,
    ],
)  # fmt: skip
def test_edits_are_seen_against_other_seeds_too(found_fresh, name):
    assert found_fresh["none"].fresh.state == "fine"
    assert found_fresh[name].fresh.state in ("regression", "changed")


@pytest.mark.parametrize("name", ["all errors 0", "regions x 1.25", "seeds shared between settings"])
def test_some_edits_are_seen_against_other_seeds_in_each_run(name):
    run = run_of(EDITS[name](TONIGHT, np.random.default_rng(0)))
    assert compare(run, run_of(OTHER)).state in ("regression", "changed")


def test_stored_figures_that_are_not_those_of_the_rows_are_told():
    tonight = night(TONIGHT)
    edited_rows = changed(TONIGHT, pl.col("realisation") == 3, error_deg=9.0)
    verdict = compare(type(tonight)(tonight.record, edited_rows, tonight.figures), tonight)
    assert {"published digest", "published mean_deg", "published max_deg"} <= set(verdict.regressions["quantity"])
    # A figure that is published no more.
    fewer = tonight.figures.filter(pl.col("quantity") != "rms_deg")
    verdict = compare(type(tonight)(tonight.record, TONIGHT, fewer), None)
    assert set(verdict.regressions["quantity"]) == {"published rms_deg"}
    assert verdict.exit_code == 1


def test_rows_that_agree_break_no_rule_and_columns_that_are_missing_neither():
    assert broken_rules(TONIGHT).is_empty()
    assert broken_rules(TONIGHT.select("experiment", "label", "surface", "setting", "estimator", "realisation",
                                       "specularity", "true_id", "seed", "status", "error_deg")).is_empty()  # fmt: skip


FIRST = (pl.col("realisation") == 0) & pl.col("true_id").is_not_null()


@pytest.mark.parametrize(
    ("rule", "values", "everywhere"),
    [
        ("check: errors", {"error_fine_deg": 3.0}, False),
        ("check: errors", {"target": "base", "error_base_deg": 3.0}, False),
        ("check: errors", {"error_oracle_deg": 80.0}, False),
        ("check: numbers", {"error_deg": float("nan")}, False),
        ("check: zero errors", {"error_deg": 0.0}, False),
        ("check: regions", {"mahalanobis2": 77.0}, False),
        ("check: budget", {"budget_shape_deg": 0.5}, False),
        ("check: axis ratio law", {"axis_ratio_law": 0.51}, False),
        ("check: axis ratios", {"axis_ratio": 1.2}, False),
        ("check: axis ratios", {"axis_ratio": 0.6}, True),
        ("check: gains", {"gain_2": 2.2}, False),
        ("check: gains", {"gain_oracle_error": 0.5}, False),
        ("check: seeds", {"seed": 5}, False),
        ("check: repeated answers", {"normal_x": 0.1, "normal_y": 0.2, "normal_z": -0.97, "error_deg": 0.3}, True),
        ("check: highlights", {"true_id": 7}, False),
    ],
)
def test_each_rule_is_broken_by_what_it_is_about(rule, values, everywhere):
    cell = (pl.col("setting") == "b") & (pl.col("estimator") == "curved")
    of_seed = (pl.col("setting") == "b") | (pl.col("setting") == "c")
    where = of_seed if rule == "check: seeds" else cell if everywhere else cell & FIRST
    tonight = changed(TONIGHT, where & pl.col("true_id").is_not_null(), **values)
    assert rule in RULES
    assert rule in set(broken_rules(tonight)["quantity"])
    worse = inconsistent(tonight, TONIGHT)
    assert rule in set(worse.filter(outcome="worse")["quantity"])


def test_a_rule_that_is_broken_is_a_regression():
    tonight = changed(TONIGHT, FIRST & (pl.col("setting") == "b"), gain_2=2.2)
    assert "check: gains" in set(compare(night(tonight), night(TONIGHT)).regressions["quantity"])


def test_round_highlights_all_have_the_ratio_1():
    assert broken_rules(changed(TONIGHT, pl.col("axis_ratio").is_not_null(), axis_ratio=1.0)).is_empty()


def test_a_rule_that_the_baseline_breaks_as_much_is_no_regression():
    table = changed(TONIGHT, FIRST, error_fine_deg=3.0)
    nudged = table.with_columns(pl.col("error_deg") * (1 + 1e-9))
    assert compare(night(nudged), night(table)).state == "fine"
    assert compare(night(table), None).state == "regression"


def moved_results():
    """Return tonight's rows with two numbers of one result three times larger."""
    cell = (pl.col("setting") == "b") & (pl.col("estimator") == "curved") & FIRST
    return TONIGHT.with_columns(
        pl.when(cell).then(pl.col(name) * 3).otherwise(name).alias(name) for name in ("error_law_deg", "peak_snr")
    )


def test_a_single_result_that_moved_is_told():
    verdict = compare(night(moved_results()), night(TONIGHT))
    found = verdict.unexplained.filter(method="single").sort("quantity")
    assert found.select("quantity", "setting", "estimator", "n").rows() == [
        ("single law", "b", "curved", 1), ("single peak", "b", "curved", 1)
    ]  # fmt: skip
    assert found["tonight"].to_list() == [3.0, 150.0]


@pytest.mark.parametrize(
    ("name", "value"),
    [("processor", "two"), ("variant", "v"), ("versions", {"numpy": "9"}), ("definitions", {"e": "2"})],
    ids=["processor", "variant", "versions", "definitions"],
)
def test_a_single_result_that_moved_is_told_on_the_same_machine_alone(name, value):
    before = night(TONIGHT, definitions={"e": "1"}) if name == "definitions" else night(TONIGHT)
    elsewhere = compare(night(moved_results(), **{name: value}), before)
    assert "single" not in set(elsewhere.comparisons["method"])


def test_rounding_moves_no_single_result():
    rng = np.random.default_rng(0)
    noise = pl.Series(1 + 1e-6 * rng.standard_normal(TONIGHT.height))
    rounded = TONIGHT.with_columns(
        pl.col(name) * noise for name in ("error_deg", "error_oracle_deg", "axis_ratio", "error_look_deg")
    )
    verdict = compare(night(rounded), night(TONIGHT))
    assert "single" not in set(verdict.comparisons["method"])
    assert verdict.state == "fine"


def test_rounding_of_equal_results_is_no_other_figure():
    """The deviation of equal errors of 60 deg is 1.5e-14 deg in one order of the sum, 0 in another."""
    equal = changed(TONIGHT, True, error_deg=60.0)
    tonight = night(equal)
    rounded = pl.when(pl.col("quantity") == "std_deg").then(pl.col("value") + 1.5e-14).otherwise("value")
    verdict = compare(type(tonight)(tonight.record, equal, tonight.figures.with_columns(value=rounded)), None)
    assert not [name for name in verdict.regressions["quantity"] if name.startswith("published")]
