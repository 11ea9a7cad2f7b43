"""Results that were edited without touching the code are not called fine, but for two edits that no figure shows."""

import numpy as np
import polars as pl
import pytest
from gate_edits import EDITS, edited, run_of
from gate_nights import night, whole

from simtest.nightly.compare import compare
from tests.laws.results import broken_rules
from tests.marked import marked

TONIGHT, OTHER = whole(), whole(seed=1)


@pytest.fixture(scope="module")
def found():
    """Return what the gate says of each edit against the same seeds."""
    return {one.name: one for one in edited(TONIGHT, None)}


def test_results_as_they_are_are_fine(found):
    assert (found["none"].same.state, found["none"].same.bit_equal) == ("fine", True)
    assert found["none"].fresh is None
    assert compare(run_of(TONIGHT), run_of(OTHER)).state == "fine"


UNSEEN = ("seeds shared between settings", "normals replaced by the truth")
"""Edits of columns that no quantity is made of: tests/laws/results.py holds them to the others."""


@pytest.mark.parametrize("name", UNSEEN)
def test_what_no_quantity_is_made_of_breaks_a_rule_of_results(found, name):
    assert found[name].same.state == "fine"
    assert broken_rules(EDITS[name](TONIGHT, np.random.default_rng(0)))


@pytest.mark.parametrize("name", [name for name in EDITS if name not in UNSEEN])
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


FRESH = {
    "all errors 0", "regions x 1.25", "all estimators failing in 4 settings", "every law off by 5 deg",
    "regions x 0.01",
    "a setting dropped", "flags removed", "axis ratio constant",
}  # fmt: skip


# Of the others, meanwhile: the same edits against the same seeds.
@pytest.mark.parametrize("name", marked(sorted(FRESH), ci=FRESH - {"all errors 0", "regions x 1.25"}))
def test_edits_are_seen_against_other_seeds_too(name):
    run = run_of(EDITS[name](TONIGHT, np.random.default_rng(0)))
    assert compare(run, run_of(OTHER)).state in ("regression", "changed")


FIRST = (pl.col("realisation") == 0) & pl.col("true_id").is_not_null()


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


ELSEWHERE = {"processor": "two", "variant": "v", "versions": {"numpy": "9"}, "definitions": {"e": "2"}}


@pytest.mark.parametrize("name", marked([*ELSEWHERE], ci=["variant", "versions"]))
def test_a_single_result_that_moved_is_told_on_the_same_machine_alone(name):
    before = night(TONIGHT, definitions={"e": "1"}) if name == "definitions" else night(TONIGHT)
    elsewhere = compare(night(moved_results(), **{name: ELSEWHERE[name]}), before)
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
