"""Draws the laws: measured against predicted, and the departures over what they may be."""

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.pages.style import ESTIMATOR_COLOURS, NEUTRAL, Array
from simtest.report.laws.judge import SLOPE, LawResult
from simtest.report.static import log_range

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from plotly.graph_objects import Figure as Chart

_COLOURS = (*ESTIMATOR_COLOURS.values(), "#A6761D", "#7A8B99")

_LEAST_SHARE = 1e-4
"""Departures over what is allowed: smaller ones are drawn here on the logarithmic axis."""

ANGLES, RATIOS, DEPARTURES = "laws_angles", "laws_ratios", "laws_departures"
TITLES = {
    ANGLES: "Angles: measured against predicted (deg)",
    RATIOS: "Axis ratios: measured against predicted",
    DEPARTURES: "Departure over what is allowed",
}


def colour_of(results: Sequence[LawResult]) -> dict[str, str]:
    """Give each law its colour."""
    return {result.name: _COLOURS[i % len(_COLOURS)] for i, result in enumerate(results)}


def shares(result: LawResult) -> Array:
    """Give the departures over what is allowed, at least as large as the axis shows."""
    return np.maximum(np.abs(result.gap) / result.tolerance, _LEAST_SHARE)


def _shown(results: Sequence[LawResult], key: str) -> list[LawResult]:
    kept = [result for result in results if result.settings]
    if key == DEPARTURES:
        return kept
    return [result for result in kept if result.law.is_angle == (key == ANGLES) and result.name != SLOPE]


def _diagonal(shown: Sequence[LawResult], key: str) -> tuple[float, float]:
    values = [part for result in shown for part in (result.measured, result.predicted)]
    return log_range(values) if key == ANGLES else (0.0, 1.05)


def draw(results: Sequence[LawResult]) -> "Figure":
    """Draw the three panels with matplotlib."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter

    colours = colour_of(results)
    figure, axes = plt.subplots(1, 3, figsize=(15.0, 5.4), layout="constrained", width_ratios=(1, 1, 1.25))
    for ax, key in zip(axes, TITLES, strict=True):
        shown = _shown(results, key)
        ax.set_title(TITLES[key])
        if key == DEPARTURES:
            names = [result.law.title for result in shown]
            for place, result in enumerate(shown):
                ax.plot(shares(result), np.full(len(result.settings), place), "o", color=colours[result.name], ms=5)
            ax.axvline(1.0, color=NEUTRAL, ls="--")
            ax.set_yticks(range(len(shown)), names)
            ax.invert_yaxis()
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
            ax.set_xlabel("|measured − predicted| / allowed; beyond 1 the law is not met")
            continue
        if not shown:
            ax.set_visible(False)
            continue
        low, high = _diagonal(shown, key)
        ax.plot([low, high], [low, high], "--", color=NEUTRAL, lw=1.2, zorder=1)
        for result in shown:
            ax.plot(result.predicted, result.measured, "o", color=colours[result.name], ms=5, label=result.law.title)
        if key == ANGLES:
            ax.set_xscale("log")
            ax.set_yscale("log")
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        ax.set(xlabel="predicted", ylabel="measured", xlim=(low, high), ylim=(low, high))
        ax.legend(fontsize=8, loc="upper left")
    return figure


def chart(results: Sequence[LawResult], key: str) -> "Chart | None":
    """Draw one panel with plotly; None where there is nothing to show."""
    import plotly.graph_objects as go

    from simtest.report.interactive import layout

    shown, colours = _shown(results, key), colour_of(results)
    if not shown:
        return None
    figure = go.Figure()
    for result in shown:
        y = [result.law.title] * len(result.settings) if key == DEPARTURES else result.measured
        figure.add_trace(
            go.Scatter(
                x=shares(result) if key == DEPARTURES else result.predicted, y=y, mode="markers",
                marker={"color": colours[result.name], "size": 8}, name=escape(result.law.title),
                text=_hover(result), hovertemplate="%{text}<extra></extra>", showlegend=False,
            )
        )  # fmt: skip
    line: dict[str, Any] = {"color": NEUTRAL, "dash": "dash", "width": 1.5}
    if key == DEPARTURES:
        figure.add_vline(x=1.0, line=line)
        x: dict[str, Any] = {
            "type": "log",
            "title": {"text": "|measured − predicted| / allowed; beyond 1 the law is not met"},
        }
        x |= {"automargin": True, "dtick": 1, "exponentformat": "none"}
        figure.update_layout(layout(420, xaxis=x, yaxis={"autorange": "reversed", "automargin": True}))
        return figure
    ends = _diagonal(shown, key)
    figure.add_trace(go.Scatter(x=ends, y=ends, mode="lines", line=line, showlegend=False, hoverinfo="skip"))
    figure.update_layout(layout(420, xaxis=_axis("predicted", key, ends), yaxis=_axis("measured", key, ends)))
    return figure


def _axis(title: str, key: str, ends: tuple[float, float]) -> dict[str, Any]:
    unit = " (deg)" if key == ANGLES else ""
    axis: dict[str, Any] = {"title": {"text": title + unit}, "automargin": True, "zeroline": False}
    if key == ANGLES:
        return axis | {"type": "log", "range": [float(v) for v in np.log10(ends)], "dtick": 1, "exponentformat": "none"}
    return axis | {"range": list(ends)}


def _hover(result: LawResult) -> list[str]:
    return [
        f"<b>{escape(result.law.title)}</b><br>{escape(setting)}<br>measured {result.text(m)}, predicted "
        f"{result.text(p)}<br>allowed ± {result.text(a)}"
        for setting, m, p, a in zip(result.settings, result.measured, result.predicted, result.tolerance, strict=True)
    ]
