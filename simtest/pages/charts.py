"""Figures: records become Vega-Lite specifications, which Vega draws in pages and vl-convert in files."""

import base64
import contextlib
import importlib.metadata
import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages import pixels
from simtest.pages.style import NEUTRAL, SHAPES, STROKES, symbols
from simtest.runtime.arrays import Array, Image
from simtest.runtime.files import user_cache, write_atomically

Spec = dict[str, Any]
"""A Vega-Lite specification, or a part of one."""

Line = Literal["solid", "dash", "dashdot", "dot", ""]
Tick = tuple[float, str]

NOTHING: Array = np.empty(0)

_DASHES = {"solid": (1, 0), "dash": (7, 4), "dashdot": (9, 3, 2, 3), "dot": (2, 3)}
_FAINT = 0.4  # opacity of thick bars
_DASH_CHANNEL = {
    "field": "dash", "type": "nominal", "legend": None,
    "scale": {"domain": list(_DASHES), "range": [list(dash) for dash in _DASHES.values()]},
}  # fmt: skip
_OFF = {"name": "off", "value": []}  # the names whose marks are hidden
_STRETCH = 0.01
_STRETCHED_TICKS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)

_DPI = 150
_SCALE = _DPI / 96  # px of a file over px of the page
_WIDTH, _NARROWER, _COLUMNS = 640, 370, 3
"""Widths of axes in files, px of the page: of a figure alone and of one of several, of which so many are in a row."""

_MARGIN, _GAP = 64, 14  # px of a figure's height for title and ticks of x, and between panels
_SMALL, _HANDLE, _ROW = 11.5, 36, 19  # px of the legend in files: size of texts, room for a line, height of a row

_INK, _GRID = "#1b1f24", "#dfe3e8"
_CONFIG = {
    # Texts of the page are read by `aria-label`; a node a mark would only slow it down.
    "aria": False, "background": "transparent", "font": "DejaVu Sans", "view": {"stroke": _GRID},
    "axis": {"gridColor": _GRID, "domainColor": _GRID, "tickColor": _GRID, "labelColor": _INK, "titleColor": _INK,
             "labelFontSize": 12, "titleFontSize": 13, "titleFontWeight": "normal", "labelLimit": 340,
             "labelSeparation": 4},
    "axisX": {"tickCount": 8}, "axisY": {"tickCount": 7},
    "title": {"color": _INK, "fontSize": 14, "fontWeight": "normal"},
}  # fmt: skip


