"""Draws the same figures with plotly."""

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go

from simtest.pages import style
from simtest.pages.style import NEUTRAL
from simtest.report.interactive import layout
from simtest.report.paper.isocurves import KAPPA, REACH, Branch, IsocurveFigure
from simtest.report.paper.static import (
    BOUND_NAME,
    BRANCH_COLOUR,
    ISOPHOTE_COLOUR,
    LAW_NAME,
    bounds,
    failures_title,
    laws,
    log_limits,
    spread_bars,
)
from simtest.report.paper.sweeps import Sweep, SweepFigure
from simtest.report.static import visible

_SHARE = 0.2
"""Height of the failures' strip."""

_CLOSE, _STAGGER = 0.09, 0.24


def sweep(data: SweepFigure, colours: Mapping[str, str]) -> go.Figure:
    """Draw an error plot with its bars, bound, law and the failures' strip."""
    figure = go.Figure()
    marks = style.symbols(data.labels)
    for index, one in enumerate(data.sweeps):
        _curve(figure, data, index, colours[one.estimator], marks[one.label].plotly)
    for index, one in enumerate(data.sweeps):
        figure.add_trace(_failures(data, index, marks[one.label].text))
    lines = [(one.shown_x, one.bound, "#8A6D00", "dashdot", BOUND_NAME, one.label) for one in bounds(data)]
    lines += [(data.places(i), one.law, NEUTRAL, "dash", LAW_NAME, one.label) for i, one in laws(data)]
    named: set[str] = set()
    for x, y, colour, dash, name, label in lines:
        figure.add_trace(
            go.Scatter(
                x=x, y=visible(y, data.y), mode="lines", line={"color": colour, "dash": dash, "width": 1.6}, name=name,
                legendgroup=name, showlegend=name not in named,
                hovertemplate=f"{name}<br>{escape(label)}: %{{y:.3g}}°<extra></extra>",
            )
        )  # fmt: skip
        named.add(name)
    figure.update_layout(_sweep_layout(data))
    return figure


def _sweep_layout(data: SweepFigure) -> dict[str, Any]:
    rows = len(data.sweeps)
    x: dict[str, Any] = {"title": {"text": escape(data.x.title)}, "zeroline": False, "automargin": True, "anchor": "y2"}
    if data.x.scale == "log":
        values = np.concatenate([one.shown_x for one in data.sweeps])
        x |= {"type": "log", **_log_ticks(float(values.min()) / 1.5, float(values.max()) * 1.5)}
    y: dict[str, Any] = {"title": {"text": escape(data.y.title)}, "automargin": True, "domain": [_SHARE + 0.04, 1.0]}
    if data.y.scale == "log":
        low, high = log_limits(data)
        y |= {"type": "log", "range": [np.log10(low), np.log10(high)], **_log_ticks(low, high)}
    else:
        y |= {"range": data.y.limits, "zeroline": False}
    below = {
        "title": {"text": failures_title(data).replace("\n", "<br>")}, "ticks": "",
        "domain": [0.0, _SHARE - 0.02], "range": [-0.8, rows - 0.2],
        "showticklabels": False, "showgrid": False, "zeroline": False, "automargin": True, "fixedrange": True,
    }  # fmt: skip
    return _legend_below(layout(540 + 24 * rows, xaxis=x, yaxis=y, yaxis2=below), len(data.sweeps) + 2)


def _legend_below(made: dict[str, Any], entries: int) -> dict[str, Any]:
    """Put the legend at the figure's lower edge, clear of the axis' title even where each entry takes a line."""
    made["legend"] |= {"yref": "container", "y": 0.0, "yanchor": "bottom"}
    made["margin"] |= {"b": 62 + 22 * entries}
    return made


def _log_ticks(low: float, high: float) -> dict[str, Any]:
    """Give ticks at 1, 2 and 5 with their values in full: plotly's own leave out the power of ten."""
    values = [digit * 10.0**power for power in range(-6, 7) for digit in (1, 2, 5)]
    shown = [value for value in values if low <= value <= high]
    return {"tickvals": shown, "ticktext": [f"{value:g}" for value in shown]}


