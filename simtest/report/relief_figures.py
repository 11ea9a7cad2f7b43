"""The figures of runs on a relief: errors against the fine surface and against its base, with law 7.4."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, log_range
from simtest.pages.style import NEUTRAL, degrees, estimator_order, number
from simtest.report.curves import bar, scattered, varies
from simtest.report.run_folder import Run
from simtest.report.series import axis_title
from simtest.runtime.arrays import Array
from simtest.spec.keys import name_key
from simtest.validation import laws

KD = "kd_base"
"""Distance times the base's principal curvature of larger size: what a swept radius is drawn over."""

LEVEL = "reflectance.film.level"

MOST = 10
"""Figures of a page."""

_TITLES = {
    KD: "curvature of the base times distance, k d",
    LEVEL: "level of the film (standard deviations of the height)",
}
_NAMES = {KD: "the base's curvature", LEVEL: "the film's level"}
_SEED = "surface.relief.seed"
_LAW_OVER_SLOPE = float(laws.relief_error(1.0))
_AGAINST = {"error_base_deg": "base", "error_fine_deg": "fine surface"}
_SYMBOLS = {"error_base_deg": "●", "error_fine_deg": "▲"}


@dataclass(frozen=True)
class ReliefFigure:
    """A figure, with what it shows and the numbers that it measured, a sentence each."""

    chart: Chart
    about: str
    measured: tuple[str, ...]
    caption: str = "Dashes are the law."


def relief_figures(run: Run, colours: Mapping[str, str]) -> list[ReliefFigure]:
    """Compute the figures of a run on a relief: over each swept quantity, and the errors' distribution.

    Returns none for runs on smooth surfaces, whose two errors are one.
    """
    if not {"error_fine_deg", "error_base_deg"} <= {*run.results.columns}:
        return []
    answered = pl.col("true_id").is_not_null() & (pl.col("status") == "ok")
    rows = run.results.filter(answered & pl.col("error_base_deg").is_not_null()).with_columns(
        larger_kd(run.results, "kd_min_base", "kd_max_base")
    )
    if (rows["error_base_deg"] - rows["error_fine_deg"]).abs().max() in (None, 0.0):
        return []
    figures = [_over(part, x, label, colours, _silent(run, x, label, part)) for x, label, part in sweeps(run, rows)]
    return [*figures[:MOST], *_distribution(rows, colours)]


def larger_kd(rows: pl.DataFrame, low: str, high: str) -> pl.Expr:
    """Return the column `KD` of two columns of curvatures; null in runs that do not state them."""
    if not {low, high} <= {*rows.columns}:
        return pl.lit(None, pl.Float64).alias(KD)
    return pl.when(pl.col(high).abs() >= pl.col(low).abs()).then(high).otherwise(low).alias(KD)


# Errors over one quantity --------------------------------------------------------------------------------------------


def sweeps(run: Run, rows: pl.DataFrame) -> Iterator[tuple[str, str, pl.DataFrame]]:
    """Yield the quantities on x with the labels that sweep them, and their rows; these have the column `KD`."""
    for (label,), part in rows.group_by("label", maintain_order=True):
        means = part.group_by("setting", maintain_order=True).agg(pl.col(KD).mean())
        is_bent = varies(means[KD]) and not scattered(part, KD)
        if is_bent:
            yield KD, str(label), part
        # What bends the base shows as its curvature.
        for name in (name for name in run.swept if name != _SEED):
            if part[name].drop_nulls().n_unique() > 1 and not (is_bent and _is_shape(name)):
                yield name, str(label), part.filter(pl.col(name).is_not_null())


def sweep_position(x: str) -> pl.Expr:
    """Return where each row's setting lies on x; rounded, since means of one value over more rows differ in bits."""
    return pl.col(x).mean().over("setting").round_sig_figs(12)


def sweep_axis(x: str) -> Axis:
    """Return the axis of a swept quantity."""
    return Axis(_TITLES.get(x) or axis_title(x))


