"""The tables of a page: errors per surface, found highlights, pairs of estimators, and all figures of summary.json."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.pages.charts import Axis, Chart, Mark, Panel, log_range
from simtest.pages.style import degrees, estimator_order, number
from simtest.report.error_figures import LEAST_LAW, TOLERANCE_DEG, TOLERANCE_SHARE
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.validation.comparison import Pair, compare, distinct_frames, side_by_side, targets_of
from simtest.validation.situations import CO_LOCATED
from simtest.validation.statistics import Figures, counts, row_kind

VIEWPOINT = "surface.viewpoint"
PATH_SHARE = "surface.path_share"
_MEASURES = (("error", "error_oracle_deg", "error_law_deg", "°", TOLERANCE_DEG),
             ("axis ratio", "axis_ratio", "axis_ratio_law", "", 0.0))  # fmt: skip
"""Name, columns of measurement and law, unit and the least tolerance."""


class Coverage(NamedTuple):
    """Two tables of a run over views of anatomies, a row for each setting and for each measure of it with a law."""

    found: pl.DataFrame  # setting, found (true highlights), detections, `counts`, coverage, false_share
    laws: pl.DataFrame  # setting, estimator, measure, unit, n, met (within tolerance), median, median_law, median_gap


def is_anatomical(run: Run) -> bool:
    """Whether a run is one over views of anatomies."""
    return bool({VIEWPOINT, PATH_SHARE} & set(run.results.columns))


def coverage(run: Run) -> Coverage | None:
    """Compute the tables; None for a run that is not over views of anatomies, or has no rows."""
    if not is_anatomical(run) or run.results.is_empty():
        return None
    # Detections are the same for all estimators of single highlights; one of clouds has fewer.
    answers = run.results.group_by("setting", "estimator", maintain_order=True).agg(n=pl.col("specularity").count())
    most = answers.filter(pl.col("n") == pl.col("n").max().over("setting")).unique("setting", keep="first")
    own = run.results.join(most, on=["setting", "estimator"], how="semi", maintain_order="left")
    # Without a detection, a highlight is not found whatever its status: in the dark it is no missed one.
    detected = pl.col("specularity").is_not_null()
    found = own.group_by("setting", maintain_order=True).agg(
        found=(detected & pl.col("true_id").is_not_null()).sum(), detections=detected.sum(), **counts(own)
    )
    # What shines on an instrument is no detection of tissue. Shares of nothing are null.
    detections = pl.col("detections") - pl.col(ON_INSTRUMENT)
    found = found.with_columns(
        coverage=pl.when(pl.col("true") > 0).then(pl.col("found") / pl.col("true")),
        false_share=pl.when(detections > 0).then(pl.col("false") / detections),
    )
    return Coverage(found, _laws(run.results))


def _laws(results: pl.DataFrame) -> pl.DataFrame:
    """Compare each highlight's measurement with the law at its own exact curvature and light."""
    ordered = results.with_row_index("order").with_columns(pl.col("order").min().over("setting"))
    ok = ordered.filter((pl.col("status") == "ok") & pl.col("true_id").is_not_null())
    ranks = {name: rank for rank, name in enumerate(estimator_order(ok["estimator"].to_list()))}
    tables = []
    for measure, value, law, unit, floor in _MEASURES:
        gap = (pl.col(value) - pl.col(law)).abs()
        allowed = pl.max_horizontal(pl.lit(floor), TOLERANCE_SHARE * pl.col(law))
        tables.append(
            ok.filter(pl.col(value).is_not_null() & (pl.col(law) > LEAST_LAW))
            .group_by("setting", "estimator")
            .agg(
                pl.col("order").first(), measure=pl.lit(measure), unit=pl.lit(unit), n=pl.len(),
                met=(gap <= allowed).sum(), median=pl.col(value).median(), median_law=pl.col(law).median(),
                median_gap=gap.median(),
            )
        )  # fmt: skip
    # Settings in their order, in each the estimators in the report's, of each the error first.
    rank = pl.col("estimator").replace_strict(ranks, default=0, return_dtype=pl.Int64)
    return pl.concat(tables).sort("order", rank, maintain_order=True)


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
    table: pl.DataFrame  # surface, estimator, `counts`, mean, median, p95, max (deg)


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


def pairs(run: Run) -> list[tuple[str, Pair]]:
    """Compare each two estimators by the errors of their proposed normals, as (label of the curve, pair).

    Each label is counted apart, since labels differ in kind; a single estimator has no pairs. Estimators that state
    the normals of different surfaces, fine and base, are no pair: they answer for different highlights.
    """
    true = run.results.filter(pl.col("true_id").is_not_null())
    names, targets = estimator_order(true["estimator"].drop_nulls().to_list()), targets_of(true)
    return [
        (str(label), pair)
        for (label,), part in side_by_side(true, targets).group_by("label", maintain_order=True)
        for pair in compare(distinct_frames(part), names)
        if targets[pair.first] == targets[pair.second]
    ]


HEADINGS = {name: field.title for name, field in Figures.model_fields.items() if field.title}


class TableRow(NamedTuple):
    """A row of the table."""

    setting: str
    estimator: str
    cells: list[tuple[str, float | None]]  # text and sort key, in the order of `HEADINGS`
    reasons: str  # of failures, counted


def table_rows(run: Run) -> list[TableRow]:
    """Return a row for each experiment, setting and estimator of summary.json."""
    rows = []
    for setting, estimator, figures in (row for experiment in run.experiments.values() for row in experiment.rows):
        reasons = {name: count for name, count in sorted(figures.n_failed_by_reason.items()) if count}
        cells = [_cell(getattr(figures, name)) for name in HEADINGS]
        rows.append(TableRow(setting, estimator, cells, ", ".join(f"{k} {n}" for k, n in reasons.items())))
    return rows


def _cell(value: float | dict[str, int] | tuple[float | None, float | None] | None) -> tuple[str, float | None]:
    if isinstance(value, tuple):
        low, high = value
        return ("–", None) if number(low) == "–" else (f"{number(low)} to {number(high)}", low)
    # Failures by reason count together.
    counted = sum(value.values()) if isinstance(value, dict) else value
    text = number(counted)
    return text, None if text == "–" else counted
