"""Error plots of the published protocol: its parameters, errors by setting, the bound, the predicted bias, charts."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import polars as pl

from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, finite
from simtest.pages.style import NEUTRAL, degrees, estimator_order, number, symbols
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.spec.recipes import PaperSetting

PREFIX = "paper."


@dataclass(frozen=True)
class Parameter:
    """How a parameter is written."""

    name: str  # its name in `PaperSetting`
    symbol: str
    words: str
    unit: str = ""
    factor: float = 1.0  # shown value over the value in the rows
    about: str = ""  # what its sweep means

    @property
    def axis_title(self) -> str:
        """Title of the axis, with symbol and unit."""
        return f"{self.words} {self.symbol}" + (f" ({self.unit})" if self.unit else "")

    def text(self, value: object) -> str:
        """Write a value of the rows with symbol and unit."""
        if self.name == "recentre":
            return "window at the BP" if value else "window at the foot"
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{self.symbol}\u00a0=\u00a0{value}"
        unit = {"%": "\u00a0%", "deg": "°", "px": "\u00a0px"}.get(self.unit.split(" ")[0], "")
        return f"{self.symbol}\u00a0=\u00a0{value * self.factor:.6g}{unit}"


_KNOWN = (
    Parameter(
        "sigma", "σ", "noise", "% of the noise-free peak", 100.0,
        "More noise on the camera's picture. What is left at σ = 0 is the smoothing's bias, and noise adds to it; the "
        "bound, which knows no bias, starts at 0, and an estimator with a bias may fall below it.",
    ),
    Parameter(
        "theta_deg", "θ", "slant", "deg", 1.0,
        "The plane turned away from the camera. Towards θ = 0 the circle is seen as a circle: circle pose is at its "
        "branch point, where a relative axis error δ already tilts the normal by √(2δ), so this rise belongs to the "
        "model. Towards 90° the picture of the texture is a few pixels high, its window cuts the isophote and the "
        "realisations fail: this is truncation, not the model.",
    ),
    Parameter(
        "exponent", "n", "roughness exponent", "", 1.0,
        "A glossier plane has a smaller highlight: fewer pixels carry the isophote, and the same smoothing is a larger "
        "share of it.",
    ),
    Parameter(
        "isovalue", "t", "isovalue", "share of the smoothed peak", 1.0,
        "Where the isophote is taken. A low one is wide but faint: noise moves it far, and below the brightness at the "
        "edge of the texture's window it does not close, which is truncation and counted as failures. A high one is "
        "small and lies where the lobe is flat.",
    ),
    Parameter(
        "eps", "ε", "light offset", "texture units", 1.0,
        "The light beside the camera: the isophote is no circle any more, and what grows with ε is the model's error. "
        "With the texture's window centred at the brightest point the isophote stays inside; with the window left at "
        "the camera's foot it runs out of it: the failures and the steep rise are truncation, not the model.",
    ),
    Parameter(
        "smoothing_px", "s", "smoothing width", "px", 1.0,
        "The width of the smoothing, which the article does not state. A narrow one leaves noise, a wide one rounds "
        "the ellipse: its bias grows with s² and is the floor that no number of realisations removes.",
    ),
    Parameter("size", "M", "picture and texture side", "px"),
    Parameter("height", "V_Z", "camera height", "texture units"),
    Parameter("recentre", "", "place of the window"),
)  # fmt: skip

PARAMETERS = {parameter.name: parameter for parameter in _KNOWN}  # by name; every field of `PaperSetting` has one
DEFAULTS = PaperSetting().model_dump()  # the article's defaults by name


Value = float | bool | None  # what a row holds of a parameter
_FEWEST = 2
_LEAST_LAW_DEG = 1e-3  # a smaller prediction is none


@dataclass(frozen=True)
class Sweep:
    """One estimator's errors over one parameter, all else fixed; the better candidate's error, deg."""

    parameter: Parameter  # what is swept
    estimator: str
    label: str  # of the group of settings
    fixed: Mapping[str, Value]  # the other parameters' values by name
    x: Array  # values of the parameter, ascending, as in the rows; shape (n,), as all that follow
    mean: Array  # over the answered realisations; NaN where there is none
    std: Array  # NaN where there is none or one
    least: Array
    largest: Array
    answered: Array  # realisations
    failed: Array
    reasons: tuple[str, ...]  # of the failures, with their counts
    bound: Array  # Cramer-Rao bound (RMS angle), deg; NaN where there is none
    law: Array  # predicted error without noise, deg; NaN where there is none

    @property
    def shown_x(self) -> Array:
        """Values of the parameter in the unit of the axis."""
        return self.x * self.parameter.factor

    @property
    def measured(self) -> str:
        """The measured numbers in words."""
        known, other = np.isfinite(self.mean), departures(self.fixed)
        text = f"{self.estimator}, {self.label}" + (f" ({other}): " if other else ": ")
        if known.any():
            low, high, largest = np.nanmin(self.mean), np.nanmax(self.mean), np.nanmax(self.largest)
            text += f"means from {degrees(float(low))} to {degrees(float(high))}, single errors up to "
            text += degrees(float(largest))
        else:
            text += "no answer"
        failing = [
            f"{self.parameter.text(float(x))}: {failed:.0f} of {failed + answered:.0f} ({reasons})"
            for x, failed, answered, reasons in zip(self.x, self.failed, self.answered, self.reasons, strict=True)
            if failed
        ]
        text += f"; failures at {', '.join(failing)}" if failing else "; no failures"
        wide = known & np.isfinite(self.law) & (self.law > _LEAST_LAW_DEG)
        if self.fixed.get("sigma") == 0 and wide.any():
            ratio = self.mean[wide] / self.law[wide]
            text += f"; measured over predicted bias {number(float(ratio.min()))} to {number(float(ratio.max()))}"
        return text + "."

    @property
    def standard_error(self) -> Array:
        """Standard error of each mean; NaN where a setting has fewer than two answers."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.std / np.sqrt(self.answered))