def sweep_name(x: str) -> str:
    """Return the name of a swept quantity as it stands in titles."""
    return _NAMES.get(x) or name_key(x)


def sweep_key(start: str, x: str, label: str) -> str:
    """Return a figure's key."""
    return f"{start}_" + "".join(c if c.isalnum() else "_" for c in f"{x}_{label}")


def _is_shape(name: str) -> bool:
    return name.startswith("surface.") and not name.startswith("surface.relief.")


def _silent(run: Run, x: str, label: str, rows: pl.DataFrame) -> list[str]:
    """Return the settings of a sweep at which nothing was answered."""
    swept = pl.lit(True) if x == KD else pl.col(x).is_not_null()
    asked = run.results.filter((pl.col("label") == label) & swept)["setting"].unique(maintain_order=True)
    answered = set(rows["setting"])
    return [setting for setting in asked.to_list() if setting not in answered]


def _over(rows: pl.DataFrame, x: str, label: str, colours: Mapping[str, str], silent: Sequence[str]) -> ReliefFigure:
    """Describe mean errors over one quantity: colour is the estimator, the symbol is the truth, dashes are the law."""
    rows = rows.with_columns(at=sweep_position(x))
    axis = sweep_axis(x)
    marks, measured = [], []
    for name in estimator_order(rows["estimator"].to_list()):
        own = rows.filter(pl.col("estimator") == name)
        marks += [_curve(own, error, name, colours[name]) for error in _AGAINST]
        measured.append(_sentence(own, name))
    if silent:
        measured.append(f"Nothing was answered at: {'; '.join(silent)}.")
    dashes = _law(rows)
    y = Axis("mean angular error (deg)", "log", log_range(_reached([*dashes, *marks])))
    what = sweep_name(x)
    keys = tuple(Mark(NOTHING, NOTHING, NEUTRAL, f"against the {_AGAINST[e]}", symbol=s) for e, s in _SYMBOLS.items())
    chart = Chart(sweep_key("relief", x, label), f"Relief: error against {what}, {label}",
                  (Panel(axis, y, (*dashes, *marks)),), 440, keys)  # fmt: skip
    about = (
        f"The mean angle between the proposed normal and the true one against {what}: of the fine surface at the "
        "highlight's own point, and of the base below it at the same point."
    )
    caption = (
        "Points are means over the highlights of a setting, bars their 95 % interval (over frames); "
        "dashes are the law of all glints of a cloud wholly in view; isolated ones lie lower."
    )
    return ReliefFigure(chart, about, tuple(measured), caption)


def _reached(marks: Sequence[Mark]) -> list[npt.ArrayLike]:
    """Return all values that marks and the upper ends of their bars reach."""
    return [*(mark.y for mark in marks), *(mark.bars.high for mark in marks if mark.bars)]


def _law(rows: pl.DataFrame) -> list[Mark]:
    """Describe the law over a quantity, straight between the settings; nothing where it does not hold."""
    told = rows.filter(pl.col("error_base_law_deg").is_not_null())
    law = told.group_by("at").agg(pl.col("error_base_law_deg").mean()).sort("at")
    if law.is_empty():
        return []
    # In many steps: a straight line is bent on the logarithmic axis.
    at = np.linspace(law["at"].min(), law["at"].max(), 121)  # type: ignore[arg-type]
    values = np.interp(at, law["at"].to_numpy(), law["error_base_law_deg"].to_numpy())
    hover = "law of all glints of a cloud\n{x}: {y}"
    return [Mark(at, values, NEUTRAL, "law: 1.25 slopes", line="dash", width=1.5, hover=hover)]


def _curve(rows: pl.DataFrame, error: str, name: str, colour: str) -> Mark:
    """Describe the means of one estimator against one truth, with their intervals."""
    groups = [(float(at), part) for (at,), part in rows.group_by("at")]
    mark = mean_mark(groups, error, colour, name, _SYMBOLS[error], f"{name}, against the {_AGAINST[error]}", degrees)
    return replace(mark, line="solid" if error == "error_base_deg" else "dot")