@dataclass(frozen=True)
class Axis:
    """An axis of a panel; the scale "stretched" is near-logarithmic on both sides of zero."""

    title: str  # name and unit
    scale: Literal["linear", "log", "stretched"] = "linear"
    limits: tuple[float, float] | None = None  # default: from the marks
    named: tuple[Tick, ...] | None = None  # ticks with their texts, empty for none; default: by the scale

    def to_axis(self, values: npt.ArrayLike) -> Array:
        """Return values as they are spaced on the axis, same shape."""
        data = np.asarray(values, dtype=float)
        return np.sign(data) * np.log1p(np.abs(data) / _STRETCH) if self.scale == "stretched" else data

    def from_axis(self, spaced: npt.ArrayLike) -> Array:
        """Return the values of what `to_axis` returned."""
        data = np.asarray(spaced, dtype=float)
        return np.sign(data) * np.expm1(np.abs(data)) * _STRETCH if self.scale == "stretched" else data

    def visible(self, values: npt.ArrayLike) -> Array:
        """Return the values that the axis can show; NaN for the others."""
        data = np.asarray(values, dtype=float)
        return np.where(data > 0, data, np.nan) if self.scale == "log" else data

    def ends(self, values: Iterable[npt.ArrayLike]) -> tuple[float, float]:
        """Return the ends of the axis: its limits, or those of the values with a margin."""
        if self.limits:
            return self.limits
        shown = finite([self.visible(finite(values))])
        if not shown.size:
            return (0.1, 1.0) if self.scale == "log" else (0.0, 1.0)
        low, high = float(shown.min()), float(shown.max())
        if self.scale == "log":
            return low / 1.3, high * 1.3
        spaced = self.to_axis([low, high])
        margin = 0.05 * (float(np.ptp(spaced)) or 1.0)
        low, high = (float(end) for end in self.from_axis(spaced + np.array([-margin, margin])))
        return low, high

    def channel(self, column: str, ends: tuple[float, float], is_titled: bool = True) -> Spec:
        """Return the encoding of a column by this axis."""
        axis: Spec = {"title": self.title.split("\n") if self.title and is_titled else None, "labels": is_titled}
        scale: Spec = {"type": "linear", "domain": list(ends), "nice": False}
        low, high = min(ends), max(ends)
        if self.scale == "log":
            # Values between the powers of ten are named where there are few powers.
            digits = (1, 2, 5) if high < 100 * low else (1,)
            ticks = [float(f"{digit}e{power}") for power in range(-9, 10) for digit in digits]
            scale["type"] = "log"
            axis |= {"format": "~g", "values": [tick for tick in ticks if low <= tick <= high]}
        else:
            scale["zero"] = False
        if self.scale == "stretched":
            ticks = [*(-tick for tick in reversed(_STRETCHED_TICKS)), 0.0, *_STRETCHED_TICKS]
            scale |= {"type": "symlog", "constant": _STRETCH}
            ticks = [tick for tick in ticks if low <= tick <= high]
            axis |= {"format": "~g", "values": ticks, "labelOverlap": "greedy"}
        if self.named is not None:
            at, texts = [at for at, _ in self.named], [text.split("\n") for _, text in self.named]
            axis |= {"values": at, "labelExpr": f"{json.dumps(texts)}[indexof({json.dumps(at)}, datum.value)]"}
            axis["labelOverlap"] = False
        if "values" in axis:
            # Or Vega would leave out every second of more than it would choose.
            axis["tickCount"] = len(axis["values"])
        return {"field": column, "type": "quantitative", "scale": scale, "axis": axis}


class Bars(NamedTuple):
    """Vertical bars at the points of a mark; thick ones are faint and have no caps."""

    low: Array
    high: Array
    width: float = 1.0


@dataclass(frozen=True)
class Mark:
    """Points that belong together: joined, marked, with bars or words. Sizes and widths are px of the page."""

    x: npt.ArrayLike  # shape (n,); NaN leaves a gap. Without points, a mark is a legend entry
    y: npt.ArrayLike
    colour: str
    name: str = ""  # marks of one name are switched together, and have one entry in the legend
    listed: bool = True  # whether the mark may be that entry
    line: Line = ""  # how points are joined, "" for not at all
    width: float = 1.6
    symbol: str = ""  # of `SHAPES`
    size: float = 7.0
    bars: Bars | None = None
    words: Sequence[str] = ()  # written at the points
    bold: bool = False
    hover: str | Sequence[str] = ()  # told at each point; a single text may hold {x} and {y}
    fill: bool = False  # fill the upright rectangle about the points
    opacity: float = 1.0
    head: bool = False  # draw a line as an arrow, on axes of one scale

    @property
    def dashes(self) -> tuple[int, ...]:
        """Lengths of dash, gap, ..., px."""
        return _DASHES[self.line]


class Picture(NamedTuple):
    """A grey picture in [0, 1] below the marks of a panel."""

    values: Image
    extent: tuple[float, float, float, float]  # x0, x1, y1, y0


@dataclass(frozen=True)
class Panel:
    """A pair of axes with its marks."""

    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    share: float = 1.0  # of the figure's height
    equal: bool = False  # both axes have one scale
    picture: Picture | None = None


