"""Everything that is published is judged, or is listed as not judged with a reason."""

import dataclasses
import re

import pytest

from simtest.nightly.gate.checks import RULES
from simtest.nightly.gate.judged import COLUMNS, SUMMARY, Judged
from simtest.nightly.gate.limits import Limits
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