@dataclass(frozen=True)
class SweepFigure:
    """An error plot: all sweeps over one parameter."""

    parameter: Parameter
    sweeps: tuple[Sweep, ...]

    @property
    def key(self) -> str:
        """Name of the figure's files."""
        return f"error_vs_paper_{self.parameter.name}"

    @property
    def title(self) -> str:
        """Title of the figure."""
        return f"Error against {self.parameter.words} {self.parameter.symbol}"

    @property
    def bounds(self) -> list[Sweep]:
        """The sweeps whose Cramer-Rao bound is drawn: one a label, where it is not 0 everywhere."""
        seen: dict[str, Sweep] = {}
        for sweep in self.sweeps:
            if np.isfinite(sweep.bound).sum() > 1 and np.nanmax(sweep.bound) > 0:
                seen.setdefault(sweep.label, sweep)
        return list(seen.values())

    @property
    def laws(self) -> list[tuple[int, Sweep]]:
        """The sweeps whose law is drawn, with their indices: it is known at two settings, not 0 everywhere."""
        known = [(i, sweep) for i, sweep in enumerate(self.sweeps) if np.isfinite(sweep.law).sum() > 1]
        return [(i, sweep) for i, sweep in known if np.nanmax(sweep.law) > _LEAST_LAW_DEG]


def is_published(run: Run) -> bool:
    """Whether a run has rows of the published protocol."""
    return any(name.startswith(PREFIX) for name in run.results.columns)


def sweep_figures(run: Run) -> list[SweepFigure]:
    """Return the error plots of a run, one for each swept parameter, in the article's order.

    A run without rows of the published protocol has none.
    """
    found = list(_sweeps(run)) if is_published(run) else []
    figures = []
    for parameter in PARAMETERS.values():
        own = tuple(sweep for sweep in found if sweep.parameter == parameter)
        if own:
            figures.append(SweepFigure(parameter, own))
    return figures


def _sweeps(run: Run) -> Iterator[Sweep]:
    columns = [name for name in run.results.columns if name.startswith(PREFIX) and name[len(PREFIX) :] in PARAMETERS]
    rows = run.results.filter(pl.any_horizontal(pl.col(columns).is_not_null()))
    for (label,), part in rows.group_by("label", maintain_order=True):
        swept = [name for name in columns if part[name].drop_nulls().n_unique() >= _FEWEST]
        for name in swept:
            others = [other for other in swept if other != name]
            pieces = part.partition_by(others, maintain_order=True) if others else [part]
            kept = [piece for piece in pieces if piece[name].n_unique() >= _FEWEST]
            for piece in kept:
                held = {c[len(PREFIX) :]: piece[c].drop_nulls().first() for c in columns if c != name}
                fixed = cast(Mapping[str, Value], held)
                more = [PARAMETERS[other[len(PREFIX) :]].text(fixed[other[len(PREFIX) :]]) for other in others]
                for estimator in estimator_order(piece["estimator"].unique().to_list()):
                    own = piece.filter(pl.col("estimator") == estimator)
                    yield _sweep(own, name, estimator, ", ".join([str(label), *more]), fixed)