@dataclass(frozen=True)
class Chart:
    """A figure of panels one above the other, with one x axis."""

    key: str  # name of the figure in its page
    title: str
    panels: tuple[Panel, ...]
    height: int = 420  # px of the page, without the legend
    keys: tuple[Mark, ...] = ()  # further legend entries: what symbols and colours stand for

    @property
    def entries(self) -> list[Mark]:
        """Marks that stand in the legend: of each name the first one with a line or symbol."""
        found: dict[str, Mark] = {}
        for mark in (mark for panel in self.panels for mark in panel.marks):
            if mark.name and mark.listed and (mark.line or mark.symbol):
                found.setdefault(mark.name, mark)
        return list(found.values())


def label_keys(labels: Iterable[str]) -> tuple[Mark, ...]:
    """Return the legend entries of labels that are told apart by symbol; none for a single label."""
    marks = symbols(labels)
    if len(marks) < 2:
        return ()
    return tuple(Mark(NOTHING, NOTHING, NEUTRAL, name, symbol=symbol) for name, symbol in marks.items())


def finite(values: Iterable[npt.ArrayLike]) -> Array:
    """Return the finite values of several arrays, flattened."""
    parts = [np.asarray(part, dtype=float).ravel() for part in values]
    data = np.concatenate(parts) if parts else np.empty(0)
    return data[np.isfinite(data)]


def log_range(arrays: Sequence[npt.ArrayLike]) -> tuple[float, float]:
    """Return a range for a logarithmic axis from the positive values, with a margin; laws may leave it."""
    values = finite(arrays)
    values = values[values > 0]
    if not values.size:
        return 0.1, 100.0
    return float(values.min()) / 1.6, float(values.max()) * 1.6


def curvature_axis(values: npt.ArrayLike, title: str) -> Axis:
    """Return the axis for curvature: stretched where the values span more than a factor of ten, else linear.

    The smallest twentieth and the largest do not count: among the many highlights of anatomies there are always some.
    """
    size = np.abs(finite([values]))
    size = size[size > 1e-9]
    wide = size.size > 1 and np.quantile(size, 0.95) / np.quantile(size, 0.05) > 10
    return Axis(title, "stretched" if wide else "linear")


# Specifications ------------------------------------------------------------------------------------------------------


def spec(chart: Chart, width: int = _WIDTH) -> Spec:
    """Return the specification of a chart whose axes are so wide, px; marks whose names stand in `off` are hidden."""
    all_x = [mark.x for panel in chart.panels for mark in panel.marks]
    room = (chart.height - _MARGIN - _GAP * (len(chart.panels) - 1)) / sum(panel.share for panel in chart.panels)
    last = chart.panels[-1]
    views = [_view(panel, panel.x.ends(all_x), width, room * panel.share, panel is last) for panel in chart.panels]
    whole: Spec = {"vconcat": views, "spacing": _GAP} if len(views) > 1 else views[0]
    # The page's script keeps the ratio of axes of one scale, and turns names that do not fit beside each other.
    ratio = views[0]["width"] / views[0]["height"] if last.equal else None
    names = sum(6.5 * max(map(len, name.split("\n"))) + 6 for _, name in last.x.named or ())
    return {"config": _CONFIG, "params": [_OFF], "usermeta": {"ratio": ratio, "names": names}, **whole}


