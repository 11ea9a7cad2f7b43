"""The figures of curves: means with intervals and laws over one quantity, as charts."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import polars as pl

from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, curvature_axis, label_keys, log_range
from simtest.pages.style import NEUTRAL, estimator_order, number, symbols
from simtest.report.curves import Ask, Curve, gather, prepared, varies
from simtest.report.run_folder import Run
from simtest.spec.keys import describe_key, name_key

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
