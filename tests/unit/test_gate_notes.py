"""What a verdict counts and says: frames, notes and causes."""

from dataclasses import replace

import polars as pl
import pytest
from gate_nights import changed, night, raised, rows, whole

from simtest.nightly.compare import compare, with_all_frames
from simtest.nightly.quantities import setting_figures
from simtest.nightly.run import frames_of
from simtest.spec import Experiment
from simtest.validation.cases import expand


def with_frames(table, count, **run):
    return replace(night(table, **run), figures=setting_figures(table, {("e", "a"): count}))


def false_in(table, numbers):
    """Add a false detection in some frames, which have no other row where they are no realisation of the table."""
    parts = [table]
    for number in numbers:
        parts.append(
            changed(table.head(1), True, realisation=number, seed=10**9 + number, true_id=None, specularity=1,
                    error_deg=None, mahalanobis2=None, axis_ratio=None)
        )  # fmt: skip
    return pl.concat(parts)


def value(run, quantity):
    return run.figures.filter(quantity=quantity)["value"].item()


def test_false_detections_are_divided_by_all_frames():
    table = false_in(rows(count=4), [7])
    # 4 frames with a highlight, 1 with a false detection alone, 5 without a row.
    assert (value(night(table), "false"), value(with_frames(table, 10), "false")) == (1 / 5, 1 / 10)
    assert value(with_frames(table, 10), "frames") == 10
    for method, run in (("paired", {}), ("unpaired", {"versions": {"numpy": "9"}})):
        verdict = compare(with_frames(table, 10, **run), with_frames(rows(count=4), 10))
        row = verdict.comparisons.filter(quantity="false", setting="a").row(0, named=True)
        assert (row["method"], row["n"]) == (method, 10)
        assert row["tonight"] == pytest.approx(0.1)
    # Lost frames are no frames without false detections.
    verdict = compare(
        with_frames(false_in(rows(count=4), [7]).tail(3), 10), with_frames(false_in(rows(count=4), [7]), 10)
    )
    row = verdict.comparisons.filter(quantity="false", setting="a").row(0, named=True)
    assert row["n"] == 8


def test_frames_are_counted_by_experiment_and_setting():
    groups = [
        {"scene": "plane", "label": "p", "sweep": [{"surface.tilt_deg": [0.0, 5.0]}]},
        {"scene": "cylinder", "label": "c", "realisations": 2, "pool": [{"surface.radius_mm": [5.0, 9.0, 20.0]}]},
    ]
    experiment = Experiment(name="x", realisations=3, groups=groups)
    counted = frames_of([experiment], [expand(experiment)])
    assert sorted(counted.values()) == [3, 3, 6]
    assert {name for name, _ in counted} == {"x"}


def test_frames_are_counted_on_only_where_realisations_are_a_count():
    """Realisations 0, 2 and 4 of three frames name no frame that is missing."""
    frames = pl.DataFrame({"cell": [0, 1], "frames": [3, 3]})

    def values(cell, *realisations):
        return pl.DataFrame({"cell": cell, "quantity": "false", "realisation": realisations, "value": 1.0})

    chosen, counted = values(0, 0, 2, 4), values(1, 0, 2)
    both = pl.concat([chosen, counted])
    made = with_all_frames(both, frames, both)
    assert made.filter(pl.col("cell") == 0).height == 3
    assert made.filter(pl.col("cell") == 1, pl.col("value") == 0)["realisation"].to_list() == [1]


def test_what_changed_in_kind_is_named_only_where_it_was_measured():
    table = rows()
    few = pl.col("realisation") < 3
    gone = {"error_deg": None, "mahalanobis2": None, "axis_ratio": None}
    opened = compare(night(changed(table, few, status="no_closed_isophote", **gone)), night(table)).notes[-1]
    assert opened.endswith("another number of detections. In 3 of them an isophote opened or closed.")
    missed = compare(night(changed(table, few, status="missed", **gone)), night(table)).notes[-1]
    assert "isophote" not in missed
    assert missed.endswith("In 3 of them the highlight was detected in one run alone.")
    assert compare(night(raised(table, 1 + 1e-8)), night(table)).notes[-1].endswith("another number of detections.")


def test_causes_name_estimator_experiment_setting_what_it_was_and_the_reason():
    table = whole()
    cell = (pl.col("setting") == "c") & (pl.col("estimator") == "curved") & pl.col("true_id").is_not_null()
    gone = dict.fromkeys(("error_deg", "mahalanobis2", "axis_ratio", "normal_x", "cov_11"))
    failed = changed(table, cell, status="estimator_error", flags="ValueError: no root", **gone)
    verdict = compare(night(failed), night(table))
    assert verdict.causes[0] == "curved: ValueError: no root, 10 times."
    assert verdict.causes[1].startswith("curved in e, c: ")
    assert any("is 0, was 10" in cause for cause in verdict.causes)
    assert any("10 more than before: estimator_error (ValueError: no root)." in cause for cause in verdict.causes)


def test_causes_name_the_part_of_the_budget_that_moved():
    table = whole()
    cell = (pl.col("estimator") == "curved") & pl.col("true_id").is_not_null()
    wider = table.with_columns(
        pl.when(cell).then(pl.col("budget_shape_deg") * 3).otherwise("budget_shape_deg").alias("budget_shape_deg"),
        *(pl.when(cell).then(pl.col(name) * 5).otherwise(name).alias(name) for name in ("cov_11", "cov_22")),
        pl.when(cell).then(pl.col("mahalanobis2") / 5).otherwise("mahalanobis2").alias("mahalanobis2"),
    )
    verdict = compare(night(wider), night(table))
    assert (verdict.state, verdict.regressions.height) == ("changed", 0)
    told = [cause for cause in verdict.causes if "the size of the reported regions" in cause]
    assert "curved in e, " in told[0]
    assert "Of the reported uncertainty the part shape is 1.2 deg, was 0.4 deg." in told[0]
    assert not any(cause.startswith("cone_axis") for cause in verdict.causes)


@pytest.mark.ci
def test_many_findings_are_counted_in_one_line():
    table = rows(settings=tuple("abcdefghijkl"), estimators=tuple("opqrstuvwxyz"))
    verdict = compare(night(changed(table, True, error_law_deg=3.0, peak_snr=9.0)), night(table))
    assert len(verdict.causes) == 9
    assert verdict.causes[-1].startswith("And ")
