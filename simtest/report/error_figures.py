"""Errors over one quantity and over two: means with intervals, the law predicted for them, curves and heat maps."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
import polars as pl

from simtest.conventions import CIRCLE_POSE_ISOVALUE
from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, curvature_axis, finite, label_keys, log_range
from simtest.pages.style import NEUTRAL, estimator_order, hexadecimal, number, symbols
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import mean_interval
from simtest.spec.keys import describe_key, name_key
from simtest.validation import laws
from simtest.validation.statistics import units

_BINS = 12
_PHONG_EXPONENT = 50.0
_ENDS = {"estimator": pl.String, "group": pl.String, "low": pl.Float64, "high": pl.Float64}


@dataclass(frozen=True)
class Curve:
    """One curve: the means of one estimator on one label, with the law that was predicted for them."""

    estimator: str  # what the colour stands for
    label: str  # what the symbol stands for
    x: Array  # of each setting, shape (n,)
    y: Array  # mean
    low: Array  # 95 % interval of the mean; NaN for a single frame
    high: Array
    law_at: Array  # the law's mean prediction at each point; NaN where there is none
    law_x: Array  # the law as a line, shape (m,); empty where there is none
    law_y: Array
    names: tuple[str, ...]  # setting of each point
    counts: tuple[str, ...]  # "values of rows" at each point
    joined: bool  # whether the points follow one sweep; false for bins over many highlights


@dataclass(frozen=True)
class Ask:
    """What to gather: the quantity on x, its companion that must be held, the value and its law."""

    x: str
    value: str
    law: str
    hold: str | None = None
    at: str = "setting"  # column of the points' names: settings, or what several settings share


def prepared(run: Run) -> pl.DataFrame:
    """Return the rows of true highlights, with `kd` (the principal k d of larger size) and `kd_other`."""
    larger = pl.col("kd_max").abs() >= pl.col("kd_min").abs()
    return run.results.filter(pl.col("true_id").is_not_null()).with_columns(
        kd=pl.when(larger).then("kd_max").otherwise("kd_min"),
        kd_other=pl.when(larger).then("kd_min").otherwise("kd_max"),
        ok=(pl.col("status") == "ok").fill_null(False),
    )


def varies(values: pl.Series) -> bool:
    """Whether per-setting means differ by more than a tenth of the largest (and more than 5e-4)."""
    values = values.drop_nulls()
    if values.len() < 2:
        return False
    spread = float(values.max() - values.min())  # type: ignore[operator, arg-type]
    return spread > max(5e-4, 0.1 * float(values.abs().max()))  # type: ignore[arg-type]


def scattered(rows: pl.DataFrame, x: str) -> bool:
    """Whether a quantity changes so much within one setting that rows must be binned by it instead."""
    if rows.is_empty():
        return False
    spread = rows.group_by("setting").agg((pl.col(x).max() - pl.col(x).min()).alias("spread"))["spread"].max()
    size = rows[x].abs().max()
    return bool(spread is not None and size is not None and spread > max(0.02, 0.5 * size))  # type: ignore[operator]


def slices(rows: pl.DataFrame, x: str, hold: str | None) -> Iterator[tuple[str, pl.DataFrame, bool]]:
    """Yield, for each label that sweeps x, its rows and whether they are to be binned.

    Where the other quantity is swept as well (a grid), only the settings at its smallest size remain.
    """
    quantities = [x, hold] if hold else [x]
    for (label,), part in rows.filter(pl.col(x).is_not_null()).group_by("label", maintain_order=True):
        is_scattered = scattered(part, x)
        means = part.group_by("setting", maintain_order=True).agg(pl.col(quantities).mean())
        if not is_scattered and not varies(means[x]):
            continue
        if hold and not is_scattered and not scattered(part, hold) and varies(means[hold]):
            size = means[hold].abs()
            near = size <= float(size.min() or 0.0) + max(1e-6, 0.05 * float(size.max() or 0.0))  # type: ignore[arg-type]
            kept = means.filter(near)
            if not varies(kept[x]):
                continue
            part = part.filter(pl.col("setting").is_in(kept["setting"].to_list()))
        yield str(label), part, is_scattered


def _aggregate(rows: pl.DataFrame, ask: Ask, is_scattered: bool) -> pl.DataFrame:
    rank = pl.col(ask.x).rank("dense") - 1
    group = (rank * _BINS // (rank.max() + 1)).cast(pl.String) if is_scattered else pl.col(ask.at)
    exponent = pl.col("reflectance.exponent") if "reflectance.exponent" in rows.columns else pl.lit(None)
    is_answer = pl.col("ok") & pl.col(ask.value).is_not_null()
    values = pl.col(ask.value).filter(is_answer)
    rows, keys = rows.with_columns(group=group, exponent=exponent.cast(pl.Float64)), ("estimator", "group")
    ends = [(*key, *bar(part, ask.value)) for key, part in rows.filter(is_answer).group_by(keys)]
    return (
        rows.group_by(keys, maintain_order=True)
        .agg(
            x=pl.col(ask.x).mean(), kd=pl.col("kd").mean(), kd_other=pl.col("kd_other").mean(),
            y=values.mean(), n=values.len(), rows=pl.len(),
            law=pl.col(ask.law).mean(), isovalue=pl.col("isovalue").median(), exponent=pl.col("exponent").mean(),
        )
        .join(pl.DataFrame(ends, _ENDS, orient="row"), on=keys, how="left")
        .sort("x", maintain_order=True)
    )  # fmt: skip


def bar(rows: pl.DataFrame, value: str) -> tuple[float, float]:
    """Return the 95 % interval of the mean of a column over frames, cut at the least value seen; NaN for one frame."""
    values = rows[value].to_numpy().astype(float)
    low, high = mean_interval(values, *units(rows))
    # An interval that reaches 0 is cut: axes may be logarithmic.
    return (math.nan, math.nan) if low is None or high is None else (max(low, float(values.min())), high)


def gather(rows: pl.DataFrame, ask: Ask, axis: Axis) -> tuple[list[Curve], list[str]]:
    """Gather the curves of a figure, and the settings and bins that have no value."""
    curves, empty = [], []
    for label, part, is_scattered in slices(rows, ask.x, ask.hold):
        table = _aggregate(part, ask, is_scattered)
        for name in estimator_order(table["estimator"].to_list()):
            own = table.filter(pl.col("estimator") == name)
            without = own.filter(pl.col("n") == 0)
            missing = [f"bin around {x:.2g}" for x in without["x"]] if is_scattered else without["group"].to_list()
            empty += [f"{name}, {where}" for where in missing]
            law_x, law_y = _law_line(own, ask, name, axis, is_scattered)
            own = own.filter(pl.col("n") > 0)
            if own.is_empty():
                continue
            curves.append(
                Curve(
                    name, label, _array(own["x"]), _array(own["y"]), _array(own["low"]), _array(own["high"]),
                    _array(own["law"]), law_x, law_y,
                    tuple("bin of highlights" if is_scattered else str(g) for g in own["group"]),
                    tuple(f"{n} of {m}" for n, m in zip(own["n"], own["rows"], strict=True)), not is_scattered,
                )
            )  # fmt: skip
    return curves, empty


def _array(values: pl.Series) -> Array:
    return values.cast(pl.Float64).to_numpy().astype(float)


def _law_line(table: pl.DataFrame, ask: Ask, estimator: str, axis: Axis, is_scattered: bool) -> tuple[Array, Array]:
    """Draw the closed form between the settings where it agrees with the rows' own law, else join the latter."""
    table = table.filter(pl.col("law").is_not_null() & pl.col("x").is_not_null())
    nothing = np.empty(0)
    if table.is_empty():
        return nothing, nothing
    x, law = _array(table["x"]), _array(table["law"])
    kd, other = _array(table["kd"]), _array(table["kd_other"])

    def closed_form(at_x: Array, at_kd: Array, at_other: Array) -> Array | None:
        low, high = np.minimum(at_kd, at_other), np.maximum(at_kd, at_other)
        if ask.value == "axis_ratio":
            return laws.axis_ratio(low, high)
        if ask.x == "eps_over_d" and estimator != "circle_pose":
            return np.degrees(laws.offset_error(at_x))
        if ask.x == "kd" and estimator == "circle_pose":
            isovalue = table["isovalue"].median() or CIRCLE_POSE_ISOVALUE
            lobe = 4 * (table["exponent"].mean() or _PHONG_EXPONENT)  # type: ignore[operator]
            return np.degrees(laws.circle_pose_error(*laws.isophote_half_axes(isovalue, lobe, low, high)))  # type: ignore[arg-type]
        return None

    at_points = closed_form(x, kd, other)
    margin = 0.01 if ask.value == "axis_ratio" else 0.05
    agrees = at_points is not None and bool(np.all(np.abs(at_points - law) <= margin + 0.01 * np.abs(law)))
    if is_scattered or not agrees or x.size < 2 or np.ptp(axis.to_axis(x)) == 0:
        return x, law
    # Evenly spaced on the axis, and through the settings themselves.
    at = axis.to_axis(x)
    fine = axis.from_axis(np.unique(np.concatenate([np.linspace(at.min(), at.max(), 120), at])))
    line = closed_form(fine, np.interp(fine, x, kd), np.interp(fine, x, other))
    return fine, np.asarray(line)


