"""Curves: rows gathered by setting, means with intervals, and the law predicted for them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.conventions import CIRCLE_POSE_ISOVALUE
from simtest.pages.charts import Axis
from simtest.pages.style import estimator_order
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import mean_interval
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