def _sweep(rows: pl.DataFrame, column: str, estimator: str, label: str, fixed: Mapping[str, Value]) -> Sweep:
    ok = (pl.col("status") == "ok") & pl.col("error_oracle_deg").is_not_null()
    error = pl.col("error_oracle_deg").filter(ok)
    bound = pl.col("bound_deg") if "bound_deg" in rows.columns else pl.lit(None, pl.Float64)
    table = (
        rows.filter(pl.col(column).is_not_null())
        .with_columns(bound=bound)
        .group_by(pl.col(column).cast(pl.Float64).alias("x"))
        .agg(
            mean=error.mean(), std=error.std(), least=error.min(), largest=error.max(), answered=error.len(),
            total=pl.len(), bound=pl.col("bound").first(), law=pl.col("error_law_deg").drop_nulls().first(),
            reasons=pl.col("status").filter(~ok.fill_null(False)).fill_null("unknown"),
        )
        .sort("x")
    )  # fmt: skip
    values = {
        name: table[name].cast(pl.Float64).to_numpy().astype(float)
        for name in ("x", "mean", "std", "least", "largest", "bound", "law")
    }
    # The mean of equal errors may lie a rounding outside of them.
    values["mean"] = np.clip(values["mean"], values["least"], values["largest"])
    answered = table["answered"].to_numpy().astype(float)
    reasons = tuple(_counted(list(entry)) for entry in table["reasons"].to_list())
    failed = table["total"].to_numpy().astype(float) - answered
    parameter = PARAMETERS[column[len(PREFIX) :]]
    return Sweep(parameter, estimator, label, fixed, answered=answered, failed=failed, reasons=reasons, **values)


def _counted(reasons: list[str]) -> str:
    return ", ".join(f"{name} {reasons.count(name)}" for name in sorted(set(reasons)))


def departures(fixed: Mapping[str, Value]) -> str:
    """Write the fixed parameters that are not the article's defaults; empty where all are."""
    return ", ".join(
        PARAMETERS[name].text(value)
        for name, value in fixed.items()
        if value is not None and value != DEFAULTS[name]
    )  # fmt: skip


BOUND_NAME = "Cramér-Rao bound (an RMS angle)"
LAW_NAME = "predicted bias of the smoothing, no noise"
_BOUND_COLOUR, _FAILED_COLOUR = "#8A6D00", "#D03030"
_WIDE = 20.0  # means that span more than this factor are drawn on a logarithmic axis
_STD_PX, _SHARE = 6.0, 0.2  # width of the standard deviation's bars, and the failures' strip over the panel above it

_KEYS = (
    Mark(NOTHING, NOTHING, NEUTRAL, "± standard deviation", symbol="▮", size=13, width=_STD_PX),
    Mark(NOTHING, NOTHING, NEUTRAL, "least and largest error", symbol="|", size=13, width=1.0),
)

_CLOSE, _STAGGER = 0.09, 0.24
"""Failures of settings nearer than this share of the axis stand in two heights, so that narrow pages part them."""


def sweep_chart(data: SweepFigure, colours: Mapping[str, str]) -> Chart:
    """Describe an error plot and its strip of failures."""
    shapes = symbols(sweep.label for sweep in data.sweeps)
    x, y = _axes(data)
    floor = y.limits[0] if y.limits else 0.0
    shifted = _shifted(data, x)
    marks, strip = [], []
    for index, sweep in enumerate(data.sweeps):
        colour, symbol = colours[sweep.estimator], shapes[sweep.label]
        marks += _means(sweep, shifted[index], colour, symbol, floor)
        strip += _failures(data, index, x, colour, symbol)
    for sweep in data.bounds:
        told = f"{BOUND_NAME}\n{sweep.label}: {{y}}°"
        marks.append(Mark(sweep.shown_x, sweep.bound, _BOUND_COLOUR, BOUND_NAME, line="dashdot", hover=told))
    for index, sweep in data.laws:
        told = f"{LAW_NAME}\n{sweep.label}: {{y}}°"
        marks.append(Mark(shifted[index], sweep.law, NEUTRAL, LAW_NAME, line="dash", hover=told))
    rows = len(data.sweeps)
    below = Axis(_failures_title(data), limits=(-0.8, rows - 0.2), named=())
    panels = Panel(x, y, tuple(marks)), Panel(x, below, tuple(strip), share=_SHARE)
    return Chart(data.key, data.title, panels, 480 + 24 * rows, _KEYS)


