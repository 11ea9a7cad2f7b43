"""A figure, described once: `chart_web` draws it in pages, `chart_png` in files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Axis
from simtest.pages.style import NEUTRAL, Symbol, symbols
from simtest.runtime.arrays import Array, Image

Line = Literal["solid", "dash", "dashdot", "dot", ""]

NOTHING: Array = np.empty(0)


class Bars(NamedTuple):
    """Vertical bars at the points of a mark; thick ones are faint and have no caps."""

    low: Array
    high: Array
    width: float = 1.0

    @property
    def is_thick(self) -> bool:
        """Whether the bars are drawn faint and without caps."""
        return self.width >= 3


@dataclass(frozen=True)
class Mark:
    """Points that belong together: joined, marked, with bars or words. Sizes and widths are px of the page."""

    x: npt.ArrayLike  # data coordinates, shape (n,); NaN leaves a gap. Without points, a mark is a legend entry
    y: npt.ArrayLike
    colour: str
    name: str = ""  # marks of one name are switched together, and have one entry in the legend
    listed: bool = True  # whether the mark may be that entry
    line: Line = ""  # how points are joined, "" for not at all
    width: float = 1.6
    symbol: Symbol | None = None
    size: float = 7.0
    bars: Bars | None = None
    words: Sequence[str] = ()  # written at the points
    bold: bool = False
    hover: str | Sequence[str] = ()  # told at each point; a single text may hold {x} and {y}
    fill: bool = False  # fill the outline; its hover is a single text, told anywhere inside
    opacity: float = 1.0
    head: bool = False  # draw a line as an arrow; in files only


class Picture(NamedTuple):
    """A grey picture in [0, 1] below the marks of a panel; in files only."""

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

    @property
    def all_y(self) -> list[npt.ArrayLike]:
        """All y that marks and bars reach."""
        return [part for mark in self.marks for part in (mark.y, *((mark.bars or ())[:2]))]


@dataclass(frozen=True)
class Chart:
    """A figure of panels one above the other, with one x axis."""

    key: str  # name of the figure in its page
    title: str
    panels: tuple[Panel, ...]
    height: int = 420  # px of the page, without the legend
    keys: tuple[Mark, ...] = ()  # further legend entries: what symbols and colours stand for

    @property
    def all_x(self) -> list[npt.ArrayLike]:
        """All x that marks reach."""
        return [mark.x for panel in self.panels for mark in panel.marks]

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
