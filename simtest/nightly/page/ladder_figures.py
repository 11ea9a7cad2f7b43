"""The error ladder: what is left of the error when each stage's input is replaced by the exact one."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.nightly.phrases import interval
from simtest.nightly.records import NightlyRun
from simtest.pages.axes import Axis
from simtest.pages.chart import Chart, Mark, Panel, label_keys
from simtest.pages.style import NEUTRAL, degrees, number, symbols

FLOOR_DEG = 1e-6  # smaller errors are rounding: on the chart's logarithmic axis they are drawn here


class RungError(NamedTuple):
    """The mean error on one rung with its interval, deg; None and "" where there is none."""

    value: float | None = None
    interval: str = ""

    @property
    def text(self) -> str:
        """The error as text."""
        return degrees(self.value)


class LadderRow(NamedTuple):
    """A scene and estimator: the errors by rung, and which stage takes most of the error away."""

    setting: str
    estimator: str
    cells: tuple[RungError, ...]
    blame: str


class Ladder(NamedTuple):
    """A table of rungs: name and meaning of each, from the whole pipeline to the exact answer, and their chart."""

    rungs: tuple[tuple[str, str], ...]
    rows: tuple[LadderRow, ...]
    chart: Chart


def ladder(run: NightlyRun, colours: Mapping[str, str]) -> Ladder | None:
    """Return the ladder of a run; None where it has none."""
    figures = run.figures.filter((pl.col("kind") == "ladder") & pl.col("value").is_not_null())
    if figures.is_empty():
        return None
    told = figures.select("quantity", "about").unique("quantity", keep="first", maintain_order=True)
    rungs = tuple((str(name), str(about or "")) for name, about in told.iter_rows())
    names = [name for name, _ in rungs]
    rows = []
    for (setting, estimator), own in figures.group_by("setting", "estimator", maintain_order=True):
        found = {
            name: RungError(value, "" if (held := interval(low, high)) == "–" else held)
            for name, value, low, high in own.select("quantity", "value", "low", "high").iter_rows()
        }
        cells = tuple(found.get(name, RungError()) for name in names)
        rows.append(LadderRow(str(setting or "–"), str(estimator or "–"), cells, _blame(names, cells)))
    return Ladder(rungs, tuple(rows), _chart(names, rows, colours))


def _blame(names: Sequence[str], cells: Sequence[RungError]) -> str:
    """Name the rung whose step takes most of the error away, with its share of the whole."""
    values = [(name, cell.value) for name, cell in zip(names, cells, strict=True) if cell.value is not None]
    if len(values) < 2 or values[0][1] <= FLOOR_DEG:
        return "–"
    steps = [(before - after, name) for (_, before), (name, after) in pairwise(values)]
    most, name = max(steps)
    return f"{name} ({number(100 * most / values[0][1], 2)}\u00a0%)" if most > 0 else "–"


def _chart(names: Sequence[str], rows: Sequence[LadderRow], colours: Mapping[str, str]) -> Chart:
    shapes = symbols(row.setting for row in rows)
    marks = []
    for row in rows:
        values = np.array([np.nan if cell.value is None else max(cell.value, FLOOR_DEG) for cell in row.cells])
        told = [
            f"{row.estimator}, {row.setting}\n{rung}: {cell.text}" for cell, rung in zip(row.cells, names, strict=True)
        ]
        marks.append(
            Mark(np.arange(len(names)), values, colours.get(row.estimator, NEUTRAL), row.estimator, line="solid",
                 width=1.5, symbol=shapes[row.setting], size=9, hover=told)
        )  # fmt: skip
    x = Axis("", limits=(-0.4, len(names) - 0.6), named=tuple((i, n.replace(" ", "\n")) for i, n in enumerate(names)))
    drawn = np.concatenate([np.asarray(mark.y) for mark in marks])
    y = Axis("mean error (deg)", "log", (float(np.nanmin(drawn)) / 2, float(np.nanmax(drawn)) * 2))
    return Chart("ladder", "Error ladder", (Panel(x, y, tuple(marks)),), 420, label_keys(shapes))