def _view(panel: Panel, x_ends: tuple[float, float], width: int, height: float, is_last: bool) -> Spec:
    """Return the specification of a panel."""
    y_ends = panel.y.ends([part for mark in panel.marks for part in (mark.y, *((mark.bars or ())[:2]))])
    view: Spec = {"width": width, "height": round(height)}
    if panel.equal:
        view["width"] = round(height * abs((x_ends[1] - x_ends[0]) / (y_ends[1] - y_ends[0])))

    def layer(mark: Spec, rows: list[Spec], x: str = "x", y: str = "y", **more: Any) -> Spec:
        axes = {"x": panel.x.channel(x, x_ends, is_last), "y": panel.y.channel(y, y_ends)}
        switched = [{"filter": "indexof(off, datum.name) < 0"}]
        return {"data": {"values": rows}, "transform": switched, "mark": mark, "encoding": axes | more}

    kinds = _rows(panel, x_ends, y_ends)
    colour, width_px, opacity = _direct("colour", "nominal"), _direct("width"), _direct("opacity")
    told = {"field": "told", "type": "nominal"}
    layers = [
        layer({"type": "rect", "clip": True}, kinds["fills"], x2={"field": "x2"}, y2={"field": "y2"}, fill=colour,
              tooltip=told),
        layer({"type": "rule", "clip": True}, kinds["bars"], y="low", y2={"field": "high"}, stroke=colour,
              strokeWidth=width_px, opacity=opacity),
        layer({"type": "line", "clip": True}, kinds["lines"], stroke=colour, strokeWidth=width_px,
              strokeDash=_DASH_CHANNEL, detail={"field": "piece", "type": "nominal"}, order={"value": None}),
        layer({"type": "point", "clip": True}, kinds["points"], shape=_direct("shape", "nominal"), fill=colour,
              stroke=colour, strokeWidth=width_px, size=_direct("size"), opacity=opacity, tooltip=told),
        layer({"type": "text", "fontSize": 12, "fontWeight": {"expr": "datum.bold ? 'bold' : 'normal'"}},
              kinds["words"], text={"field": "text", "type": "nominal"}, color=colour, tooltip=told),
    ]  # fmt: skip
    shown = [each for each in layers if each["data"]["values"] or each["mark"]["type"] == "point"]
    return view | {"layer": [*_picture(panel, layer, view), *shown]}


def _direct(column: str, kind: str = "quantitative") -> Spec:
    """Return the encoding of a column that holds what is drawn itself."""
    return {"field": column, "type": kind, "scale": None}


def _picture(panel: Panel, layer: Any, view: Spec) -> list[Spec]:
    """Return the layer of a panel's picture, in the px in which it is drawn."""
    if panel.picture is None:
        return []
    x0, x1, y1, y0 = panel.picture.extent
    size = round(_SCALE * view["width"]), round(_SCALE * view["height"])
    values = np.clip(np.rint(255 * np.asarray(panel.picture.values, float)), 0, 255).astype(np.uint8)
    how = cv2.INTER_NEAREST if size[0] >= values.shape[1] else cv2.INTER_AREA
    drawn = np.asarray(cv2.resize(values, size, interpolation=how), np.uint8)
    row = {"name": "", "x": x0, "x2": x1, "y": y0, "y2": y1, "url": pixels.jpeg_address(drawn)}
    ends = {"x2": {"field": "x2"}, "y2": {"field": "y2"}}
    return [layer({"type": "image", "aspect": False}, [row], **ends, url={"field": "url", "type": "nominal"})]


