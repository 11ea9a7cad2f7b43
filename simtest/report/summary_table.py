"""The table of all figures of summary.json."""

from typing import NamedTuple

from simtest.pages.style import number
from simtest.report.run_folder import Run
from simtest.validation.statistics import Figures

HEADINGS = {name: field.title for name, field in Figures.model_fields.items() if field.title}


class TableRow(NamedTuple):
    """A row of the table."""

    setting: str
    estimator: str
    cells: list[tuple[str, float | None]]  # text and sort key, in the order of `HEADINGS`
    reasons: str  # of failures, counted


def table_rows(run: Run) -> list[TableRow]:
    """Return a row for each experiment, setting and estimator of summary.json."""
    rows = []
    for setting, estimator, figures in (row for experiment in run.experiments.values() for row in experiment.rows):
        reasons = {name: count for name, count in sorted(figures.n_failed_by_reason.items()) if count}
        cells = [_cell(getattr(figures, name)) for name in HEADINGS]
        rows.append(TableRow(setting, estimator, cells, ", ".join(f"{k} {n}" for k, n in reasons.items())))
    return rows


def _cell(value: float | dict[str, int] | tuple[float | None, float | None] | None) -> tuple[str, float | None]:
    if isinstance(value, tuple):
        low, high = value
        return ("–", None) if number(low) == "–" else (f"{number(low)} to {number(high)}", low)
    # Failures by reason count together.
    counted = sum(value.values()) if isinstance(value, dict) else value
    text = number(counted)
    return text, None if text == "–" else counted
