"""What the gate says of many pairs of nightly runs, against the outcomes that are stored in tests/data/gate_pairs.json.

Runs are made up, or they are the rows of some experiments of a real baseline (tests/data/gate_rows.parquet) with a
planted change. After a change of the gate that is meant, `PYTHONPATH=.:tests/unit python -m test_gate_pairs` stores
the outcomes anew.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from gate_edits import EDITS
from gate_nights import changed, night, raised, rows, whole, with_signs

from simtest.conventions import MOTION_COLUMNS
from simtest.nightly.compare import compare

DATA = Path(__file__).parents[1] / "data"
STORED = DATA / "gate_pairs.json"

FEW, TRUE = pl.col("realisation") < 12, pl.col("true_id").is_not_null()
GONE = {"error_deg": None, "mahalanobis2": None, "axis_ratio": None}
OTHER_VERSIONS = {"versions": {"numpy": "2.5", "simtest": "0.1"}}
KNOWN, OTHER_DEFINITION = {"definitions": {"e": "1"}}, {"definitions": {"e": "2"}}
MANY = {"count": 1, "settings": tuple("abcdefghijklmnopqrst"), "estimators": ("cone_axis", "curved")}


def found_more(table, **where):
    """Return rows with a false detection beside each highlight of some."""
    own = table.filter(TRUE, **where)
    return pl.concat([table, changed(own, True, true_id=None, specularity=9, **GONE)])


@cache
def real():
    """Return the run of the rows of some experiments of a baseline."""
    return night(pl.read_parquet(DATA / "gate_rows.parquet"))


def scaled(table, factor, names, **where):
    """Return rows with numbers times a factor where columns have the given values."""
    condition = pl.all_horizontal(pl.lit(True), *(pl.col(name) == value for name, value in where.items()))
    return table.with_columns(
        pl.when(condition).then(pl.col(name) * factor).otherwise(name).alias(name) for name in names
    )


ERRORS = ("error_deg", "error_oracle_deg", "error_base_deg", "error_look_deg")

MADE = {
    "equal": lambda: (rows(), {}, rows(), {}),
    "one estimator up": lambda: (raised(rows(estimators=("cone_axis", "circle_pose"), settings=("a", "b")), 1.1), {},
                                 rows(estimators=("cone_axis", "circle_pose"), settings=("a", "b")), {}),
    "errors down": lambda: (rows(), {}, raised(rows(), 1.1), {}),
    "a rise within the margin": lambda: (raised(rows(), 1.015), {}, rows(), {}),
    "a rise of small errors": lambda: (raised(rows(level=0.01), 1.1), {}, rows(level=0.01), {}),
    "rounding elsewhere": lambda: (raised(rows(), 1 + 1e-7), {"processor": "two"}, rows(), {}),
    "answers that fail": lambda: (changed(rows(), FEW, status="no_closed_isophote", **GONE), {}, rows(), {}),
    "no answer": lambda: (changed(rows(), True, status="no_peak", **GONE), {}, rows(), {}),
    "missed where it failed": lambda: (
        changed(changed(rows(), True, status="no_peak", **GONE), FEW, status="missed"), {},
        changed(rows(), True, status="no_peak", **GONE), {}),
    "errors that are no numbers": lambda: (changed(rows(), FEW, error_deg=float("nan")), {}, rows(), {}),
    "distances that are no numbers": lambda: (changed(rows(), FEW, mahalanobis2=float("nan")), {}, rows(), {}),
    "one realisation": lambda: (raised(rows(count=1), 2.0), {}, rows(count=1), {}),
    "one realisation of many settings": lambda: (raised(rows(**MANY), 1.1), {}, rows(**MANY), {}),
    "a setting gone, another new": lambda: (
        rows(settings=("a", "b")).filter(setting="b"), {}, rows(settings=("a", "b")).filter(setting="a"), {}),
    "highlights lost": lambda: (rows().filter(pl.col("error_deg") < 1.0), {}, rows(), {}),
    "highlights lost and errors up": lambda: (raised(rows().filter(pl.col("error_deg") < 1.0), 1.1), {}, rows(), {}),
    "frames lost with false detections": lambda: (found_more(rows()).filter(~FEW), {}, found_more(rows()), {}),
    "highlights under another number": lambda: (changed(rows(), FEW, true_id=7), {}, rows(), {}),
    "more highlights": lambda: (pl.concat([rows(), changed(rows(), True, true_id=7)]), {}, rows(), {}),
    "lost with other versions": lambda: (rows().head(15), OTHER_VERSIONS, rows(), {}),
    "other seeds": lambda: (rows(seed=1), {}, rows(), {}),
    "other seeds, errors up": lambda: (raised(rows(seed=1), 3.0), {}, rows(), {}),
    "other seeds, errors down": lambda: (raised(rows(seed=1), 0.3), {}, rows(), {}),
    "more realisations": lambda: (rows(count=25), {}, rows(), {}),
    "other versions, errors up": lambda: (raised(rows(), 3.0), OTHER_VERSIONS, rows(), {}),
    "simtest of another version": lambda: (
        raised(rows(), 1.1), {"versions": {"numpy": "2.4", "simtest": "0.2"}}, rows(), {}),
    "another definition": lambda: (changed(rows(), FEW, error_deg=0.1), OTHER_DEFINITION, rows(), KNOWN),
    "false detections": lambda: (found_more(rows()), {}, rows(), {}),
    "coverage deflated": lambda: (
        changed(rows(), FEW, mahalanobis2=50.0), {}, changed(rows(), True, mahalanobis2=1.0), {}),
    "regions gone": lambda: (changed(rows(), FEW, mahalanobis2=None), {}, rows(), {}),
    "axis ratios gone": lambda: (changed(rows(), FEW, axis_ratio=None), {}, rows(), {}),
    "axis ratios off": lambda: (changed(rows(), True, axis_ratio=0.6), {}, rows(), {}),
    "a find in an empty frame": lambda: (
        pl.concat([rows(), changed(rows().head(1), True, realisation=77, seed=77, true_id=None, **GONE)]), {},
        rows(), {}),
    "wrong signs": lambda: (with_signs(wrong=0.2), {}, with_signs(), {}),
    "fewer wrong signs": lambda: (with_signs(), {}, with_signs(wrong=0.2), {}),
    "signs of an older baseline": lambda: (
        with_signs(wrong=1.0), {}, with_signs().drop(MOTION_COLUMNS), {}),
}  # fmt: skip
"""Pairs of tonight and the baseline, as rows and what the record says otherwise."""

EDITED = {f"edit: {name}": edit for name, edit in EDITS.items()}

PLANTED = {
    "errors of cone_axis x 1.1": lambda table: scaled(table, 1.1, ERRORS, estimator="cone_axis"),
    "errors of bisector x 1.03": lambda table: scaled(table, 1.03, ERRORS, estimator="bisector"),
    "errors of circle_pose x 0.7": lambda table: scaled(table, 0.7, ERRORS, estimator="circle_pose"),
    "a flag": lambda table: changed(
        table, (pl.col("estimator") == "cone_axis") & (pl.col("status") == "ok") & (pl.col("experiment") == "colon"),
        flags="saturated"),
    "a status": lambda table: changed(
        table, (pl.col("estimator") == "cone_axis") & (pl.col("realisation") == 0) & TRUE, status="no_peak", **GONE),
    "highlights lost": lambda table: table.filter(~(TRUE & (pl.col("realisation") % 5 == 3))),
    "other seeds": lambda table: table.with_columns(pl.col("seed") + 1),
    "coverage deflated": lambda table: scaled(table, 9.0, ("mahalanobis2",), experiment="known_light"),
    "false detections": lambda table: found_more(table, experiment="known_light", estimator="bisector"),
    "true highlights of a relief gone": lambda table: changed(
        table, (pl.col("experiment") == "relief") & (pl.col("estimator") == "cone_axis"), true_id=None, **GONE),
    "peaks x 1.2": lambda table: scaled(table, 1.2, ("peak_snr",), experiment="colon"),
}  # fmt: skip
"""Changes of a real baseline's rows."""