def _rows(panel: Panel, x_ends: tuple[float, float], y_ends: tuple[float, float]) -> dict[str, list[Spec]]:
    """Return the rows of a panel's layers by kind."""
    kinds: dict[str, list[Spec]] = {kind: [] for kind in ("fills", "bars", "lines", "points", "words")}
    for number, mark in enumerate(panel.marks):
        x, y = np.asarray(mark.x, float), panel.y.visible(mark.y)
        rows = [
            {"x": _rounded(at), "y": _rounded(value), "told": told, "name": mark.name, "colour": mark.colour}
            for at, value, told in zip(x, y, _told(mark, x, y), strict=True)
        ]
        shown = [i for i in range(len(rows)) if np.isfinite(x[i]) and np.isfinite(y[i])]
        if mark.fill:
            ends = {"x": float(x.min()), "x2": float(x.max()), "y": float(y.min()), "y2": float(y.max())}
            kinds["fills"].append({**rows[0], **ends})
            continue
        if mark.bars:
            floor = min(y_ends) if panel.y.scale == "log" else -np.inf
            thick = mark.bars.width >= 3
            for i in shown:
                low, high = max(float(mark.bars.low[i]), floor), float(mark.bars.high[i])
                if np.isfinite(low) and np.isfinite(high):
                    bar = {**rows[i], "low": _rounded(low), "high": _rounded(high), "width": mark.bars.width}
                    kinds["bars"].append({**bar, "opacity": _FAINT if thick else 1.0})
                    caps = [] if thick else [end for end in (low, high) if end != floor]
                    kinds["points"] += [
                        {**rows[i], "y": _rounded(end), "shape": SHAPES["–"], "size": 36, "width": mark.bars.width,
                         "opacity": 1.0} for end in caps
                    ]  # fmt: skip
        if mark.line:
            pieces = np.cumsum(~(np.isfinite(x) & np.isfinite(y)))
            kinds["lines"] += [
                {**rows[i], "width": mark.width, "dash": mark.line, "piece": f"{number}.{pieces[i]}"} for i in shown
            ]
        if mark.head and len(shown) == 2:
            kinds["points"].append({**rows[1], **_head(mark, x_ends, y_ends)})
        if mark.symbol or mark.hover:
            shape, size = (SHAPES[mark.symbol], mark.size) if mark.symbol else ("circle", 12.0)
            opacity = mark.opacity if mark.symbol else 0.0
            drawn = {"shape": shape, "size": size**2, "width": _edge(mark), "opacity": opacity}
            if mark.symbol or not mark.words:
                kinds["points"] += [{**rows[i], **drawn} for i in shown]
        if len(mark.words):
            kinds["words"] += [{**rows[i], "text": mark.words[i], "bold": mark.bold} for i in shown]
    return kinds


def _edge(mark: Mark) -> float:
    """Return the width of the edge of a mark's symbol."""
    return max(2.0, mark.width) if mark.symbol in STROKES else 0.0


def _head(mark: Mark, x_ends: tuple[float, float], y_ends: tuple[float, float]) -> Spec:
    """Return the head of an arrow, whose tip is its second point."""
    x, y = np.asarray(mark.x, float), np.asarray(mark.y, float)
    along = np.array([(x[1] - x[0]) * np.sign(x_ends[1] - x_ends[0]), (y[0] - y[1]) * np.sign(y_ends[1] - y_ends[0])])
    along = along / (np.hypot(*along) or 1.0)
    (left, up), (right, down) = (-along + side * 0.5 * np.array([-along[1], along[0]]) for side in (1, -1))
    path = f"M0,0L{left:.3f},{up:.3f}L{right:.3f},{down:.3f}Z"
    return {"shape": path, "size": (14 + 2 * mark.width) ** 2, "width": 0.0, "opacity": 1.0}


def _told(mark: Mark, x: Array, y: Array) -> list[str]:
    """Return what is told at each point of a mark; nothing is an empty text, since Vega says null as a word."""
    if not isinstance(mark.hover, str):
        return list(mark.hover) or [""] * len(x)
    texts = zip(x.tolist(), y.tolist(), strict=True)
    return [mark.hover.replace("{x}", f"{at:.3g}").replace("{y}", f"{value:.3g}") for at, value in texts]


def _rounded(value: float) -> float | None:
    """Return a number with five digits, as no screen shows more; None for what is not finite."""
    return float(f"{value:.5g}") if np.isfinite(value) else None


# Pages ---------------------------------------------------------------------------------------------------------------


def embedded(charts: Sequence[Chart]) -> dict[str, str]:
    """Return what `charts.html.j2` needs to draw charts: Vega, and their specifications by key."""
    if not charts:
        return {"vega": "", "figures": ""}
    specs = json.dumps({chart.key: spec(chart) for chart in charts}, allow_nan=False, separators=(",", ":"))
    return {"vega": packed_vega(), "figures": packed(specs)}


def packed(text: str) -> str:
    """Return a text in zlib's format as base64, for the page's script to unpack."""
    return base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii")


