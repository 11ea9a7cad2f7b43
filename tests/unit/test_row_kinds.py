"""Rows of results are counted by one rule, wherever they are counted, and the counts add up."""

import numpy as np
import polars as pl
import pytest
from nightly_samples import judged, make_run, no_baseline

from simtest.advice.answers import _counted
from simtest.nightly.page import results
from simtest.nightly.quantities import harms
from simtest.nightly.records import CELL
from simtest.report.run_folder import Run, completed
from simtest.report.sentences import headline
from simtest.report.tables import coverage, surface_errors
from simtest.validation.columns import SCHEMA
from simtest.validation.statistics import KINDS, counts, is_false, row_kind, summarise

KIND_OF = {
    "hit": "ok", "refused": "failed", "stopped": "failed", "dark": "failed", "missed": "missed", "noise": "false",
    "refused noise": "false", "spot": "in_spot", "metal": "on_instrument", "shining metal": "on_instrument",
    "cloud": "ok", "missed cloud": "missed", "stray cloud": "false",
}  # fmt: skip
"""Every way in which a row comes about, and what it counts as."""

DETECTED = {"true_id": None, "specularity": 1, "error_deg": None}
UNDETECTED = {"specularity": None, "error_deg": None}
ROWS = {
    "hit": {}, "refused": {"status": "no_peak", "error_deg": None},
    "stopped": {"status": "estimator_error", "error_deg": None}, "dark": UNDETECTED | {"status": "no_light"},
    "missed": UNDETECTED | {"status": "missed"}, "noise": DETECTED,
    "refused noise": DETECTED | {"status": "no_closed_isophote"}, "spot": DETECTED | {"visible_id": 3},
    "metal": DETECTED | {"on_instrument": True}, "shining metal": DETECTED | {"on_instrument": True, "visible_id": 4},
    "cloud": {"target": "base"}, "missed cloud": UNDETECTED | {"target": "base", "status": "missed"},
    "stray cloud": DETECTED | {"target": "base"},
}  # fmt: skip


def drawn_rows(seed, count=300):
    """Draw rows of all kinds in several settings, surfaces and frames; return them and their kinds."""
    rng = np.random.default_rng(seed)
    ways = [*ROWS, *rng.choice(list(ROWS), count - len(ROWS))]
    rows = []
    for number, way in enumerate(ways):
        row = {
            "experiment": rng.choice(["first", "second"]), "label": "a", "surface": rng.choice(["colon", "liver"]),
            "setting": rng.choice(["near", "far"]), "realisation": number, "specularity": 0, "true_id": 0, "seed": 1,
            "estimator": "cone_axis", "status": "ok", "error_deg": 1.0, "target": "fine", "on_instrument": False,
        }  # fmt: skip
        rows.append(row | ROWS[way])
    known = {name: dtype for name, dtype in SCHEMA.items() if name in rows[0] or name == "visible_id"}
    table = pl.DataFrame(rows, schema={**known, "on_instrument": pl.Boolean()})
    table = pl.concat([table, pl.DataFrame(schema=SCHEMA)], how="diagonal")
    return table, [KIND_OF[way] for way in ways]


def table_of(rows, kinds, *by):
    """Count rows by columns and kind, in plain Python."""
    found = {}
    for row, kind in zip(rows.iter_rows(named=True), kinds, strict=True):
        own = found.setdefault(tuple(row[name] for name in by), dict.fromkeys(KINDS, 0))
        own[kind] += 1
    return found


