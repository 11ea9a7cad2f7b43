"""Error against curvature, offset, noise, roughness and what else was swept: an experiment at a time."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import polars as pl

from simtest.nightly.records import NightlyRun
from simtest.pages.chart import Chart
from simtest.report.paper.sweep_chart import sweep_chart
from simtest.report.paper.sweeps import sweep_figures
from simtest.report.run_folder import Run, completed
from simtest.report.sentences import measured
from simtest.report.series import line_chart, line_figures

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


@dataclass(frozen=True)
class ErrorFigure:
    """A chart of an experiment: its group, how it is chosen in there, what it shows, and its numbers in words."""

    group: str
    choice: str
    about: str
    chart: Chart
    measured: list[str]


@dataclass(frozen=True)
class Group:
    """The figures under one heading, of which one is shown at a time."""

    key: str
    title: str
    figures: list[ErrorFigure] = field(default_factory=list)


def error_figures(run: NightlyRun, colours: Mapping[str, str]) -> list[Group]:
    """Describe the figures of curves of each experiment, by group; a group without a figure is left out."""
    groups = {key: Group(key, title) for key, title in GROUPS.items()}
    for (name,), rows in run.rows.group_by("experiment", maintain_order=True):
        for figure in _of_experiment(str(name), rows, colours):
            shown = groups[figure.group].figures
            # Several experiments have figures of one name.
            chart = replace(figure.chart, key=f"{figure.group}{len(shown)}")
            shown.append(replace(figure, chart=chart))
    return [group for group in groups.values() if group.figures]


def _of_experiment(name: str, rows: pl.DataFrame, colours: Mapping[str, str]) -> Iterator[ErrorFigure]:
    run = Run(Path(name), _with_noise(completed(rows)))
    for figure in line_figures(run):
        group = _GROUP_OF.get(figure.key, "other")
        # The group's heading says already what the commonest figures show.
        told = figure.key in ("error_vs_curvature", "error_vs_offset") or group == "noise"
        title = "" if told else figure.title.removeprefix("Error against ")
        choice = f"{name}: {title}" if title else name
        yield ErrorFigure(group, choice, figure.about, line_chart(figure, colours), measured(figure))
    for sweep in sweep_figures(run):
        group = _GROUP_OF_PAPER.get(sweep.parameter.name, "other")
        title = sweep.parameter.axis_title
        about = f"{title}: {sweep.parameter.about}"
        yield ErrorFigure(group, f"{name}: {title}", about, sweep_chart(sweep, colours), [])


def _with_noise(rows: pl.DataFrame) -> pl.DataFrame:
    """Return rows with the noise as a swept parameter, also where the column of that name is not there."""
    return rows if _NOISE in rows.columns else rows.with_columns(pl.col("noise_sigma").alias(_NOISE))
