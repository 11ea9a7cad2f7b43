"""Everything that is published is judged, or is listed as not judged with a reason."""

import dataclasses
import re

import polars as pl
import pytest

from simtest.nightly.gate.checks import RULES
from simtest.nightly.gate.judged import COLUMNS, SUMMARY, Judged
from simtest.nightly.gate.limits import Limits
from simtest.nightly.gate.pairing import with_all_frames
from simtest.nightly.gate.quantities import HARMS, quantities
from simtest.nightly.gate.single_results import STEPS
from simtest.validation.results_table import SCHEMA
from simtest.validation.statistics import Figures


def test_every_column_and_figure_is_judged_or_has_a_reason():
    assert set(COLUMNS) == set(SCHEMA), "a column of results is neither judged nor listed with a reason: gate/judged.py"
    fields = {field.name for field in dataclasses.fields(Figures)}
    assert set(SUMMARY) == fields, "a figure of summary.json is neither judged nor listed with a reason"
    for table in (COLUMNS, SUMMARY):
        for name, entry in table.items():
            assert isinstance(entry, Judged) or len(entry.reason) > 20, name


@pytest.mark.parametrize("table", [COLUMNS, SUMMARY])
def test_what_is_named_as_judging_exists(table):
    tested = set(quantities(Limits()))
    known = tested | set(RULES) | {f"single {name}" for name in (*STEPS, "answers", "flags", "false")} | {"n"}
    for name, entry in table.items():
        if isinstance(entry, Judged):
            told = [part for part in re.split(", (?!interval)", entry.quantity) if not part.startswith("published")]
            assert set(told) <= known, name
            assert entry.limit, name


def test_every_quantity_has_a_value_of_rows():
    assert set(quantities(Limits())) - {"false"} == set(HARMS)


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