def _curve(figure: go.Figure, data: SweepFigure, index: int, colour: str, symbol: str) -> None:
    one, x = data.sweeps[index], data.places(index)
    name = escape(f"{one.estimator}: {one.label}")
    mean = visible(one.mean, data.y)
    bars = {"type": "data", "symmetric": False, "color": colour}
    low, high = spread_bars(one, data)
    for array, minus, look, hint in (
        (one.largest - one.mean, one.mean - one.least, {"thickness": 1, "width": 5}, "least to largest"),
        (high - one.mean, one.mean - low, {"thickness": 6, "width": 0, "color": _faint(colour)}, "± std"),
    ):
        error = bars | look | {"array": np.nan_to_num(array), "arrayminus": np.nan_to_num(minus)}
        figure.add_trace(
            go.Scatter(
                x=x, y=mean, mode="markers", marker={"color": colour, "size": 1}, error_y=error, name=f"{name}, {hint}",
                legendgroup=name, showlegend=False, hoverinfo="skip",
            )
        )  # fmt: skip
    figure.add_trace(
        go.Scatter(
            x=x, y=mean, mode="lines+markers", line={"color": colour, "width": 1.8}, name=name, legendgroup=name,
            marker={"symbol": symbol, "size": 8, "color": colour}, text=_hover(one), hoverinfo="text",
        )
    )  # fmt: skip


def _faint(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.4)"


def _hover(one: Sweep) -> list[str]:
    number = style.number
    columns = (one.x, one.mean, one.std, one.least, one.largest, one.bound, one.law, one.answered, one.failed)
    return [
        f"<b>{escape(one.estimator)}</b>, {escape(one.label)}<br>{escape(one.parameter.text(float(x)))}<br>"
        f"mean {number(float(mean))}° ± {number(float(std))}°, {number(float(least))}° to {number(float(largest))}°<br>"
        f"bound {number(float(bound))}°, predicted bias {number(float(law))}°<br>"
        f"{ok:.0f} answered, {failed:.0f} failed"
        for x, mean, std, least, largest, bound, law, ok, failed in zip(*columns, strict=True)
    ]


def _failures(data: SweepFigure, index: int, mark: str) -> go.Scatter:
    one = data.sweeps[index]
    label = escape(f"{one.estimator}: {one.label}")
    texts = [
        f"{label}<br>{escape(one.parameter.text(float(x)))}<br>{failed:.0f} of {failed + ok:.0f} failed"
        + (f": {escape(reasons)}" if reasons else "")
        for x, failed, ok, reasons in zip(one.x, one.failed, one.answered, one.reasons, strict=True)
    ]
    prefix = f"{mark} " if len(data.sweeps) > 1 else ""
    # Numbers of close settings are set in two heights, so that narrow pages keep them apart.
    x = np.log(one.shown_x) if data.x.scale == "log" else one.shown_x
    close = x.size > 1 and np.diff(x).min() < _CLOSE * np.ptp(x)
    height = len(data.sweeps) - 1 - index + (_STAGGER * (-1.0) ** np.arange(x.size) if close else np.zeros(x.size))
    return go.Scatter(
        x=one.shown_x, y=height, yaxis="y2", mode="text",
        text=[f"<b>{prefix}{v:.0f}</b>" if v else f"{prefix}0" for v in one.failed], hovertext=texts, hoverinfo="text",
        showlegend=False, legendgroup=label, cliponaxis=False, name=f"{label}, failures",
        textfont={"color": ["#D03030" if v else NEUTRAL for v in one.failed]},
    )  # fmt: skip