# A law is met within 0.3 deg or 3 %, whichever is larger (theory.md section 4).
TOLERANCE_DEG, TOLERANCE_SHARE = 0.3, 0.03
MOST_TITLE = 70  # characters of a description that fit under an axis
_ERROR_TITLE = "angular error (deg)"
_DASH = "–"
LEAST_LAW = 0.01  # a law below this (deg, or axis ratio) predicts nothing that noise would leave visible


@dataclass(frozen=True)
class LineFigure:
    """A figure of curves over one quantity."""

    key: str
    title: str
    about: str
    x: Axis
    y: Axis
    curves: tuple[Curve, ...]
    empty: tuple[str, ...] = ()
    shared_law: bool = False

    @property
    def unit(self) -> str:
        """Unit of y, as it stands behind a number."""
        return "" if self.shared_law else "°"

    @property
    def rule(self) -> str:
        """Within what a law is met."""
        return "3 %" if self.shared_law else "0.3° or 3 %"

    @property
    def binned(self) -> bool:
        """Whether some points are bins of highlights."""
        return not all(curve.joined for curve in self.curves)

    @property
    def estimators(self) -> list[str]:
        """Estimators in the report's order."""
        return estimator_order(curve.estimator for curve in self.curves)


def line_figures(run: Run) -> list[LineFigure]:
    """Compute the figures of curves for which the run has data.

    Their keys are error_vs_curvature, axis_ratio, error_vs_offset, and error_vs_<parameter> for other swept parameters.
    """
    rows = prepared(run)
    kd = "curvature times distance, k d"
    measures = rows.filter(pl.col("axis_ratio").is_not_null())["estimator"].unique().to_list()
    error = Axis(_ERROR_TITLE, "log")
    wanted = [
        ("error_vs_curvature", "Error against curvature", curvature_axis(rows["kd"].to_numpy(), kd), error,
         Ask("kd", "error_oracle_deg", "error_law_deg", "eps_over_d"),
         "The mean angle between the better candidate and the true normal against distance times the principal "
         "curvature of larger size (convex positive), with the error law as a line."),
        ("axis_ratio", "Axis ratio against curvature", curvature_axis(rows["kd"].to_numpy(), kd),
         Axis("axis ratio of the isophotes", "linear", (0.0, 1.05)),
         Ask("kd", "axis_ratio", "axis_ratio_law", "eps_over_d"),
         "The mean axis ratio of the isophotes against distance times the principal curvature of larger size, with its "
         "law, the smaller over the larger |1 + d k|, as a line."),
        ("error_vs_offset", "Error against light offset", Axis("light offset over distance, ε/d"), error,
         Ask("eps_over_d", "error_oracle_deg", "error_law_deg", "kd"),
         "The mean angle between the better candidate and the true normal against the light's offset from the camera "
         "over distance, with the law of half the angle between light and camera, about atan(ε/d)/2, as a line."),
    ]  # fmt: skip
    figures = []
    for key, title, x, y, ask, about in wanted:
        shared = ask.value == "axis_ratio"
        curves, empty = gather(rows.filter(pl.col("estimator").is_in(measures)) if shared else rows, ask, x)
        if curves:
            figures.append(LineFigure(key, title, about, x, y, tuple(curves), tuple(empty), shared))
    return figures + _sweep_figures(run, rows)