def _axes(data: SweepFigure) -> tuple[Axis, Axis]:
    """Choose the axes of parameter and errors.

    The parameter's is logarithmic where its values are evenly spaced in the logarithm; the errors' is so beside such a
    one, or where the means differ much, and else begins at 0 as in the article.
    """
    values, title = np.unique(finite([sweep.shown_x for sweep in data.sweeps])), data.parameter.axis_title
    is_log = values.size > 2 and values[0] > 0 and _unevenness(np.log(values)) < 0.5 * _unevenness(values)
    x, about = Axis(title, "log" if is_log else "linear"), "error of the better candidate (deg)"
    means, lows, tops = (finite([getattr(s, side) for s in data.sweeps]) for side in ("mean", "least", "largest"))
    if means.size and means.min() > 0 and (is_log or means.max() > _WIDE * means.min()):
        # Bars may leave the range below, where they would squeeze the means.
        least = max(float(lows[lows > 0].min(initial=np.inf)), float(means.min()) / 12)
        return x, Axis(about, "log", (least / 1.3, float(tops.max()) * 1.4))
    top = finite([tops, *(sweep.bound for sweep in data.sweeps)]).max(initial=0.0)
    return x, Axis(about, limits=(0.0, 1.06 * float(top)) if top > 0 else None)


def _unevenness(values: Array) -> float:
    """Return the spread of the steps between ascending values, over their mean."""
    steps = np.diff(values)
    return float(steps.std() / steps.mean())


def _shifted(data: SweepFigure, axis: Axis) -> list[Array]:
    """Return the x at which each sweep is drawn: beside the others, so that the bars of several show."""
    is_log, count = axis.scale == "log", len(data.sweeps)
    values = np.unique(finite([sweep.shown_x for sweep in data.sweeps]))
    gap = float(np.diff(np.log(values) if is_log else values).min()) if values.size > 1 else 1.0
    shifts = (np.arange(count) - (count - 1) / 2) * min(0.14, 0.6 / count) * gap
    columns = zip(data.sweeps, shifts, strict=True)
    return [s.shown_x * np.exp(shift) if is_log else s.shown_x + shift for s, shift in columns]


def _means(sweep: Sweep, x: Array, colour: str, symbol: str, floor: float) -> list[Mark]:
    name = f"{sweep.estimator}: {sweep.label}"
    columns = (sweep.x, sweep.mean, sweep.std, sweep.least, sweep.largest, sweep.bound, sweep.law, sweep.answered,
               sweep.failed)  # fmt: skip
    hover = [
        f"{sweep.estimator}, {sweep.label}\n{sweep.parameter.text(float(at))}\nmean {number(float(mean))}° ± "
        f"{number(float(std))}°, {number(float(least))}° to {number(float(largest))}°\nbound {number(float(bound))}°, "
        f"predicted bias {number(float(law))}°\n{ok:.0f} answered, {failed:.0f} failed"
        for at, mean, std, least, largest, bound, law, ok, failed in zip(*columns, strict=True)
    ]
    # The bars of the standard deviation stay inside what the axis can show.
    low, high = np.maximum(sweep.mean - sweep.std, floor), sweep.mean + sweep.std
    return [
        Mark(x, sweep.mean, colour, name, bars=Bars(sweep.least, sweep.largest)),
        Mark(x, sweep.mean, colour, name, bars=Bars(low, high, _STD_PX)),
        Mark(x, sweep.mean, colour, name, line="solid", width=1.8, symbol=symbol, size=8, hover=hover),
    ]


def _failures(data: SweepFigure, index: int, axis: Axis, colour: str, symbol: str) -> list[Mark]:
    """Return the counts of a sweep's failed realisations; those of several sweeps in colour and with symbols."""
    sweep, several = data.sweeps[index], len(data.sweeps) > 1
    name = f"{sweep.estimator}: {sweep.label}"
    prefix = f"{symbol} " if several else ""
    hover = np.array([
        f"{name}\n{sweep.parameter.text(float(at))}\n{failed:.0f} of {failed + ok:.0f} failed"
        + (f": {reasons}" if reasons else "")
        for at, failed, ok, reasons in zip(sweep.x, sweep.failed, sweep.answered, sweep.reasons, strict=True)
    ])  # fmt: skip
    x = sweep.shown_x
    at = np.log(x) if axis.scale == "log" else x
    close = x.size > 1 and np.diff(at).min() < _CLOSE * np.ptp(at)
    height = len(data.sweeps) - 1 - index + (_STAGGER * (-1.0) ** np.arange(x.size) if close else np.zeros(x.size))
    marks = []
    for failing in (True, False):
        kept = (sweep.failed > 0) == failing
        words = [f"{prefix}{count:.0f}" for count in sweep.failed[kept]]
        shade = _FAILED_COLOUR if failing else colour if several else NEUTRAL
        told = hover[kept].tolist()
        marks.append(Mark(x[kept], height[kept], shade, name, words=words, bold=failing, hover=told))
    return marks


def _failures_title(data: SweepFigure) -> str:
    """Return the title of the failures' strip: of how many realisations."""
    totals = sorted({int(total) for sweep in data.sweeps for total in sweep.failed + sweep.answered})
    return f"failures\nof {' or '.join(str(total) for total in totals)}"
