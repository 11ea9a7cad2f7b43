"""The course of the figures over the runs: of each experiment and estimator the median over the settings."""

from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta

import numpy as np
import polars as pl

from simtest.nightly.history import TRENDS
from simtest.nightly.phrases import short_commit
from simtest.nightly.records import RunRecord
from simtest.pages.charts import Axis, Chart, Mark, Panel
from simtest.pages.style import NEUTRAL, number

TITLES = dict(zip(TRENDS, ("mean error (deg)", "unanswered", "in the 95 % region"), strict=True))
"""What the panels show, by quantity."""

_TICKS = 4
"""As many dates stand side by side on a phone."""

_DAY_S = 86_400.0
_POINT, _CROSS = "●", "✖"


def trends(history: pl.DataFrame, baseline: RunRecord | None, colours: Mapping[str, str]) -> list[Chart]:
    """Describe a chart for each experiment, with a panel a quantity, of a history (`read_history`)."""
    if history.is_empty():
        return []
    first = history["started"].min()
    assert isinstance(first, datetime)
    key = ("experiment", "estimator", "quantity", "run_id", "started", "commit", "state")
    medians = history.group_by(key).agg(pl.col("value").median()).sort(*key[:3], "started", "run_id")
    medians = medians.with_columns(day=(pl.col("started") - first).dt.total_seconds() / _DAY_S)
    accepted = None if baseline is None else (baseline.start - first).total_seconds() / _DAY_S
    # A run alone has no span.
    low, high = -0.5, float(medians["day"].to_numpy().max()) + 0.5
    days = np.unique(np.linspace(0, np.floor(high), _TICKS).round())
    x = Axis("", limits=(low, high), named=tuple((day, f"{first + timedelta(days=day):%Y-%m-%d}") for day in days))
    return [
        Chart(f"trend{i}", str(name), tuple(_panels(own, x, accepted, colours)), height=640)
        for i, ((name,), own) in enumerate(medians.group_by("experiment", maintain_order=True))
    ]


def _panels(medians: pl.DataFrame, x: Axis, accepted: float | None, colours: Mapping[str, str]) -> Iterator[Panel]:
    for quantity, title in TITLES.items():
        shown = medians.filter(pl.col("quantity") == quantity)
        if shown.is_empty():
            continue
        least, most = float(shown["value"].to_numpy().min()), float(shown["value"].to_numpy().max())
        marks = [mark for (name,), own in shown.group_by("estimator", maintain_order=True)
                 for mark in _curve(str(name), own, colours.get(str(name), NEUTRAL))]  # fmt: skip
        if accepted is not None:
            marks.append(Mark([accepted] * 2, [least, most], NEUTRAL, "baseline", line="dot"))
        yield Panel(x, Axis(title, "log" if 0 < 20 * least < most else "linear"), tuple(marks))


def _curve(name: str, runs: pl.DataFrame, colour: str) -> Iterator[Mark]:
    """Yield the curve of an estimator, and crosses at the runs that were a regression or changed."""
    told = [
        f"{name}: {number(row['value'])}\n{row['started']:%Y-%m-%d %H:%M} UTC\n"
        f"commit {short_commit(row['commit'])}, {row['state']}"
        for row in runs.iter_rows(named=True)
    ]
    day, value = runs["day"].to_numpy(), runs["value"].to_numpy()
    yield Mark(day, value, colour, name, line="solid", width=1.3, symbol=_POINT, size=4, hover=told)
    found = runs["state"].is_in(["regression", "changed"]).fill_null(False).to_numpy()
    if found.any():
        why = [text for text, is_found in zip(told, found, strict=True) if is_found]
        yield Mark(day[found], value[found], colour, name, listed=False, symbol=_CROSS, size=10, hover=why)
