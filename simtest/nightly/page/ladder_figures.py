"""The error ladder: what is left of the error when each stage's input is replaced by the exact one."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl

from simtest.nightly.phrases import interval
from simtest.nightly.records import NightlyRun
from simtest.pages import style
from simtest.pages.style import degrees, number

FLOOR_DEG = 1e-6
"""Smaller errors are rounding: on the chart's logarithmic axis they are drawn here."""


@dataclass(frozen=True)
class Ladder:
    """A table of rungs.

    Parameters
    ----------
    rungs : tuple of (str, str)
        Name and meaning of each, from the whole pipeline to the exact answer.
    rows : list of dict
        One a scene and estimator: the errors by rung, and which stage adds most.
    chart : str
        plotly figure as JSON.
    """

    rungs: tuple[tuple[str, str], ...]
    rows: list[dict[str, Any]]
    chart: str


def ladder(night: NightlyRun, colours: Mapping[str, str]) -> Ladder | None:
    """Give the ladder of a night; None where it has none."""
    figures = night.figures.filter((pl.col("kind") == "ladder") & pl.col("value").is_not_null())
    if figures.is_empty():
        return None
    told = figures.select("quantity", "about").unique("quantity", keep="first", maintain_order=True)
    rungs = tuple((str(name), str(about or "")) for name, about in told.iter_rows())
    names = [name for name, _ in rungs]
    rows = []
    for (setting, estimator), own in figures.group_by("setting", "estimator", maintain_order=True):
        found = {row["quantity"]: row for row in own.iter_rows(named=True)}
        cells = [found.get(name) for name in names]
        rows.append(
            {"setting": setting or "–", "estimator": estimator or "–",
             "cells": [_cell(cell) for cell in cells], "blame": _blame(names, cells),
             "values": [None if cell is None else cell["value"] for cell in cells]}
        )  # fmt: skip
    return Ladder(rungs, rows, _chart(names, rows, colours))


def _cell(cell: dict[str, Any] | None) -> dict[str, Any]:
    if cell is None:
        return {"text": "–", "sort": None, "interval": ""}
    held = interval(cell["low"], cell["high"])
    return {"text": degrees(cell["value"]), "sort": cell["value"], "interval": "" if held == "–" else held}


def _blame(names: list[str], cells: list[dict[str, Any] | None]) -> str:
    """Name the rung whose step takes most of the error away, with its share of the whole."""
    values = [(name, cell["value"]) for name, cell in zip(names, cells, strict=True) if cell is not None]
    if len(values) < 2 or values[0][1] <= FLOOR_DEG:
        return "–"
    steps = [(before - after, name) for (_, before), (name, after) in pairwise(values)]
    most, name = max(steps)
    return f"{name} ({number(100 * most / values[0][1], 2)}\u00a0%)" if most > 0 else "–"


def _chart(names: list[str], rows: list[dict[str, Any]], colours: Mapping[str, str]) -> str:
    import plotly.graph_objects as go

    from simtest.report.interactive import layout, to_json

    marks = style.symbols(row["setting"] for row in rows)
    figure = go.Figure()
    named: set[str] = set()
    for row in rows:
        values = [None if value is None else max(value, FLOOR_DEG) for value in row["values"]]
        name, colour = row["estimator"], colours.get(row["estimator"], style.NEUTRAL)
        figure.add_trace(
            go.Scatter(
                x=list(range(len(names))), y=values, mode="lines+markers", name=name, legendgroup=name,
                showlegend=name not in named, line={"color": colour, "width": 1.5},
                marker={"symbol": marks[row["setting"]].plotly, "size": 9, "color": colour},
                customdata=[[cell["text"], rung] for cell, rung in zip(row["cells"], names, strict=True)],
                hovertemplate=f"<b>{escape(name)}</b>, {escape(row['setting'])}<br>"
                "%{customdata[1]}: %{customdata[0]}"
                "<extra></extra>",
            )
        )  # fmt: skip
        named.add(name)
    drawn = [v for row in rows for v in row["values"] if v is not None]
    low, high = max(min(drawn), FLOOR_DEG) / 2, max(max(drawn), FLOOR_DEG) * 2
    texts = [escape(name).replace(" ", "<br>") for name in names]
    x = {"tickvals": list(range(len(names))), "ticktext": texts, "tickangle": 0, "tickfont": {"size": 11},
         "zeroline": False, "automargin": True, "range": [-0.4, len(names) - 0.6]}  # fmt: skip
    y = {"title": {"text": "mean error (deg)"}, "type": "log", "range": [float(np.log10(low)), float(np.log10(high))],
         "dtick": 1, "exponentformat": "power", "automargin": True}  # fmt: skip
    figure.update_layout(layout(440, xaxis=x, yaxis=y))
    return to_json(figure)


def marks_of(made: Ladder) -> list[tuple[str, str]]:
    """Give the characters of the scenes' markers."""
    marks = style.symbols(row["setting"] for row in made.rows)
    return [(mark.text, name) for name, mark in marks.items()]