@pytest.mark.parametrize("seed", range(3))
def test_every_row_is_of_one_kind_and_all_count_alike(seed):
    rows, kinds = drawn_rows(seed)
    assert rows.select(kind=row_kind(rows))["kind"].to_list() == kinds
    # summary.json
    for experiment, own in rows.group_by("experiment"):
        part = [kind for kind, row in zip(kinds, rows["experiment"], strict=True) if row == experiment[0]]
        by_setting = table_of(own, part, "setting", "estimator")
        for setting, figures in summarise(own).items():
            told, expected = figures["cone_axis"], by_setting[setting, "cone_axis"]
            failed = sum(told.n_failed_by_reason.values())
            numbers = (told.n_ok, failed, told.n_missed, told.n_false, told.n_instrument, told.n_in_spot)
            assert numbers == tuple(expected[kind] for kind in KINDS)
            assert sum(numbers) == own.filter(pl.col("setting") == setting).height
            assert told.n == told.n_ok + failed + told.n_missed
            assert told.model_dump()["n_false"] == expected["false"]
    # The report's sections.
    run = Run(None, completed(rows).with_columns(pl.lit(0.0).alias("surface.viewpoint")))
    for row in surface_errors(run, has_figures=True).table.iter_rows(named=True):
        assert {kind: row[kind] for kind in KINDS} == table_of(rows, kinds, "surface")[(row["surface"],)]
    for row in coverage(run).found.iter_rows(named=True):
        expected = table_of(rows, kinds, "setting")[(row["setting"],)]
        assert {kind: row[kind] for kind in KINDS} == expected
        assert row["detections"] <= sum(expected.values())
    total = table_of(rows, kinds)[()]
    sentence = headline(run, [])[0]
    assert f"Of {rows.height} rows, {total['failed']} gave no normal" in sentence
    assert f"{total['missed']} missed a true highlight, {total['in_spot']} belong to spots" in sentence
    assert f"{total['on_instrument']} lie on instruments and {total['false']} belong to false detections." in sentence
    # The nightly's record, tables and gate.
    night = make_run(rows=rows)
    by_experiment = table_of(rows, kinds, "experiment")
    for row in judged(night, no_baseline()).by_experiment().iter_rows(named=True):
        expected = by_experiment[(row["experiment"],)]
        assert {kind: row["answered" if kind == "ok" else kind] for kind in KINDS} == expected
        assert row["rows"] == expected["ok"] + expected["failed"] + expected["missed"]
    (line,) = results(night).rows
    assert [entry.text for entry in (line[1], line[2], *line[4:7])] == [
        total["ok"] + total["failed"] + total["missed"], *(total[kind] for kind in ("ok", "failed", "missed", "false"))
    ]  # fmt: skip
    cells = rows.select(CELL).unique(maintain_order=True).with_row_index("cell")
    gate = harms(pl.concat([rows, pl.DataFrame(schema=SCHEMA)], how="diagonal"), cells)
    assert gate.filter(pl.col("quantity") == "false")["value"].sum() == total["false"]


def test_columns_that_a_table_lacks_say_nothing():
    bare = pl.DataFrame({"true_id": [0, 0, None], "status": ["ok", "missed", "ok"]})
    assert bare.select(kind=row_kind(bare))["kind"].to_list() == ["ok", "missed", "false"]
    assert bare.filter(is_false(bare)).height == 1
    assert bare.select(**counts(bare)).row(0) == (2, 1, 0, 1, 1, 0, 0)


def test_in_the_dark_nothing_counts_as_found():
    rows = pl.DataFrame(
        [{"setting": "a", "realisation": 0, "estimator": "cone_axis", "true_id": i, "specularity": None,
          "status": "no_light", "frame_visible": None} for i in range(3)],
        schema_overrides={"specularity": pl.Int64, "frame_visible": pl.Int64},
    )  # fmt: skip
    run = Run(None, completed(rows).with_columns(pl.lit(0.0).alias("surface.viewpoint")))
    (found,) = coverage(run).found.iter_rows(named=True)
    assert (found["true"], found["found"], found["detections"], found["missed"]) == (3, 0, 0, 0)
    assert (found["coverage"], found["false_share"]) == (0.0, None)
    assert _counted(rows) == (3, 0, 0, 0, 0, 0)
