"""Errors per surface: boxes with points, and a table with counts."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.pages.axes import Axis, log_range
from simtest.pages.chart import Chart, Mark, Panel
from simtest.pages.style import Array, Symbol, degrees, estimator_order
from simtest.report.coverage import is_anatomical
from simtest.report.run_folder import Run

_LEAST_DEG = 1e-6  # errors of exactly zero still show on a logarithmic axis

STRIP_POINTS = 120
"""Points drawn beside a box: evenly spaced order statistics where there are more values."""

_DOT = Symbol(".", "circle", "●")


@dataclass(frozen=True)
class Box:
    """Distribution of the errors of one estimator on one surface, deg; its middle and width on the axis of surfaces.

    `low` and `high` end the whiskers, within 1.5 quartile ranges.
    """

    surface: str
    estimator: str
    middle: float
    width: float
    low: float
    q1: float
    median: float
    q3: float
    high: float
    points: Array
    points_x: Array


@dataclass(frozen=True)
class SurfaceRow:
    """Counts of one estimator on one surface, and its errors, deg, None where there is none."""

    surface: str
    estimator: str
    n: int
    ok: int
    failed: int
    missed: int
    false: int
    mean: float | None
    median: float | None
    p95: float | None
    max: float | None


@dataclass(frozen=True)
class SurfaceErrors:
    """Errors per surface."""

    surfaces: tuple[str, ...]
    boxes: tuple[Box, ...]
    table: tuple[SurfaceRow, ...]


def surface_errors(run: Run, has_figures: bool) -> SurfaceErrors | None:
    """Compute the errors per surface for anatomy, and for runs that have no other figure of their errors.

    Returns None where there is nothing to show.
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
            table.append(_row(own, hits, surface, name))
            if hits.len():
                boxes.append(_box(hits, surface, name, i + (j - (len(names) - 1) / 2) * width, width * 0.8))
    return SurfaceErrors(tuple(surfaces), tuple(boxes), tuple(table))


def _row(own: pl.DataFrame, hits: pl.Series, surface: str, estimator: str) -> SurfaceRow:
    detected = own.filter(pl.col("true_id").is_not_null())
    sizes = [hits.mean(), hits.median(), hits.quantile(0.95, "linear"), hits.max()]
    return SurfaceRow(
        surface, estimator, detected.height, int(detected["ok"].sum()),
        detected.filter(~pl.col("ok") & (pl.col("status") != "missed")).height,
        own.filter(pl.col("status") == "missed").height, own.filter(pl.col("true_id").is_null()).height,
        *(None if size is None else float(size) for size in sizes),  # type: ignore[arg-type]
    )  # fmt: skip


def _box(hits: pl.Series, surface: str, estimator: str, middle: float, width: float) -> Box:
    values = np.maximum(np.sort(hits.to_numpy().astype(float)), _LEAST_DEG)
    q1, median, q3 = (float(q) for q in np.quantile(values, [0.25, 0.5, 0.75]))
    inside = values[(values >= q1 - 1.5 * (q3 - q1)) & (values <= q3 + 1.5 * (q3 - q1))]
    kept = values[np.linspace(0, values.size - 1, min(values.size, STRIP_POINTS)).round().astype(int)]
    # The golden ratio spreads neighbours in rank evenly across the box, the same way in every run.
    jitter = (np.arange(kept.size) * 0.6180339887 % 1 - 0.5) * width * 0.8
    ends = float(inside.min()), float(inside.max())
    return Box(surface, estimator, middle, width, ends[0], q1, median, q3, ends[1], kept, middle + jitter)


def surface_chart(data: SurfaceErrors, colours: Mapping[str, str]) -> Chart:
    """Describe the errors per surface."""
    names = tuple((float(i), name) for i, name in enumerate(data.surfaces))
    x = Axis("", limits=(-0.6, len(names) - 0.4), named=names)
    y = Axis("angular error (deg)", "log", log_range([box.points for box in data.boxes]))
    marks = [mark for box in data.boxes for mark in _box_marks(box, colours[box.estimator])]
    return Chart("anatomy", "Errors per surface", (Panel(x, y, tuple(marks)),), 440)


def _box_marks(box: Box, colour: str) -> list[Mark]:
    """Return the points of a box, its outline with whiskers as one line, and its median."""
    left, right, half = box.middle - box.width / 2, box.middle + box.width / 2, box.width / 4
    middle, nan = box.middle, float("nan")
    outline = [(left, box.q1), (right, box.q1), (right, box.q3), (left, box.q3), (left, box.q1), (nan, nan)]
    for end, quartile in ((box.low, box.q1), (box.high, box.q3)):
        outline += [
            (middle, quartile),
            (middle, end),
            (nan, nan),
            (middle - half, end),
            (middle + half, end),
            (nan, nan),
        ]
    told = f"{box.estimator}, {box.surface}\nmedian {degrees(box.median)}, quartiles {degrees(box.q1)} and "
    told += f"{degrees(box.q3)}\nwhiskers {degrees(box.low)} and {degrees(box.high)}"
    x, y = np.array(outline).T
    return [
        Mark(box.points_x, box.points, colour, box.estimator, symbol=_DOT, size=4, opacity=0.5, listed=False,
             hover=f"{box.estimator}, {box.surface}\n{{y}}°"),
        Mark(x, y, colour, box.estimator, line="solid", width=1.5),
        Mark([left, middle, right], [box.median] * 3, colour, box.estimator, line="solid", width=2.6, listed=False,
             hover=[told] * 3),
    ]  # fmt: skip