UNPAIRED = ", other versions"
"""Ends the name of a pair of other versions."""

NAMES = [*MADE, *EDITED, *(f"real: {name}" for name in PLANTED),
         *(f"real: {name}{UNPAIRED}" for name in list(PLANTED)[:4])]  # fmt: skip
"""All pairs."""


def verdict_of(name):
    """Return the gate's verdict on a pair."""
    if name in MADE:
        tonight, record, baseline, other = MADE[name]()
        return compare(night(tonight, **record), night(baseline, **other))
    if name in EDITED:
        table = whole()
        return compare(night(EDITED[name](table, np.random.default_rng(0))), night(table))
    record = OTHER_VERSIONS if name.endswith(UNPAIRED) else {}
    planted = name.removeprefix("real: ").removesuffix(UNPAIRED)
    return compare(night(PLANTED[planted](real().rows), **record), real())


def outcome_of(verdict):
    """Return what is stored of a verdict; a finding is a line: cell, quantity, method, outcome, number, p."""
    found = verdict.comparisons.filter(pl.col("outcome").is_in(["worse", "better", "changed"]))
    lines = [
        " | ".join(
            [*(row[name] or "-" for name in ("experiment", "setting", "estimator", "quantity", "method", "outcome")),
             *("-" if row[name] is None else f"{round(row[name], 9):g}" for name in ("tonight", "p", "p_holm"))]
        )
        for row in found.iter_rows(named=True)
    ]  # fmt: skip
    counts = {outcome: count for outcome, count in verdict.counts.items() if count}
    return {"state": verdict.state, "bit_equal": verdict.bit_equal, "counts": counts, "findings": sorted(lines)}


@pytest.fixture(scope="module")
def stored():
    return json.loads(STORED.read_text(encoding="utf-8"))


def test_all_pairs_are_stored(stored):
    assert list(stored) == NAMES


# In `make test` a third of them.
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.ci) if i % 3 else name for i, name in enumerate(NAMES)]
)
def test_the_verdict_is_as_stored(stored, name):
    assert outcome_of(verdict_of(name)) == stored[name]


def test_another_change_is_another_outcome(stored):
    """Negative control: the least change of the planted numbers is seen."""
    table = rows(estimators=("cone_axis", "circle_pose"), settings=("a", "b"))
    assert outcome_of(compare(night(raised(table, 1.1)), night(table))) == stored["one estimator up"]
    assert outcome_of(compare(night(raised(table, 1.1001)), night(table))) != stored["one estimator up"]


if __name__ == "__main__":
    outcomes = {name: outcome_of(verdict_of(name)) for name in NAMES}
    STORED.write_text(json.dumps(outcomes, indent=1) + "\n", encoding="utf-8")
