"""The table of all figures of summary.json."""

from typing import NamedTuple

from simtest.pages.style import number
from simtest.report.run_folder import Run, SummaryRow

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
    """A row: `cells` are (text, sort key) in the order of `COLUMNS`."""

    setting: str
    estimator: str
    cells: list[tuple[str, float | None]]
    reasons: str


def table_rows(run: Run) -> list[TableRow]:
    """Return a row for each experiment, setting and estimator of summary.json."""
    rows = [row for experiment in run.experiments.values() for row in experiment.rows]
    return [
        TableRow(
            row.setting, row.estimator, [_cell(row, key) for key, _ in COLUMNS],
            ", ".join(f"{name} {count}" for name, count in sorted(row.reasons.items())),
        )
        for row in rows
    ]  # fmt: skip


def _cell(row: SummaryRow, key: str) -> tuple[str, float | None]:
    value = row.ci95_deg[0] if key == "ci95_deg" else row.figures.get(key)
    text = number(value)
    if text == "–":
        return text, None
    return f"{text} to {number(row.ci95_deg[1])}" if key == "ci95_deg" else text, value
