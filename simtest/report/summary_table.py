"""The table of all figures of summary.json."""

from typing import NamedTuple

from simtest.pages.style import number
from simtest.report.run_folder import EstimatorFigures, Run

COLUMNS = (
    ("n", "rows"),
    ("n_ok", "ok"),
    ("n_failed", "failed"),
    ("n_missed", "missed"),
    ("n_false", "false"),
    ("mean_deg", "mean\u00a0°"),
    ("mean_oracle_deg", "mean, better candidate\u00a0°"),
    ("rms_deg", "RMS\u00a0°"),
    ("std_deg", "std\u00a0°"),
    ("median_deg", "median\u00a0°"),
    ("p95_deg", "95th pct\u00a0°"),
    ("max_deg", "max\u00a0°"),
    ("mean_penalised_deg", "mean, failures as\u00a090°"),
    ("ci95_deg", "95\u00a0% interval\u00a0°"),
    ("coverage95", "coverage 95\u00a0%"),
)
"""Keys of summary.json and their headings."""


class TableRow(NamedTuple):
    """A row of the table."""

    setting: str
    estimator: str
    cells: list[tuple[str, float | None]]  # text and sort key, in the order of `COLUMNS`
    reasons: str  # of failures, counted


def table_rows(run: Run) -> list[TableRow]:
    """Return a row for each experiment, setting and estimator of summary.json."""
    return [
        TableRow(setting, estimator, [_cell(figures, key) for key, _ in COLUMNS], ", ".join(
            f"{name} {count}" for name, count in sorted(figures.n_failed_by_reason.items()) if count
        ))
        for experiment in run.experiments.values()
        for setting, estimator, figures in experiment.rows
    ]  # fmt: skip


def _cell(figures: EstimatorFigures, key: str) -> tuple[str, float | None]:
    if key == "ci95_deg":
        low, high = figures.ci95_deg or (None, None)
        return ("–", None) if number(low) == "–" else (f"{number(low)} to {number(high)}", low)
    value = sum(figures.n_failed_by_reason.values()) if key == "n_failed" else getattr(figures, key)
    text = number(value)
    return text, None if text == "–" else value
