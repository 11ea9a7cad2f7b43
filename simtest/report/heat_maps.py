"""Heat maps: mean error over curvature and light offset."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import polars as pl

from simtest.pages.charts import NOTHING, Axis, Chart, Mark, Panel, finite
from simtest.pages.style import estimator_order, hexadecimal, number
from simtest.report.curves import prepared, scattered, varies
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array

_COLOURS = cv2.COLORMAP_CIVIDIS  # perceptually uniform and colour-blind-safe

_EMPTY, _DARK, _HALF = "#888888", 0.55, 0.49
"""Colour of a cell without a value, share of the scale below which text is white, and half a cell's side."""

_WIDTHS, _LEAST_WIDTH = (0.1, 0.03, 0.01, 0.003), 2e-3
"""Width of a column or row as a share of its values, the widest that melts no more settings than the narrowest; and the
least width."""

_SWATCH = "■"


@dataclass(frozen=True)
class HeatMap:
    """Mean error over curvature (columns) and light offset (rows) for one estimator and label; NaN without a value."""

    estimator: str
    label: str
    kd: Array
    eps_over_d: Array
    mean_deg: Array
    counts: tuple[tuple[str, ...], ...]

    @property
    def title(self) -> str:
        """Heading."""
        return f"{self.estimator}, {self.label}"


def heat_maps(run: Run) -> list[HeatMap]:
    """Compute a heat map for each estimator and label that sweeps both curvature and light offset."""
    maps: list[HeatMap] = []
    for (label,), rows in prepared(run).group_by("label", maintain_order=True):
        rows = rows.filter(pl.col("kd").is_not_null() & pl.col("eps_over_d").is_not_null())
        means = rows.group_by("setting", maintain_order=True).agg(pl.col("kd").mean(), pl.col("eps_over_d").mean())
        if scattered(rows, "kd") or not (varies(means["kd"]) and varies(means["eps_over_d"])):
            continue
        means = _gridded(means)
        if means["column"].n_unique() < 2 or means["row"].n_unique() < 2:
            continue
        rows = rows.join(means.select("setting", "column", "row"), on="setting")
        maps += [_heat_map(rows, means, name, str(label)) for name in estimator_order(rows["estimator"].to_list())]
    return [item for item in maps if np.isfinite(item.mean_deg).any()]


def _gridded(means: pl.DataFrame) -> pl.DataFrame:
    """Assign columns and rows to settings, as wide as leaves settings that differ in cells of their own."""
    grids = [
        means.with_columns(column=_clusters(means["kd"], share), row=_clusters(means["eps_over_d"], share))
        for share in _WIDTHS
    ]
    cells = [grid.select("column", "row").n_unique() for grid in grids]
    return grids[cells.index(max(cells))]


def _clusters(values: pl.Series, share: float) -> pl.Series:
    """Assign one number to nearly equal values: a swept value moves a little as the other quantity changes."""
    numbers, first = {}, None
    for value in values.unique().sort():
        if first is None or value - first > max(_LEAST_WIDTH, share * abs(value)):
            first = value
        numbers[value] = first
    return values.replace_strict(numbers).rank("dense").cast(pl.Int64) - 1


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


def heat_range(maps: Sequence[HeatMap]) -> tuple[float, float]:
    """Return the common colour range of heat maps, deg."""
    values = finite([item.mean_deg for item in maps])
    values = values[values > 0]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.1, 1.0)
    return (low, high) if high > low else (low / 2, low * 2)


def heat_charts(maps: Sequence[HeatMap]) -> list[Chart]:
    """Describe heat maps, on one logarithmic colour scale."""
    span = heat_range(maps)
    return [_heat_chart(item, f"heatmap_{i}", span) for i, item in enumerate(maps)]


def _heat_chart(item: HeatMap, key: str, span: tuple[float, float]) -> Chart:
    columns, rows = ([number(v, 2) for v in values] for values in (item.kd, item.eps_over_d))
    tiles, words = [], []
    corners = _HALF * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    for (row, column), value in np.ndenumerate(item.mean_deg):
        text, share = number(value, 2), _share(value, span)
        told = f"k d {columns[column]}, ε/d {rows[row]}\nmean {text}°\n{item.counts[row][column]} rows"
        x, y = (corners + np.array((column, row))).T
        tiles.append(Mark(x, y, _colour(share), fill=True, hover=told))
        words.append(Mark([column], [row], "#FFFFFF" if share < _DARK else "#000000", words=[text]))
    levels = [base * 10.0**power for power in range(-6, 4) for base in (1, 3)]
    shown = [level for level in levels if span[0] <= level <= span[1]]
    keys = [Mark(NOTHING, NOTHING, _colour(_share(v, span)), f"{v:g}°", symbol=_SWATCH) for v in shown]
    x_axis = Axis("k d", limits=(-0.5, len(columns) - 0.5), named=tuple(enumerate(columns)))
    y_axis = Axis("light offset over distance, ε/d", limits=(-0.5, len(rows) - 0.5), named=tuple(enumerate(rows)))
    return Chart(key, item.title, (Panel(x_axis, y_axis, (*tiles, *words)),), 340, tuple(keys))


def _share(value: float, span: tuple[float, float]) -> float:
    """Return where an error lies on the colour scale, in [0, 1]; NaN where there is none."""
    if not np.isfinite(value):
        return float("nan")
    low, high = np.log(span)
    return float(np.clip((np.log(max(value, span[0])) - low) / (high - low), 0, 1))


def _colour(share: float) -> str:
    if not np.isfinite(share):
        return _EMPTY
    level = np.full((1, 1), min(int(256 * share), 255), np.uint8)
    blue, green, red = cv2.applyColorMap(level, _COLOURS)[0, 0] / 255
    return hexadecimal((red, green, blue))
