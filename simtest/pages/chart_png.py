"""Draws charts in files: matplotlib without pyplot and its layout engines, which cost most of the time."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Axis
from simtest.pages.chart import Bars, Chart, Mark, Panel
from simtest.runtime.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Pixels = npt.NDArray[np.uint8]
DPI = 150
PX = 0.78  # points a px of the page

# All in inches: widths of a chart alone and of one of several, of which so many stand in a row; ...
SINGLE, SEVERAL, COLUMNS = 7.8, 4.8, 3
# ... margins, a row of the legend, space between panels; width of a letter and of a legend entry's line.
LEFT, RIGHT, TOP, BOTTOM, ROW, GAP = 0.85, 0.15, 0.36, 0.56, 0.2, 0.12
LETTER, HANDLE = 0.066, 0.55
DASHES = {"solid": "-", "dash": "--", "dashdot": "-.", "dot": ":", "": ""}
_SETTINGS = {
    "font.size": 10, "axes.grid": True, "grid.alpha": 0.3, "axes.axisbelow": True, "axes.titlesize": 11,
    "legend.frameon": False, "figure.facecolor": "white", "text.parse_math": False, "axes.unicode_minus": False,
}  # fmt: skip


class _Cell(NamedTuple):
    """The part of a picture that a chart takes, inches, y upwards."""

    left: float
    low: float
    width: float
    height: float


@contextmanager
def settings() -> Iterator[None]:
    """Draw all figures within alike; not in several threads at a time."""
    import matplotlib

    with matplotlib.rc_context(cast(Any, _SETTINGS)):
        yield


def draw(charts: Sequence[Chart]) -> tuple[Pixels, list[Pixels]]:
    """Draw one chart, or several in rows of three, as one picture.

    Returns
    -------
    (ndarray, list of ndarray), uint8, shapes (H, W, 3)
        The picture, RGB, and the part of it that each chart takes.
    """
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(charts))
    # Named ticks of x need room beside each other.
    named = max(len(panel.x.named or ()) for chart in charts for panel in chart.panels)
    width = max(SINGLE, 1.0 + 1.1 * named) if columns == 1 else SEVERAL
    heights = [chart.height / 96 + ROW * _legend_shape(chart, width)[0] for chart in charts]
    rows = [max(heights[first : first + columns]) for first in range(0, len(charts), columns)]
    cells = []
    with settings():
        figure = Figure((columns * width, sum(rows)), dpi=DPI)
        for index, (chart, height) in enumerate(zip(charts, heights, strict=True)):
            row, column = divmod(index, columns)
            cell = _Cell(column * width, sum(rows[row:]) - height, width, height)
            _draw_chart(figure, chart, cell)
            cells.append(np.rint(DPI * np.array([cell.left, sum(rows[:row]), width, height])).astype(int))
        whole = pixels(figure)
    return whole, [whole[y : y + h, x : x + w] for x, y, w, h in cells]


def pixels(figure: "Figure") -> Pixels:
    """Return a figure's pixels, RGB."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def _legend_shape(chart: Chart, width: float) -> tuple[int, int]:
    """Return the rows and columns of a chart's legend."""
    names = [mark.name for mark in (*chart.entries, *chart.keys)]
    if not names:
        return 0, 1
    wide = HANDLE + LETTER * max(len(name) for name in names)
    columns = int(np.clip((width - 0.2) / wide, 1, min(4, len(names))))
    return -(-len(names) // columns), columns


def _draw_chart(figure: "Figure", chart: Chart, cell: _Cell) -> None:
    size = figure.get_size_inches()
    rows, columns = _legend_shape(chart, cell.width)
    # Named ticks of y need room for their texts.
    names = [text for panel in chart.panels for _, text in panel.y.named or ()]
    margin = max(LEFT, 0.4 + LETTER * max((len(text) for text in names), default=0))
    room = cell.height - TOP - BOTTOM - ROW * rows - GAP * (len(chart.panels) - 1)
    top = cell.low + cell.height - TOP
    for panel in chart.panels:
        height = room * panel.share / sum(each.share for each in chart.panels)
        box = np.array([cell.left + margin, top - height, cell.width - margin - RIGHT, height]) / [*size, *size]
        ax = figure.add_axes((box[0], box[1], box[2], box[3]))
        _draw_panel(ax, panel, chart.all_x)
        if panel is chart.panels[0]:
            # A title with a height of its own is not moved about ticks that it would have to look for.
            ax.set_title(chart.title, y=1.0)
        if panel is chart.panels[-1]:
            ax.set_xlabel(panel.x.title)
        else:
            ax.tick_params(labelbottom=False)
        top -= height + GAP
    if rows:
        middle = (cell.left + cell.width / 2) / size[0], cell.low / size[1]
        handles = [_handle(mark) for mark in (*chart.entries, *chart.keys)]
        figure.legend(handles=handles, ncol=columns, fontsize=8.5, loc="lower center", bbox_to_anchor=middle)


def _handle(mark: Mark) -> Any:
    """Return the legend entry of a mark."""
    from matplotlib.lines import Line2D

    return Line2D(
        [], [], color=mark.colour, lw=max(mark.width, 1.2) * PX, ls=DASHES[mark.line], label=mark.name,
        marker=mark.symbol.matplotlib if mark.symbol else None, ms=max(mark.size, 7) * PX, mew=mark.width * PX,
    )  # fmt: skip


def _draw_panel(ax: "Axes", panel: Panel, all_x: list[npt.ArrayLike]) -> None:
    _scale(ax, panel.x, "x", all_x)
    _scale(ax, panel.y, "y", panel.all_y)
    ax.set_ylabel(panel.y.title)
    if panel.picture is not None:
        ax.grid(False)
        ax.imshow(panel.picture.values, cmap="gray", vmin=0, vmax=1, extent=panel.picture.extent, aspect="auto")
    if panel.equal:
        ax.set_aspect("equal")
    for order, mark in enumerate(panel.marks):
        _draw_mark(ax, mark, panel, 2 + 0.01 * order)


def _scale(ax: "Axes", axis: Axis, which: str, values: list[npt.ArrayLike]) -> None:
    from matplotlib.ticker import NullLocator

    if axis.scale == "log":
        getattr(ax, f"set_{which}scale")("log")
    low, high = axis.ends(values)
    getattr(ax, f"set_{which}lim")(low, high)
    ticks = axis.ticks(low, high)
    if ticks is None:
        return
    part = ax.xaxis if which == "x" else ax.yaxis
    part.set_ticks([at for at, _ in ticks], labels=[text for _, text in ticks])
    part.set_minor_locator(NullLocator())
    minor = axis.minor_ticks(low, high)
    if minor:
        # One mark: as many ticks of matplotlib's own take longer than all else.
        edge = np.zeros(len(minor))
        x, y, symbol = (minor, edge, "|") if which == "x" else (edge, minor, "_")
        along = ax.get_xaxis_transform() if which == "x" else ax.get_yaxis_transform()
        ax.plot(x, y, symbol, color="black", ms=4, mew=0.6, transform=along, clip_on=False, scalex=False, scaley=False)


def _draw_mark(ax: "Axes", mark: Mark, panel: Panel, order: float) -> None:
    x, y = panel.x.to_axis(mark.x), panel.y.visible(np.asarray(mark.y, float))
    if mark.bars:
        _draw_bars(ax, mark.bars, x, mark.colour, order)
    if mark.head:
        look = {"arrowstyle": "-|>", "color": mark.colour, "lw": mark.width * PX, "ls": DASHES[mark.line],
                "shrinkA": 0, "shrinkB": 0, "mutation_scale": 12 + 2 * mark.width}  # fmt: skip
        ax.annotate("", (x[-1], y[-1]), (x[0], y[0]), zorder=order, arrowprops=look)
    elif mark.fill:
        ax.fill(x, y, lw=0, color=mark.colour, zorder=order)
    elif mark.line or mark.symbol:
        ax.plot(
            x, y, ls=DASHES[mark.line] or "none", lw=mark.width * PX, ms=mark.size * 0.7, mew=mark.width * PX,
            marker=mark.symbol.matplotlib if mark.symbol else None, color=mark.colour, alpha=mark.opacity, zorder=order,
        )  # fmt: skip
    for px, py, word in zip(x, y, mark.words, strict=False):
        weight = "bold" if mark.bold else "normal"
        ax.text(px, py, word, ha="center", va="center", fontsize=8.5, color=mark.colour, fontweight=weight)


def _draw_bars(ax: "Axes", bars: Bars, x: Array, colour: str, order: float) -> None:
    # The lower end of a bar that leaves a log axis is drawn at its edge.
    low = np.maximum(bars.low, ax.get_ylim()[0]) if ax.get_yscale() == "log" else bars.low
    width = bars.width * PX
    ax.vlines(x, low, bars.high, color=colour, lw=width, alpha=0.4 if bars.is_thick else 1, zorder=order)
    if not bars.is_thick:
        ax.plot(np.tile(x, 2), np.concatenate([low, bars.high]), "_", color=colour, ms=6, mew=width, zorder=order)