def _sweep_figures(run: Run, rows: pl.DataFrame, most: int = 8) -> list[LineFigure]:
    """Compute error against each swept parameter whose values do not already show as curvature or offset."""
    figures: list[LineFigure] = []
    # Sweeps of the published protocol have figures of their own.
    for name in (name for name in run.swept if not name.startswith("paper.")):
        if len(figures) == most:
            break
        kept = []
        for _, part in rows.filter(pl.col(name).is_not_null()).group_by("label", maintain_order=True):
            means = part.group_by(name).agg(pl.col("kd").mean(), pl.col("eps_over_d").mean())
            if means.height > 1 and not varies(means["kd"]) and not varies(means["eps_over_d"]):
                kept.append(part)
        if not kept:
            continue
        part = pl.concat(kept).with_columns(pl.col(name).cast(pl.Float64))
        # A point may pool several settings: these stay the strata of its interval.
        part = part.with_columns(point=pl.lit(f"{name} = ") + pl.col(name).cast(pl.String))
        x = Axis(axis_title(name))
        curves, empty = gather(part, Ask(name, "error_oracle_deg", "error_law_deg", at="point"), x)
        if curves:
            slug = "".join(c if c.isalnum() else "_" for c in name)
            meaning = f" ({text})" if (text := describe_key(name)) else ""
            about = f"The mean angle between the better candidate and the true normal against {name}{meaning}."
            title = f"Error against {name_key(name)}"
            y = Axis(_ERROR_TITLE, "log")
            figures.append(LineFigure(f"error_vs_{slug}", title, about, x, y, tuple(curves), tuple(empty)))
    return figures


