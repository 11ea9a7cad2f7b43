"""Errors per surface: boxes with points, and a table with counts."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.pages.charts import Axis, Chart, Mark, Panel, log_range
from simtest.pages.style import degrees, estimator_order
from simtest.report.coverage import is_anatomical
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.validation.situations import CO_LOCATED
from simtest.validation.statistics import counts, row_kind

_LEAST_DEG = 1e-6  # errors of exactly zero still show on a logarithmic axis
STRIP_POINTS = 120  # points drawn beside a box: evenly spaced order statistics where there are more values
_DOT = "●"


class Box(NamedTuple):
    """Distribution of the errors of one estimator on one surface, deg."""

    surface: str
    estimator: str
    middle: float  # on the axis of surfaces, as its width
    width: float
    low: float  # ends of the whiskers, within 1.5 quartile ranges
    q1: float
    median: float
    q3: float
    high: float
    points: Array
    points_x: Array


class SurfaceErrors(NamedTuple):
    """Errors per surface."""

    surfaces: list[str]
    boxes: list[Box]
    table: pl.DataFrame  # surface, estimator, `row_kinds.counts`, mean, median, p95, max (deg)


def surface_errors(run: Run, has_figures: bool) -> SurfaceErrors | None:
    """Compute the errors per surface for anatomy, and for runs that have no other figure of their errors.

    Returns None where there is nothing to show.
    """
    if run.results.is_empty() or (has_figures and not is_anatomical(run)):
        return None
    results = _apart(run.results)
    surfaces = [str(s) for s in results["surface"].unique(maintain_order=True)]
    names = estimator_order(run.results["estimator"].to_list())
    errors = pl.col("error_oracle_deg").filter(row_kind(results) == "ok").drop_nulls()
    table = results.group_by("surface", "estimator").agg(
        **counts(results), mean=errors.mean(), median=errors.median(), p95=errors.quantile(0.95, "linear"),
        max=errors.max(), errors=errors.sort(),
    )  # fmt: skip
    ranks = [pl.col(key).replace_strict(order, range(len(order)), return_dtype=pl.Int64)
             for key, order in (("surface", surfaces), ("estimator", names))]  # fmt: skip
    table = table.sort(ranks)
    width = 0.8 / len(names)
    boxes = []
    for surface, name, held in table.select("surface", "estimator", "errors").iter_rows():
        middle = surfaces.index(surface) + (names.index(name) - (len(names) - 1) / 2) * width
        boxes += [_box(np.array(held), surface, name, middle, 0.8 * width)] if held else []
    return SurfaceErrors(surfaces, boxes, table.drop("errors"))


def _apart(results: pl.DataFrame) -> pl.DataFrame:
    """Name a surface twice where it is lit from the camera and from beside it: their errors differ in kind."""
    beside = (pl.col("eps_over_d").max().over("surface", "setting") > CO_LOCATED).fill_null(False)
    results = results.with_columns(beside=beside)
    both = pl.col("beside").any().over("surface") & ~pl.col("beside").all().over("surface")
    name = pl.when(both & pl.col("beside")).then(pl.col("surface") + ", offset").otherwise("surface")
    return results.with_columns(surface=name)


def _box(errors: Array, surface: str, estimator: str, middle: float, width: float) -> Box:
    """Describe errors in ascending order."""
    values = np.maximum(errors, _LEAST_DEG)
    q1, median, q3 = (float(q) for q in np.quantile(values, [0.25, 0.5, 0.75]))
    inside = values[(values >= q1 - 1.5 * (q3 - q1)) & (values <= q3 + 1.5 * (q3 - q1))]
    kept = values[np.linspace(0, values.size - 1, min(values.size, STRIP_POINTS)).round().astype(int)]
    # The golden ratio spreads neighbours in rank evenly across the box, the same way in every run.
    jitter = (np.arange(kept.size) * 0.6180339887 % 1 - 0.5) * width * 0.8
    low, high = float(inside.min()), float(inside.max())
    return Box(surface, estimator, middle, width, low, q1, median, q3, high, kept, middle + jitter)


def surface_chart(data: SurfaceErrors, colours: Mapping[str, str]) -> Chart:
    """Describe the errors per surface."""
    # On two lines where a name has two parts, or neighbours would overlap.
    names = tuple((float(i), name.replace(", ", ",\n")) for i, name in enumerate(data.surfaces))
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
