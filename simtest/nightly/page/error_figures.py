"""Error against curvature, offset, noise, roughness and what else was swept: an experiment at a time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.records import NightlyRun
from simtest.pages import style
from simtest.report import labels as words
from simtest.report.paper.sweeps import sweep_figures
from simtest.report.run_folder import Run, completed
from simtest.report.series import LineFigure, line_figures

_NOISE = "sensor.noise_sigma"

GROUPS = {
    "curvature": "Error against curvature",
    "offset": "Error against light offset",
    "noise": "Error against noise",
    "roughness": "Error against roughness",
    "other": "Error against what else was swept",
}
"""Headings by group."""

_GROUP_OF = {
    "error_vs_curvature": "curvature", "axis_ratio": "curvature", "error_vs_offset": "offset",
    "error_vs_sensor_noise_sigma": "noise", "error_vs_reflectance_exponent": "roughness",
    "error_vs_reflectance_alpha": "roughness", "error_vs_reflectance_roughness": "roughness",
}  # fmt: skip
_GROUP_OF_PAPER = {"sigma": "noise", "exponent": "roughness", "eps": "offset"}


@dataclass
class Group:
    """The charts under one heading, of which one is shown at a time."""

    key: str
    title: str
    charts: list[dict[str, Any]] = field(default_factory=list)


def error_figures(night: NightlyRun, colours: Mapping[str, str]) -> tuple[list[Group], dict[str, str]]:
    """Draw the figures of curves of each experiment.

    Parameters
    ----------
    night : NightlyRun
        Whose rows are drawn.
    colours : mapping of str to str
        Colour by estimator.

    Returns
    -------
    list of Group
        Those that have a chart.
    dict of str to str
        plotly figures as JSON by key.
    """
    groups = {key: Group(key, title) for key, title in GROUPS.items()}
    figures: dict[str, str] = {}
    for (name,), rows in night.rows.group_by("experiment", maintain_order=True):
        for group, title, chart, text in _of_experiment(str(name), rows, colours):
            key = f"{group}{len(groups[group].charts)}"
            figures[key] = text
            groups[group].charts.append({"key": key, "choice": f"{name}: {title}" if title else str(name), **chart})
    return [group for group in groups.values() if group.charts], figures


def _of_experiment(name: str, rows: pl.DataFrame, colours: Mapping[str, str]) -> Any:
    """Give (group, title, what the template shows, plotly JSON) of each figure of an experiment."""
    from simtest.report.interactive import lines, to_json
    from simtest.report.paper import interactive as paper

    run = Run(Path(name), _with_noise(completed(rows)), {}, (), 0)
    for figure in line_figures(run):
        group = _GROUP_OF.get(figure.key, "other")
        title = figure.title.removeprefix("Error against ")
        title = "" if figure.key in ("error_vs_curvature", "error_vs_offset") or group == "noise" else title
        yield group, title, _chart(figure), to_json(lines(figure, colours))
    for sweep in sweep_figures(run):
        group = _GROUP_OF_PAPER.get(sweep.parameter.name, "other")
        title = sweep.parameter.axis_title
        chart = {"about": f"{title}: {sweep.parameter.about}", "marks": [], "measured": []}
        yield group, title, chart, to_json(paper.sweep(sweep, colours))


def _with_noise(rows: pl.DataFrame) -> pl.DataFrame:
    """Give rows with the noise as a swept parameter, where the column of that name is not there."""
    return rows if _NOISE in rows.columns else rows.with_columns(pl.col("noise_sigma").alias(_NOISE))


def _chart(figure: LineFigure) -> dict[str, Any]:
    marks = style.symbols(figure.labels)
    return {
        "about": figure.about,
        "marks": [(marks[label].text, label) for label in figure.labels] if len(figure.labels) > 1 else [],
        "measured": words.measured(figure),
    }