def axis_title(name: str) -> str:
    """Return a swept parameter's name with its unit, or with the start of its description where it has none."""
    short, meaning = name_key(name), describe_key(name).split(";")[0]
    return short if short.endswith(")") or not meaning or len(meaning) > MOST_TITLE else f"{short}: {meaning}"


class LawMiss(NamedTuple):
    """Points that meet their law, of how many; the largest departure, and its setting."""

    met: int
    total: int
    worst: float
    where: str


def law_misses(figure: LineFigure) -> dict[str, LawMiss]:
    """Count, by estimator, the points of sweeps that meet their law: errors in degrees, axis ratios by 3 % alone.

    Left out are means over many highlights of unlike curvature, and points where the law is 0: there the noise decides.
    """
    result: dict[str, LawMiss] = {}
    floor = 0.0 if figure.shared_law else TOLERANCE_DEG
    for name in figure.estimators:
        gaps: list[tuple[float, bool, str]] = []
        for curve in (c for c in figure.curves if c.estimator == name and c.joined):
            for y, law, where in zip(curve.y, curve.law_at, curve.names, strict=True):
                if np.isfinite(law) and law > LEAST_LAW:
                    gap = float(abs(y - law))
                    gaps.append((gap, bool(gap <= max(floor, TOLERANCE_SHARE * law)), where))
        if gaps:
            worst, _, where = max(gaps)
            result[name] = LawMiss(sum(met for _, met, _ in gaps), len(gaps), worst, where)
    return result


def line_chart(data: LineFigure, colours: Mapping[str, str]) -> Chart:
    """Describe a figure of curves: colour is the estimator, the symbol is the label, dashes are the law."""
    shapes = symbols(curve.label for curve in data.curves)
    laws = [_law_mark(data, curve, colours) for curve in data.curves if _has_law(curve, data.y)]
    joins = [_join_mark(curve, colours) for curve in data.curves if curve.joined and not _has_law(curve, data.y)]
    marks = [*laws, *joins, *(_points_mark(data, curve, colours, shapes[curve.label]) for curve in data.curves)]
    if laws:
        marks.append(Mark(NOTHING, NOTHING, NEUTRAL, "law", line="dash", width=1.5))
    # Laws may leave the range of what was measured.
    limits = log_range([part for c in data.curves for part in (c.y, c.low, c.high)])
    y = replace(data.y, limits=limits) if data.y.scale == "log" else data.y
    return Chart(data.key, data.title, (Panel(data.x, y, tuple(marks)),), 460, label_keys(shapes))


def _has_law(curve: Curve, axis: Axis) -> bool:
    """Whether a curve's law shows: a law of zero is nowhere on a logarithmic axis."""
    return bool(np.isfinite(axis.visible(curve.law_y)).any())


def _law_mark(data: LineFigure, curve: Curve, colours: Mapping[str, str]) -> Mark:
    return Mark(
        curve.law_x, curve.law_y, NEUTRAL if data.shared_law else colours[curve.estimator], curve.estimator,
        listed=False, line="dash" if curve.joined else "", width=1.5, symbol="" if curve.joined else _DASH, size=9,
        hover=f"law, {curve.label}\n{{x}}: {{y}}",
    )  # fmt: skip


def _join_mark(curve: Curve, colours: Mapping[str, str]) -> Mark:
    """Join the points of a sweep, where no law runs between them.

    A gap stands where x changes sign or leaves 0: convex and concave, with and without an offset or noise are unlike.
    """
    gaps = np.flatnonzero(np.diff(np.sign(curve.x))) + 1
    x, y = (np.insert(values.astype(float), gaps, np.nan) for values in (curve.x, curve.y))
    return Mark(x, y, colours[curve.estimator], curve.estimator, listed=False, line="solid", width=0.7)


def _points_mark(data: LineFigure, curve: Curve, colours: Mapping[str, str], symbol: str) -> Mark:
    columns = (curve.names, curve.x, curve.y, curve.low, curve.high, curve.law_at, curve.counts)
    hover = [
        f"{curve.estimator}, {curve.label}\n{name}\nx = {number(x)}, mean {number(y)}{data.unit} "
        f"[{number(low)}, {number(high)}]\nlaw {number(law)}, {count} rows"
        for name, x, y, low, high, law, count in zip(*columns, strict=True)
    ]
    return Mark(
        curve.x, curve.y, colours[curve.estimator], curve.estimator, symbol=symbol,
        bars=Bars(curve.low, curve.high, 1.2), hover=hover,
    )  # fmt: skip


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