@cache
def packed_vega() -> str:
    """Return Vega in zlib's format as base64; made once a version, then from the user's cache."""
    folder = user_cache()
    kept = folder and folder / f"vega-{importlib.metadata.version('vl-convert-python')}.js.zz"
    if kept:
        with contextlib.suppress(OSError, zlib.error):
            found = kept.read_bytes()
            zlib.decompress(found)
            return base64.b64encode(found).decode("ascii")
    made = zlib.compress(_converter().javascript_bundle("window.vegaEmbed = vegaEmbed;").encode(), 9)
    if kept:
        with contextlib.suppress(OSError):
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(kept, lambda part: part.write_bytes(made))
    return base64.b64encode(made).decode("ascii")


# Files ---------------------------------------------------------------------------------------------------------------


def png(charts: Sequence[Chart]) -> bytes:
    """Draw one chart, or several in rows of three, as PNG."""
    width = _NARROWER if len(charts) > 1 else _WIDTH
    # Named ticks of x need room beside each other.
    named = max(len(panel.x.named or ()) for chart in charts for panel in chart.panels)
    width = width if len(charts) > 1 else max(width, 105 * named)
    cells = [_titled(chart, width) for chart in charts]
    whole: Spec = {"config": _CONFIG, "background": "white", "params": [_OFF]}
    whole |= {"concat": cells, "columns": _COLUMNS, "spacing": 30} if len(cells) > 1 else cells[0]
    return bytes(_converter().vegalite_to_png(whole, scale=_SCALE))


def _titled(chart: Chart, width: int) -> Spec:
    """Return a chart's panels with its title above and its legend below."""
    whole = spec(chart, width)
    views = whole.get("vconcat") or [{key: whole[key] for key in ("width", "height", "layer")}]
    views[0]["title"] = chart.title
    marks = [*chart.entries, *chart.keys]
    return {"vconcat": [*views, *([_legend(marks, width)] if marks else [])], "spacing": _GAP}


def _legend(marks: Sequence[Mark], width: int) -> Spec:
    """Return the legend of a file: entries in columns, one below the other in each."""
    wide = _HANDLE + 20 + max(pixels.font(_SMALL).getlength(mark.name) for mark in marks)
    count = -(-len(marks) // int(np.clip(width // wide, 1, min(4, len(marks)))))
    rows: list[Spec] = []
    for index, mark in enumerate(marks):
        column, row = divmod(index, count)
        left = column * wide
        rows.append(
            {"y": _ROW * (row + 0.5), "x": left, "end": left + 28, "middle": left + 14, "beside": left + _HANDLE,
             "text": mark.name, "colour": mark.colour, "dash": mark.line, "width": max(mark.width, 1.2),
             "shape": SHAPES.get(mark.symbol, ""), "size": max(mark.size, 7.0) ** 2, "edge": _edge(mark)}
        )  # fmt: skip

    def layer(mark: Spec, wanted: str, x: str, **more: Any) -> Spec:
        placed = {name: {**_direct(column), "axis": None} for name, column in (("x", x), ("y", "y"))}
        return {"data": {"values": [row for row in rows if row[wanted]]}, "mark": mark, "encoding": placed | more}

    colour, edge = _direct("colour", "nominal"), _direct("edge")
    layers = [
        layer({"type": "rule"}, "dash", "x", x2={"field": "end"}, stroke=colour, strokeWidth=_direct("width"),
              strokeDash=_DASH_CHANNEL),
        layer({"type": "point", "opacity": 1}, "shape", "middle", shape=_direct("shape", "nominal"), fill=colour,
              stroke=colour, size=_direct("size"), strokeWidth=edge),
        layer({"type": "text", "align": "left", "fontSize": _SMALL, "color": _INK}, "text", "beside",
              text={"field": "text", "type": "nominal"}),
    ]  # fmt: skip
    return {"width": width, "height": _ROW * count, "view": {"stroke": None}, "layer": layers}


@cache
def _converter() -> ModuleType:
    """Return vl-convert, which takes a while to load, with the font of all figures."""
    import vl_convert

    # Fonts of the system would differ from machine to machine.
    vl_convert.register_font_directory(str(pixels.fonts()))
    return vl_convert