def mean_mark(
    groups: list[tuple[float, pl.DataFrame]], value: str, colour: str, name: str, symbol: str, about: str = "",
    told: Callable[[float], str] = number,
) -> Mark:  # fmt: skip
    """Describe the means of a column of rows by x, with their intervals over frames; rows without a value are none."""
    valued = [(x, rows.drop_nulls(value)) for x, rows in groups]
    groups = sorted(((x, rows) for x, rows in valued if rows.height), key=lambda group: group[0])
    means = [float(rows[value].mean()) for _, rows in groups]  # type: ignore[arg-type]
    low, high = np.array([bar(rows, value) for _, rows in groups]).reshape(-1, 2).T
    hover = [
        f"{about or name}\nx = {number(x)}, mean {told(mean)} of {rows.height}"
        for (x, rows), mean in zip(groups, means, strict=True)
    ]
    return Mark(np.array([x for x, _ in groups]), np.array(means), colour, name, width=0.9, symbol=symbol,
                bars=Bars(low, high, 1.2), hover=hover)  # fmt: skip


def _sentence(rows: pl.DataFrame, name: str) -> str:
    """State what one estimator's rows measure."""
    fine, base = rows["error_fine_deg"].mean(), rows["error_base_deg"].mean()
    text = f"{name}: {degrees(fine)} against the fine surface, {degrees(base)} against the base"
    told = rows.filter(pl.col("error_base_law_deg").is_not_null())
    share = (told["error_base_deg"] / told["error_base_law_deg"]).mean()
    return text + (f", {number(share)} of the law" if share is not None else "") + f" ({rows.height} highlights)."


# Distribution --------------------------------------------------------------------------------------------------------


def _distribution(rows: pl.DataFrame, colours: Mapping[str, str]) -> Iterator[ReliefFigure]:
    """Describe the shares of highlights whose error against the base is below so many slopes, with Rayleigh's."""
    rows = rows.filter(pl.col("error_base_law_deg") > 0)
    if rows.is_empty():
        return
    rows = rows.with_columns(share=pl.col("error_base_deg") / pl.col("error_base_law_deg") * _LAW_OVER_SLOPE)
    marks, measured = [], []
    for name in estimator_order(rows["estimator"].to_list()):
        values = np.sort(rows.filter(pl.col("estimator") == name)["share"].to_numpy())
        steps = np.arange(1, len(values) + 1) / len(values)
        marks.append(Mark(values, steps, colours[name], name, line="solid", width=1.6, hover=f"{name}\n{{x}}: {{y}}"))
        measured.append(
            f"{name}: mean {number(values.mean())} slopes over {len(values)} highlights (law {_LAW_OVER_SLOPE:.3g}), "
            f"largest distance from Rayleigh {number(_largest_gap(values))}."
        )
    fine = np.linspace(0, 4, 161)
    law = Mark(fine, laws.relief_error_share(fine, 1.0), NEUTRAL, "law: Rayleigh", line="dash", width=1.5,
               hover="Rayleigh\n{x}: {y}")  # fmt: skip
    panel = Panel(Axis("error against the base over the relief's slope", limits=(0.0, 4.0)),
                  Axis("share of highlights below", limits=(0.0, 1.02)), (law, *marks))  # fmt: skip
    about = (
        "How many highlights miss the base's normal by less than so many slopes of the relief, over all settings, with "
        "the distribution of all glints of a cloud, wholly in view. Isolated highlights are fewer than the glints, and "
        "lie nearer to the base's own highlight; spots that hold several glints or none lie farther."
    )
    yield ReliefFigure(Chart("relief_distribution", "Relief: errors against the base over the slope", (panel,), 440),
                       about, tuple(measured))  # fmt: skip


def _largest_gap(values: Array) -> float:
    """Compute the Kolmogorov-Smirnov distance of sorted errors over the slope from Rayleigh's distribution."""
    expected, count = laws.relief_error_share(values, 1.0), len(values)
    above, below = np.arange(1, count + 1) / count - expected, expected - np.arange(count) / count
    return float(max(above.max(), below.max()))