def isocurves(data: IsocurveFigure) -> dict[str, go.Figure]:
    """Draw the three parts of Figure 1, by key."""
    together, apart = _plane(data.together), _plane(data.apart)
    for radius, name in ((data.inner, "r−"), (data.outer, "r+")):
        together.add_annotation(x=0, y=radius, text=f"{name} = {radius:.5f}", showarrow=False, yshift=10)
    _mark(together, (0, 0), "cross-thin-open", "camera's foot, light's foot, BP")
    _mark(apart, (0, 0), "cross-thin-open", "camera's foot")
    _mark(apart, (2 * data.bp[0], 2 * data.bp[1]), "star", "light's foot")
    _mark(apart, (data.bp[0], data.bp[1]), "x-thin-open", "BP")
    return {"isocurves_together": together, "isocurves_apart": apart, "isocurve_radii": _radii(data)}


def _plane(branches: tuple[Branch, ...]) -> go.Figure:
    figure = go.Figure()
    for branch in branches:
        colour, dash = (ISOPHOTE_COLOUR, "solid") if branch.is_isophote else (BRANCH_COLOUR, "dash")
        name = "isophote: cos β = τ" if branch.is_isophote else "cos β = −τ, no isophote"
        line = {"color": colour, "dash": dash, "width": 2.2}
        x, y = np.round(branch.points[:: max(1, len(branch.points) // 240)], 5).T
        x, y = np.append(x, x[0]), np.append(y, y[0])
        hover = f"{name}<br>x = %{{x:.3f}}, y = %{{y:.3f}} |V_Z|<extra></extra>"
        figure.add_trace(go.Scatter(x=x, y=y, mode="lines", line=line, name=name, hovertemplate=hover))
    axis = {"range": [-REACH, REACH], "zeroline": False, "automargin": True, "constrain": "domain"}
    figure.update_layout(
        _legend_below(
            layout(
                500, xaxis=axis | {"title": {"text": "x (|V_Z|)"}},
                yaxis=axis | {"title": {"text": "y (|V_Z|)"}, "scaleanchor": "x"},
            ), 5,
        )
    )  # fmt: skip
    return figure


def _mark(figure: go.Figure, place: tuple[float, float], symbol: str, name: str) -> None:
    marker = {"symbol": symbol, "size": 10, "color": "#B8860B", "line": {"width": 2, "color": "#B8860B"}}
    figure.add_trace(go.Scatter(x=[place[0]], y=[place[1]], mode="markers", marker=marker, name=name, hoverinfo="name"))


def _radii(data: IsocurveFigure) -> go.Figure:
    figure = go.Figure()
    for values, colour, dash, name in (
        (data.inner_of_kappa, ISOPHOTE_COLOUR, "solid", "r−/|V_Z|, the isophote"),
        (data.outer_of_kappa, BRANCH_COLOUR, "dash", "r+/|V_Z|, no isophote"),
    ):
        line = {"color": colour, "dash": dash, "width": 2.2}
        hover = "κ = %{x:.3f}: %{y:.4g} |V_Z|<extra></extra>"
        figure.add_trace(
            go.Scatter(x=data.kappa, y=values, mode="lines", line=line, name=name, hovertemplate=hover)
        )  # fmt: skip
    figure.add_trace(
        go.Scatter(
            x=[KAPPA, KAPPA], y=[data.inner, data.outer], mode="lines+markers", name=f"κ = {KAPPA}",
            line={"color": NEUTRAL, "dash": "dot", "width": 1.2}, marker={"size": 7, "color": "#B8860B"},
            hovertemplate="%{y:.5f} |V_Z|<extra></extra>",
        )
    )  # fmt: skip
    y = {"title": {"text": "radius (|V_Z|)"}, "type": "log", "range": [-2, 2], "dtick": 1, "exponentformat": "none",
         "automargin": True}  # fmt: skip
    x = {"title": {"text": "κ = 1 − τ²"}, "range": [0, 1], "zeroline": False, "automargin": True}
    figure.update_layout(_legend_below(layout(500, xaxis=x, yaxis=y), 5))
    return figure
