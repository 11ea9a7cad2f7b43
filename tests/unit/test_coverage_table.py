"""The page's coverage table on hand-made rows."""

from types import SimpleNamespace

import polars as pl
import pytest

from simtest.report.tables import coverage


def row(estimator, true_id, status, error=None, law=None, ratio=None, ratio_law=None, setting="a"):
    return {
        "setting": setting, "estimator": estimator, "true_id": true_id, "status": status, "error_oracle_deg": error,
        "specularity": None if status == "missed" else 0, "error_law_deg": law,
        "axis_ratio": ratio, "axis_ratio_law": ratio_law, "surface.viewpoint": 0.0,
    }  # fmt: skip


ROWS = [
    row("cone_axis", 0, "ok", 2.1, 2.0, 0.50, 0.51),
    row("cone_axis", 1, "ok", 3.0, 2.0, 0.50, 0.60),
    row("cone_axis", 2, "missed"),
    row("cone_axis", 3, "no_closed_isophote"),
    row("cone_axis", None, "ok"),
    *(row("circle_pose", i, "ok") for i in (0, 1, None, 3)),
    row("circle_pose", 2, "missed"),
]


SCHEMA = {name: pl.Float64 for name in ("error_oracle_deg", "error_law_deg", "axis_ratio", "axis_ratio_law")}


def test_found_missed_false_and_laws_are_counted():
    tables = coverage(SimpleNamespace(results=pl.DataFrame(ROWS, schema_overrides=SCHEMA)))
    (found,) = tables.found.rows(named=True)
    assert (found["true"], found["found"], found["missed"], found["false"]) == (4, 3, 1, 1)
    assert found["coverage"] == 0.75
    assert found["false_share"] == 0.25
    error, ratio = tables.laws.rows(named=True)
    assert (error["measure"], error["n"], error["met"]) == ("error", 2, 1)
    assert error["median_gap"] == pytest.approx(0.55)
    assert (ratio["measure"], ratio["n"], ratio["met"]) == ("axis ratio", 2, 1)


def test_detections_are_not_counted_by_clouds():
    """A cloud estimator that stands first has one answer for several detections."""
    rows = [row("cloud", 0, "ok", 2.1, 2.0), row("cloud", 1, "missed"), *ROWS]
    (found,) = coverage(SimpleNamespace(results=pl.DataFrame(rows, schema_overrides=SCHEMA))).found.rows(named=True)
    assert (found["true"], found["found"], found["missed"], found["false"]) == (4, 3, 1, 1)


def test_other_runs_have_none():
    assert coverage(SimpleNamespace(results=pl.DataFrame({"setting": ["a"]}))) is None
