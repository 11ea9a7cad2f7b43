"""Heat maps, errors per surface and the summary table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.pages.style import Array, estimator_order, number
from simtest.report.coverage import is_anatomical
from simtest.report.curves import prepared, scattered, varies
from simtest.report.run_folder import Run

_LEAST_DEG = 1e-6  # errors of exactly zero still have a place on a logarithmic axis

STRIP_POINTS = 120
"""Points drawn beside a box: evenly spaced order statistics where there are more values."""


@dataclass(frozen=True)
class HeatMap:
    """Mean error over curvature (columns) and light offset (rows) for one estimator and label."""

    estimator: str
    label: str
    kd: Array
    eps_over_d: Array
    mean_deg: Array
    counts: tuple[tuple[str, ...], ...]

    @property
    def column_names(self) -> list[str]:
        """Texts of the columns, k d."""
        return [number(v, 2) for v in self.kd]

    @property
    def row_names(self) -> list[str]:
        """Texts of the rows, eps/d."""
        return [number(v, 2) for v in self.eps_over_d]


def heat_maps(run: Run) -> list[HeatMap]:
    """Compute a heat map for each estimator and label that sweeps both curvature and light offset.

    Parameters
    ----------
    run : Run
        A run directory.

    Returns
    -------
    list of HeatMap
        Cells without a value are NaN.
    """
    maps: list[HeatMap] = []
    for (label,), rows in prepared(run).group_by("label", maintain_order=True):
        rows = rows.filter(pl.col("kd").is_not_null() & pl.col("eps_over_d").is_not_null())
        means = rows.group_by("setting", maintain_order=True).agg(pl.col("kd").mean(), pl.col("eps_over_d").mean())
        if scattered(rows, "kd") or not (varies(means["kd"]) and varies(means["eps_over_d"])):
            continue
        means = means.with_columns(column=_clusters(means["kd"]), row=_clusters(means["eps_over_d"]))
        if means["column"].n_unique() < 2 or means["row"].n_unique() < 2:
            continue
        rows = rows.join(means.select("setting", "column", "row"), on="setting")
        maps += [_heat_map(rows, means, name, str(label)) for name in estimator_order(rows["estimator"].to_list())]
    return [item for item in maps if np.isfinite(item.mean_deg).any()]


def _clusters(values: pl.Series) -> pl.Series:
    """Give the same number to nearly equal values: a swept value moves a little as the other quantity changes."""
    data = values.to_numpy().astype(float)
    order = np.argsort(data, kind="stable")
    gaps = np.diff(data[order]) > np.maximum(2e-3, 0.1 * np.abs(data[order][1:]))
    numbers = np.empty(data.size, int)
    numbers[order] = np.concatenate([[0], np.cumsum(gaps)])
    return pl.Series(numbers)


def _heat_map(rows: pl.DataFrame, means: pl.DataFrame, estimator: str, label: str) -> HeatMap:
    columns = means.group_by("column").agg(pl.col("kd").mean()).sort("column")["kd"].to_numpy()
    levels = means.group_by("row").agg(pl.col("eps_over_d").mean()).sort("row")["eps_over_d"].to_numpy()
    cells = np.full((levels.size, columns.size), np.nan)
    counts = [["0 of 0"] * columns.size for _ in levels]
    value = pl.col("error_oracle_deg").filter(pl.col("ok") & pl.col("error_oracle_deg").is_not_null())
    own = rows.filter(pl.col("estimator") == estimator)
    table = own.group_by("row", "column").agg(mean=value.mean(), n=value.len(), total=pl.len())
    for row in table.iter_rows(named=True):
        cells[row["row"], row["column"]] = np.nan if row["mean"] is None else row["mean"]
        counts[row["row"]][row["column"]] = f"{row['n']} of {row['total']}"
    return HeatMap(estimator, label, columns, levels, cells, tuple(tuple(line) for line in counts))


@dataclass(frozen=True)
class Box:
    """Distribution of the errors of one estimator on one surface, deg, with the place of its box."""

    surface: str
    estimator: str
    place: float
    width: float
    low: float
    q1: float
    median: float
    q3: float
    high: float
    points: Array
    points_place: Array


@dataclass(frozen=True)
class SurfaceFigure:
    """Errors per surface: boxes, and a table with counts."""

    surfaces: tuple[str, ...]
    boxes: tuple[Box, ...]
    table: tuple[dict[str, Any], ...]


def surface_figure(run: Run, has_figures: bool) -> SurfaceFigure | None:
    """Compute the errors per surface for anatomy, and for runs that have no figure of curves.

    Parameters
    ----------
    run : Run
        A run directory.
    has_figures : bool
        Whether the run has other figures of its errors.

    Returns
    -------
    SurfaceFigure or None
        None where there is nothing to show.
    """
    rows = run.results.with_columns(ok=(pl.col("status") == "ok").fill_null(False))
    if rows.is_empty() or (has_figures and not is_anatomical(run)):
        return None
    surfaces = [str(s) for s in rows["surface"].unique(maintain_order=True)]
    names = estimator_order(rows["estimator"].to_list())
    table, boxes = [], []
    width = 0.8 / max(len(names), 1)
    for i, surface in enumerate(surfaces):
        for j, name in enumerate(names):
            own = rows.filter((pl.col("surface") == surface) & (pl.col("estimator") == name))
            if own.is_empty():
                continue
            hits = own.filter(pl.col("ok") & pl.col("true_id").is_not_null())["error_oracle_deg"].drop_nulls()
            table.append(_surface_row(own, hits, surface, name))
            if hits.len():
                boxes.append(_box(hits, surface, name, i + (j - (len(names) - 1) / 2) * width, width * 0.8))
    return SurfaceFigure(tuple(surfaces), tuple(boxes), tuple(table))


def _surface_row(own: pl.DataFrame, hits: pl.Series, surface: str, estimator: str) -> dict[str, Any]:
    detected = own.filter(pl.col("true_id").is_not_null())
    return {
        "surface": surface, "estimator": estimator,
        "n": detected.height, "ok": int(detected["ok"].sum()),
        "missed": own.filter(pl.col("status") == "missed").height,
        "failed": detected.filter(~pl.col("ok") & (pl.col("status") != "missed")).height,
        "false": own.filter(pl.col("true_id").is_null()).height,
        "mean": hits.mean(), "median": hits.median(), "p95": hits.quantile(0.95, "linear"), "max": hits.max(),
    }  # fmt: skip


def _box(hits: pl.Series, surface: str, estimator: str, place: float, width: float) -> Box:
    values = np.maximum(np.sort(hits.to_numpy().astype(float)), _LEAST_DEG)
    q1, median, q3 = (float(q) for q in np.quantile(values, [0.25, 0.5, 0.75]))
    inside = values[(values >= q1 - 1.5 * (q3 - q1)) & (values <= q3 + 1.5 * (q3 - q1))]
    kept = values[np.linspace(0, values.size - 1, min(values.size, STRIP_POINTS)).round().astype(int)]
    # The golden ratio spreads neighbours in rank evenly across the box, the same way in every run.
    jitter = (np.arange(kept.size) * 0.6180339887 % 1 - 0.5) * width * 0.8
    return Box(
        surface, estimator, place, width, float(inside.min()), q1, median, q3, float(inside.max()), kept, place + jitter
    )


SUMMARY_COLUMNS = (
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


def summary_rows(run: Run) -> list[dict[str, Any]]:
    """Flatten summary.json to one row an experiment, setting and estimator.

    Parameters
    ----------
    run : Run
        A run directory.

    Returns
    -------
    list of dict
        `experiment`, `setting`, `estimator`, `reasons` and `cells`, a list of (text, sort key).
    """
    rows = []
    for experiment, content in run.experiments.items():
        for setting, by_estimator in (content.get("settings") or {}).items():
            for name, figures in (by_estimator or {}).items():
                figures = dict(figures or {})
                reasons = {k: v for k, v in (figures.get("n_failed_by_reason") or {}).items() if v}
                figures["n_failed"] = sum(reasons.values())
                rows.append(
                    {
                        "experiment": experiment, "setting": setting, "estimator": name,
                        "reasons": ", ".join(f"{k} {v}" for k, v in sorted(reasons.items())),
                        "cells": [_cell(figures, key) for key, _ in SUMMARY_COLUMNS],
                    }
                )  # fmt: skip
    return rows


def _cell(figures: Mapping[str, Any], key: str) -> tuple[str, float | None]:
    value = figures.get(key)
    if key == "ci95_deg":
        low, high = [*value, None, None][:2] if isinstance(value, list | tuple) else (None, None)
        text = f"{number(low)} to {number(high)}" if number(low) != "–" else "–"
        return text, low if text != "–" else None
    return number(value), value if number(value) != "–" else None
