"""Draws charts in files, on a `Sheet`: every part is laid out once, from the sizes of its texts."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Axis, Tick, even_ticks
from simtest.pages.chart import Bars, Chart, Mark, Panel, Picture
from simtest.pages.sheet import Pixels, Sheet, text_width
from simtest.runtime.arrays import Array

__all__ = ["DPI", "Pixels", "draw"]

DPI = 150
PX = 0.78  # points a px of the page

# All in inches: widths of a chart alone and of one of several, of which so many stand in a row; ...
SINGLE, SEVERAL, COLUMNS = 7.8, 4.8, 3
# ... margins, a row of the legend, space between panels; width of a letter and of a legend entry's line.
LEFT, RIGHT, TOP, BOTTOM, ROW, GAP = 0.85, 0.15, 0.36, 0.56, 0.2, 0.12
LETTER, HANDLE = 0.066, 0.55

# All in points: sizes of texts, lines of the frame, ticks, and spaces about texts.
TEXT, TITLE, SMALL = 10.0, 11.0, 8.5
EDGE, TICK, MINOR, PAD, TITLE_PAD = 0.8, 3.5, 2.0, 3.5, 6.0
CAP, HEAD = 6.0, 0.4  # width of a bar's cap; length of an arrow's head over its scale
_INK, _GRID = "#000000", "#E7E7E7"
_FAINT = 0.4  # opacity of thick bars


@dataclass(frozen=True)
class _Frame:
    """The axes of a panel: its rectangle, whole px of the picture, and the ends of x and y in drawing coordinates."""

    left: int
    top: int
    right: int
    low: int
    x: tuple[float, float]
    y: tuple[float, float]
    log_x: bool
    log_y: bool

    def px(self, values: npt.ArrayLike) -> Array:
        """Return the columns of drawing coordinates of x, px."""
        return self.left + _share(values, self.x, self.log_x) * (self.right - self.left)

    def py(self, values: npt.ArrayLike) -> Array:
        """Return the rows of drawing coordinates of y, px."""
        return self.low - _share(values, self.y, self.log_y) * (self.low - self.top)

    def points(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Array:
        """Return points, px, shape (n, 2)."""
        return np.stack(np.broadcast_arrays(self.px(x), self.py(y)), axis=-1)


def _share(values: npt.ArrayLike, ends: tuple[float, float], is_log: bool) -> Array:
    data, span = np.asarray(values, float), np.array(ends)
    if is_log:
        with np.errstate(divide="ignore", invalid="ignore"):
            data, span = np.log10(data), np.log10(span)
    return np.asarray((data - span[0]) / ((span[1] - span[0]) or 1.0))


def _pt(points: float) -> float:
    """Return points as px of the picture."""
    return points * DPI / 72


def draw(charts: Sequence[Chart]) -> tuple[Pixels, list[Pixels]]:
    """Draw one chart, or several in rows of three, as one picture.

    Returns
    -------
    (ndarray, list of ndarray), uint8, shapes (H, W, 3)
        The picture, RGB, and the part of it that each chart takes.
    """
    columns = min(COLUMNS, len(charts))
    # Named ticks of x need room beside each other.
    named = max(len(panel.x.named or ()) for chart in charts for panel in chart.panels)
    width = max(SINGLE, 1.0 + 1.1 * named) if columns == 1 else SEVERAL
    heights = [chart.height / 96 + ROW * _legend_shape(chart, width)[0] for chart in charts]
    rows = [max(heights[first : first + columns]) for first in range(0, len(charts), columns)]
    sheet, parts = Sheet.white(round(DPI * columns * width), round(DPI * sum(rows))), []
    for index, (chart, height) in enumerate(zip(charts, heights, strict=True)):
        row, column = divmod(index, columns)
        left, top = DPI * column * width, DPI * sum(rows[:row])
        cell = sheet.part(left, top, left + DPI * width, top + DPI * height)
        _draw_chart(cell, chart, width)
        parts.append(cell.pixels)
    return sheet.pixels, parts


def _legend_shape(chart: Chart, width: float) -> tuple[int, int]:
    """Return the rows and columns of a chart's legend."""
    names = [mark.name for mark in (*chart.entries, *chart.keys)]
    if not names:
        return 0, 1
    wide = HANDLE + LETTER * max(len(name) for name in names)
    columns = int(np.clip((width - 0.2) / wide, 1, min(4, len(names))))
    return -(-len(names) // columns), columns


def _draw_chart(cell: Sheet, chart: Chart, width: float) -> None:
    """Draw a chart into its part of a picture: title, panels and legend from top to bottom."""
    rows, columns = _legend_shape(chart, width)
    # Named ticks of y need room for their texts.
    names = [text for panel in chart.panels for _, text in panel.y.named or ()]
    margin = max(LEFT, 0.4 + LETTER * max((len(text) for text in names), default=0))
    height = cell.pixels.shape[0]
    room = height - DPI * (TOP + BOTTOM + ROW * rows + GAP * (len(chart.panels) - 1))
    left, right = cell.left + DPI * margin, cell.left + cell.pixels.shape[1] - DPI * RIGHT
    top = cell.top + DPI * TOP
    for panel in chart.panels:
        low = top + room * panel.share / sum(each.share for each in chart.panels)
        frame = _frame(panel, chart.all_x, (left, top, right, low))
        if panel is chart.panels[0]:
            above = (frame.left + frame.right) / 2, frame.top - _pt(TITLE_PAD)
            cell.text(above, chart.title, _pt(TITLE), down=0.8)
        _draw_panel(cell, frame, panel, is_last=panel is chart.panels[-1])
        top = low + DPI * GAP
    if rows:
        handles = [*chart.entries, *chart.keys]
        draw_legend(
            cell, handles, columns, (left + right) / 2 - DPI * (margin - RIGHT) / 2, cell.top + height, DPI / 72
        )


def _frame(panel: Panel, all_x: list[npt.ArrayLike], box: tuple[float, float, float, float]) -> _Frame:
    """Place a panel's axes in a box, px; those with one scale take its middle."""
    x, y = panel.x.ends(all_x), panel.y.ends(panel.all_y)
    left, top, right, low = box
    if panel.equal:
        wide, high = abs(x[1] - x[0]), abs(y[1] - y[0])
        scale = min((right - left) / wide, (low - top) / high)
        middle, centre = (left + right) / 2, (top + low) / 2
        left, right = middle - scale * wide / 2, middle + scale * wide / 2
        top, low = centre - scale * high / 2, centre + scale * high / 2
    corners = (round(left), round(top), round(right), round(low))
    return _Frame(*corners, x, y, panel.x.scale == "log", panel.y.scale == "log")


# Legend --------------------------------------------------------------------------------------------------------------


def draw_legend(sheet: Sheet, handles: Sequence[Mark], columns: int, middle: float, low: float, pt: float) -> None:
    """Write legend entries in columns, one below the other in each, about a middle and above a bottom edge, px.

    `pt` is the size of a point, px.
    """
    size, row = pt * SMALL, pt * 72 * ROW
    count = -(-len(handles) // columns)
    # The first columns are the longer ones.
    ends = [-(-len(handles) * number // columns) for number in range(columns + 1)]
    groups = [list(handles[first:end]) for first, end in itertools.pairwise(ends)]
    widths = [2.8 * size + max(text_width(mark.name, size) for mark in group) for group in groups]
    gap = 2.0 * size
    left = middle - (sum(widths) + gap * (len(widths) - 1)) / 2
    for group, width in zip(groups, widths, strict=True):
        for index, mark in enumerate(group):
            y = low - (count - index - 0.5) * row - 0.4 * size
            _draw_handle(sheet, mark, left, y, 2.0 * size, pt)
            sheet.text((left + 2.8 * size, y), mark.name, size, across=0.0)
        left += width + gap


def _draw_handle(sheet: Sheet, mark: Mark, left: float, y: float, width: float, pt: float) -> None:
    if mark.line:
        sheet.line([(left, y), (left + width, y)], mark.colour, max(mark.width, 1.2) * PX * pt, mark.line)
    if mark.symbol:
        middle = [(left + width / 2, y)]
        sheet.markers(middle, mark.symbol.letter, max(mark.size, 7) * PX * pt, mark.colour, mark.width * PX * pt)


# Panel ---------------------------------------------------------------------------------------------------------------


def _draw_panel(cell: Sheet, frame: _Frame, panel: Panel, is_last: bool) -> None:
    inside = cell.part(frame.left, frame.top, frame.right, frame.low)
    x_ticks, y_ticks = (
        _ticks(panel.x, frame.x, frame.right - frame.left, 3.0),
        _ticks(panel.y, frame.y, frame.low - frame.top, 2.0),
    )
    # What lies inside: grid or picture, then the marks in their order, then the words.
    if panel.picture is None:
        _draw_grid(inside, frame, x_ticks, y_ticks)
    else:
        _draw_picture(inside, frame, panel.picture)
    for mark in panel.marks:
        _draw_mark(inside, frame, mark, panel)
    for mark in panel.marks:
        at = frame.points(panel.x.to_axis(mark.x), panel.y.visible(np.asarray(mark.y, float)))
        for point, word in zip(at, mark.words, strict=False):
            if np.isfinite(point).all():
                cell.text((point[0], point[1]), word, _pt(SMALL), mark.colour, bold=mark.bold)
    # About it: frame, ticks and titles.
    _draw_edges(cell, frame)
    low = _draw_x_ticks(cell, frame, panel.x, x_ticks, is_last)
    left = _draw_y_ticks(cell, frame, panel.y, y_ticks)
    if is_last:
        cell.text(((frame.left + frame.right) / 2, low), panel.x.title, _pt(TEXT), down=0.0)
    cell.text((left - _pt(PAD), (frame.top + frame.low) / 2), panel.y.title, _pt(TEXT), across=1.0, turn_deg=90)


def _ticks(axis: Axis, ends: tuple[float, float], length: float, room: float) -> list[Tick]:
    """Return the ticks of an axis of a length, px, of which each needs a room in heights of the text."""
    ticks = axis.ticks(*ends)
    return even_ticks(*ends, min(9, int(length / (room * _pt(TEXT))))) if ticks is None else ticks


def _edge(at: float) -> tuple[float, float]:
    """Return both sides of a line of the frame or grid, whole px."""
    width = max(1, round(_pt(EDGE)))
    first = math.floor(at - width / 2 + 0.5)
    return first, first + width


def _draw_edges(cell: Sheet, frame: _Frame) -> None:
    (x0, x1), (x2, x3) = _edge(frame.left), _edge(frame.right)
    (y0, y1), (y2, y3) = _edge(frame.top), _edge(frame.low)
    for box in ((x0, y0, x3, y1), (x0, y2, x3, y3), (x0, y0, x1, y3), (x2, y0, x3, y3)):
        cell.box(*box, _INK)


def _draw_grid(inside: Sheet, frame: _Frame, x_ticks: list[Tick], y_ticks: list[Tick]) -> None:
    for at, _ in x_ticks:
        x0, x1 = _edge(float(frame.px(at)))
        inside.box(x0, frame.top, x1, frame.low, _GRID)
    for at, _ in y_ticks:
        y0, y1 = _edge(float(frame.py(at)))
        inside.box(frame.left, y0, frame.right, y1, _GRID)


def _draw_x_ticks(cell: Sheet, frame: _Frame, axis: Axis, ticks: list[Tick], is_told: bool) -> float:
    """Draw the ticks of x, and return where its title begins, px."""
    end, text_end = frame.low + _pt(TICK), frame.low + _pt(TICK)
    for at, text in ticks:
        x0, x1 = _edge(float(frame.px(at)))
        cell.box(x0, frame.low, x1, end, _INK)
        if is_told:
            # Above figures there is room in the text itself.
            top = end + _pt(PAD) - _pt(TEXT) / 5
            height = cell.text(((x0 + x1) / 2, top), text, _pt(TEXT), down=0.0)[1]
            text_end = max(text_end, top + height)
    for at in axis.minor_ticks(*frame.x):
        x0, _ = _edge(float(frame.px(at)))
        cell.box(x0, frame.low - _pt(MINOR), x0 + 1, frame.low + _pt(MINOR), _INK)
    return text_end


def _draw_y_ticks(cell: Sheet, frame: _Frame, axis: Axis, ticks: list[Tick]) -> float:
    """Draw the ticks of y, and return where its title ends, px."""
    end, text_end = frame.left - _pt(TICK), frame.left - _pt(TICK)
    for at, text in ticks:
        y0, y1 = _edge(float(frame.py(at)))
        cell.box(end, y0, frame.left, y1, _INK)
        right = end - _pt(PAD)
        width = cell.text((right, (y0 + y1) / 2), text, _pt(TEXT), across=1.0)[0]
        text_end = min(text_end, right - width)
    for at in axis.minor_ticks(*frame.y):
        y0, _ = _edge(float(frame.py(at)))
        cell.box(frame.left - _pt(MINOR), y0, frame.left + _pt(MINOR), y0 + 1, _INK)
    return text_end


def _draw_picture(inside: Sheet, frame: _Frame, picture: Picture) -> None:
    x0, x1, y1, y0 = picture.extent
    (left, right), (top, low) = frame.px([x0, x1]).round().astype(int), frame.py([y0, y1]).round().astype(int)
    values = np.clip(np.rint(255 * np.asarray(picture.values, float)), 0, 255).astype(np.uint8)
    size = max(int(right - left), 1), max(int(low - top), 1)
    is_larger = size[0] >= values.shape[1]
    drawn = cv2.resize(values, size, interpolation=cv2.INTER_NEAREST if is_larger else cv2.INTER_AREA)
    part = inside.part(left, top, right, low)
    drawn = drawn[part.top - top :, part.left - left :][: part.pixels.shape[0], : part.pixels.shape[1]]
    part.pixels[...] = drawn[..., None]


# Marks ---------------------------------------------------------------------------------------------------------------


def _draw_mark(inside: Sheet, frame: _Frame, mark: Mark, panel: Panel) -> None:
    points = frame.points(panel.x.to_axis(mark.x), panel.y.visible(np.asarray(mark.y, float)))
    width = _pt(mark.width * PX)
    if mark.bars:
        _draw_bars(inside, frame, mark.bars, points[:, 0], mark.colour)
    if mark.head:
        _draw_arrow(inside, points[[0, -1]], mark, width)
        return
    if mark.fill:
        inside.outline(points, mark.colour)
        return
    if mark.line:
        inside.line(points, mark.colour, width, mark.line)
    if mark.symbol is None:
        return
    size = _pt(mark.size * 0.7)
    if mark.opacity >= 1:
        inside.markers(points, mark.symbol.letter, size, mark.colour, width)
        return
    reach = size + width
    for x, y in points[np.isfinite(points).all(axis=1)].tolist():
        with inside.faint((x - reach, y - reach, x + reach, y + reach), mark.opacity) as layer:
            layer.markers([(x, y)], mark.symbol.letter, size, mark.colour, width)


def _draw_bars(inside: Sheet, frame: _Frame, bars: Bars, x: Array, colour: str) -> None:
    # The lower end of a bar that leaves a log axis is drawn at its edge.
    low = np.maximum(bars.low, frame.y[0]) if frame.log_y else np.asarray(bars.low, float)
    width, cap = _pt(bars.width * PX), _pt(CAP) / 2
    feet, heads = frame.py(low), frame.py(bars.high)
    for at, foot, head in zip(x.tolist(), feet.tolist(), heads.tolist(), strict=True):
        if not np.isfinite([at, foot, head]).all():
            continue
        if bars.is_thick:
            box = at - width / 2, head, at + width / 2, foot
            with inside.faint(box, _FAINT) as layer:
                layer.box(*box, colour)
            continue
        # Boxes of whole px are sharp.
        half = max(1, round(width)) / 2
        inside.box(at - half, head, at + half, foot, colour)
        for y in (foot, head):
            inside.box(at - cap, y - half, at + cap, y + half, colour)


def _draw_arrow(inside: Sheet, ends: Array, mark: Mark, width: float) -> None:
    """Draw a line with a filled head at its end."""
    along = ends[1] - ends[0]
    length = float(np.hypot(*along))
    if not length > 0:
        return
    along = along / length
    across = np.array([-along[1], along[0]])
    reach = min(HEAD * _pt(12 + 2 * mark.width) + width, length)
    neck = ends[1] - reach * along
    inside.line([ends[0], neck], mark.colour, width, mark.line or "solid")
    inside.outline([ends[1], neck + reach / 2 * across, neck - reach / 2 * across], mark.colour)
