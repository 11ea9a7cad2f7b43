"""Draws charts in pages: plotly's JSON, all of a page's figures packed in one script, and plotly itself."""

import base64
import json
import zlib
from collections.abc import Mapping
from functools import cache
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Axis
from simtest.pages.chart import Bars, Chart, Mark, Panel
from simtest.pages.style import rgb
from simtest.runtime.arrays import Array

PlotlyJson = dict[str, Any]  # plotly's own description of a figure or a part of it, as it leaves for the page
BUNDLE = Path(__file__).parent / "vendor" / "plotly-gl3d.min.js.zz"
_GAP = 0.03  # half the space between stacked panels, share of the figure's height


def figure(chart: Chart) -> PlotlyJson:
    """Return plotly's data and layout of a chart; what all charts share of their look is in the page's script."""
    made: PlotlyJson = {"height": chart.height}
    count = len(chart.panels)
    made["xaxis"] = _axis(chart.panels[0].x, chart.all_x) | {"anchor": "y" if count == 1 else f"y{count}"}
    listed = {id(mark) for mark in chart.entries}
    data = []
    for number, (panel, span) in enumerate(zip(chart.panels, _spans(chart), strict=True), 1):
        name = "y" if number == 1 else f"y{number}"
        axis = _axis(panel.y, panel.all_y) | {"domain": span}
        made[name.replace("y", "yaxis")] = axis | ({"scaleanchor": "x"} if panel.equal else {})
        data += [_trace(mark, panel, id(mark) in listed) | {"yaxis": name} for mark in panel.marks]
    return {"data": data, "layout": made}


def _spans(chart: Chart) -> list[list[float]]:
    """Return the share of the height that each panel takes, the first one on top."""
    shares = np.array([panel.share for panel in chart.panels])
    edges = 1 - np.concatenate([[0.0], np.cumsum(shares)]) / shares.sum()
    last = len(shares) - 1
    lows = [float(edge) + (_GAP if i < last else 0.0) for i, edge in enumerate(edges[1:])]
    highs = [float(edge) - (_GAP if i else 0.0) for i, edge in enumerate(edges[:-1])]
    return [[round(low, 3), round(high, 3)] for low, high in zip(lows, highs, strict=True)]


def _axis(axis: Axis, values: list[npt.ArrayLike]) -> PlotlyJson:
    low, high = axis.ends(values)
    made: PlotlyJson = {"title": {"text": _text(axis.title)}, "zeroline": False, "automargin": True}
    made["range"] = rounded(np.log10([low, high]) if axis.scale == "log" else [low, high])
    if axis.scale == "log":
        made["type"] = "log"
    ticks, minor = axis.ticks(low, high), axis.minor_ticks(low, high)
    if ticks is not None:
        made |= {"tickvals": [at for at, _ in ticks], "ticktext": [_text(text) for _, text in ticks], "tickangle": 0}
    if minor:
        # The texts stand beyond the longer ticks; without these the shorter ones would run through them.
        made |= {"ticks": "outside", "ticklen": 5}
        made["minor"] = {"ticks": "outside", "ticklen": 3, "tickvals": rounded(minor)}
    return made


def _trace(mark: Mark, panel: Panel, is_entry: bool) -> PlotlyJson:
    x, y = np.asarray(mark.x, float), panel.y.visible(np.asarray(mark.y, float))
    modes = [name for name, on in (("lines", mark.line), ("markers", mark.symbol), ("text", mark.words)) if on]
    made: PlotlyJson = {
        # A legend entry alone has a point nowhere.
        "type": "scatter", "x": rounded(panel.x.to_axis(x)) or [None], "y": rounded(y) or [None],
        "mode": "+".join(modes) or "none", "showlegend": is_entry, "hoverinfo": "text" if mark.hover else "skip",
    }  # fmt: skip
    if mark.line:
        made["line"] = {"color": mark.colour, "width": mark.width, "dash": mark.line}
    if mark.name:
        made |= {"name": escape(mark.name), "legendgroup": escape(mark.name)}
    if mark.symbol:
        made["marker"] = {"symbol": mark.symbol.plotly, "size": mark.size, "color": mark.colour}
        # Thin crosses have a line alone.
        made["marker"] |= {"line": {"width": 2, "color": mark.colour}} if "thin" in mark.symbol.plotly else {}
    if mark.words:
        words = [f"<b>{escape(word)}</b>" if mark.bold else escape(word) for word in mark.words]
        made |= {"text": words, "textfont": {"color": mark.colour}, "cliponaxis": False}
    if mark.opacity < 1:
        made["opacity"] = mark.opacity
    if mark.fill:
        made |= {"mode": "lines", "fill": "toself", "fillcolor": mark.colour, "line": {"width": 0}}
        made |= {"hoveron": "fills", "text": _text(str(mark.hover))}
    elif isinstance(mark.hover, str):
        made |= _told(mark.hover, panel.x, x) if mark.hover else {}
    else:
        # The first line is the heading of what is told.
        lines = (_text(text).split("<br>", 1) for text in mark.hover)
        made["hovertext"] = ["<br>".join([f"<b>{first}</b>", *rest]) for first, *rest in lines]
    return made | (_bars(mark.bars, y, mark.colour, bool(modes)) if mark.bars else {})


def _told(hover: str, axis: Axis, x: Array) -> PlotlyJson:
    """Return the hover of a text that may hold {x} and {y}."""
    stretched = axis.scale == "stretched"
    at = "%{customdata:.3g}" if stretched else "%{x:.3g}"
    text = _text(hover).replace("{x}", at).replace("{y}", "%{y:.3g}") + "<extra></extra>"
    return {"hovertemplate": text} | ({"customdata": rounded(x)} if stretched else {})


def _bars(bars: Bars, y: Array, colour: str, is_drawn: bool) -> PlotlyJson:
    shade = "rgba({},{},{},0.4)".format(*rgb(colour)) if bars.is_thick else colour
    made: PlotlyJson = {
        "error_y": {
            "type": "data", "symmetric": False, "array": rounded(np.nan_to_num(bars.high - y)),
            "arrayminus": rounded(np.nan_to_num(y - bars.low)), "thickness": bars.width,
            "width": 0 if bars.is_thick else 3, "color": shade,
        }
    }  # fmt: skip
    # Plotly draws bars of markers and lines alone.
    return made if is_drawn else made | {"mode": "markers", "marker": {"size": 1, "color": colour}}


def _text(text: str) -> str:
    return escape(text).replace("\n", "<br>")


def rounded(values: npt.ArrayLike) -> list[float | None]:
    """Return numbers with five digits, as no screen shows more; None for what is not finite."""
    return [float(f"{v:.5g}") if v - v == 0 else None for v in np.asarray(values, float).ravel().tolist()]


def packed(value: Mapping[str, Any]) -> str:
    """Return a value as compact JSON, in zlib's format as base64, for `charts.html.j2` to unpack."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii")


@cache
def packed_plotly() -> str:
    """Return plotly's bundle in zlib's format as base64, for `charts.html.j2` to unpack."""
    return base64.b64encode(BUNDLE.read_bytes()).decode("ascii")
