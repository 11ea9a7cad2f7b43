"""The article's error plots as charts: means with both bars, bound and law, and below them the failures."""

from collections.abc import Mapping

import numpy as np

from simtest.pages.charts import NOTHING, Axis, Bars, Chart, Mark, Panel, finite
from simtest.pages.style import NEUTRAL, number, symbols
from simtest.report.paper.sweeps import Sweep, SweepFigure
from simtest.runtime.arrays import Array

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
