"""The article's error plots as charts: means with both bars, bound and law, and below them the failures."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from simtest.pages.axes import Axis, finite
from simtest.pages.chart import NOTHING, Bars, Chart, Mark, Panel
from simtest.pages.style import NEUTRAL, Symbol, number, symbols
from simtest.report.paper.sweeps import Sweep, SweepFigure
from simtest.runtime.arrays import Array

BOUND_NAME = "Cramér-Rao bound (an RMS angle)"
LAW_NAME = "predicted bias of the smoothing, no noise"
_BOUND_COLOUR, _FAILED_COLOUR = "#8A6D00", "#D03030"

_STD_PX, _SHARE = 6.0, 0.2
"""Width of the standard deviation's bars, and the failures' strip over the panel above it."""

_KEYS = (
    Mark(NOTHING, NOTHING, NEUTRAL, "± standard deviation", symbol=Symbol("|", "line-ns", "▮"), size=13, width=_STD_PX),
    Mark(NOTHING, NOTHING, NEUTRAL, "least and largest error", symbol=Symbol("|", "line-ns", "|"), size=13, width=1.0),
)

_CLOSE, _STAGGER = 0.09, 0.24
"""Failures of settings nearer than this share of the axis stand in two heights, so that narrow pages part them."""


def sweep_chart(data: SweepFigure, colours: Mapping[str, str]) -> Chart:
    """Describe an error plot and its strip of failures."""
    shapes = symbols(data.labels)
    y = replace(data.y, limits=_log_limits(data)) if data.y.scale == "log" else data.y
    floor = y.limits[0] if y.limits else 0.0
    marks, strip = [], []
    for index, sweep in enumerate(data.sweeps):
        colour, symbol = colours[sweep.estimator], shapes[sweep.label]
        marks += _means(sweep, data.shifted_x(index), colour, symbol, floor)
        strip += _failures(data, index, colour, symbol)
    for sweep in data.bounds:
        told = f"{BOUND_NAME}\n{sweep.label}: {{y}}°"
        marks.append(Mark(sweep.shown_x, sweep.bound, _BOUND_COLOUR, BOUND_NAME, line="dashdot", hover=told))
    for index, sweep in data.laws:
        told = f"{LAW_NAME}\n{sweep.label}: {{y}}°"
        marks.append(Mark(data.shifted_x(index), sweep.law, NEUTRAL, LAW_NAME, line="dash", hover=told))
    rows = len(data.sweeps)
    below = Axis(_failures_title(data), limits=(-0.8, rows - 0.2), named=())
    panels = Panel(data.x, y, tuple(marks)), Panel(data.x, below, tuple(strip), share=_SHARE)
    return Chart(data.key, data.title, panels, 480 + 24 * rows, _KEYS)


def _log_limits(data: SweepFigure) -> tuple[float, float]:
    """Return the range of a logarithmic error axis: bars may leave it below, where they would squeeze the means."""
    means, lows, tops = (finite([getattr(s, side) for s in data.sweeps]) for side in ("mean", "least", "largest"))
    least = max(float(lows[lows > 0].min(initial=np.inf)), float(means[means > 0].min()) / 12)
    return least / 1.3, float(tops.max()) * 1.4


def _means(sweep: Sweep, x: Array, colour: str, symbol: Symbol, floor: float) -> list[Mark]:
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


def _failures(data: SweepFigure, index: int, colour: str, symbol: Symbol) -> list[Mark]:
    """Return the counts of a sweep's failed realisations; those of several sweeps in colour and with symbols."""
    sweep, several = data.sweeps[index], len(data.sweeps) > 1
    name = f"{sweep.estimator}: {sweep.label}"
    prefix = f"{symbol.text} " if several else ""
    hover = np.array([
        f"{name}\n{sweep.parameter.text(float(at))}\n{failed:.0f} of {failed + ok:.0f} failed"
        + (f": {reasons}" if reasons else "")
        for at, failed, ok, reasons in zip(sweep.x, sweep.failed, sweep.answered, sweep.reasons, strict=True)
    ])  # fmt: skip
    x = sweep.shown_x
    at = np.log(x) if data.x.scale == "log" else x
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
