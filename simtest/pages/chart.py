"""A figure, described once: `web` draws it in pages, `png` in files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from simtest.pages.axes import Axis
from simtest.pages.style import NEUTRAL, Array, Symbol, symbols

Line = Literal["solid", "dash", "dashdot", "dot", ""]

NOTHING: Array = np.empty(0)


class Bars(NamedTuple):
    """Vertical bars at the points of a mark, `width` px; thick ones are faint and have no caps."""

    low: Array
    high: Array
    width: float = 1.0

    @property
    def is_thick(self) -> bool:
        """Whether the bars are drawn faint and without caps."""
        return self.width >= 3


@dataclass(frozen=True)
class Mark:
    """Points that belong together: joined, marked, with bars or words. Sizes and widths are px of the page.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        Data coordinates; NaN leaves a gap. A log axis shows no value <= 0. Without points, a mark is a legend entry.
    colour : str
        Hexadecimal.
    name : str
        Marks of one name are switched together; the first of them with a line or symbol is its entry in the legend.
    listed : bool
        Whether the mark may be that entry.
    line, width : str, float
        How points are joined, "" for not at all.
    symbol, size : Symbol or None, float
        Marker.
    bars : Bars or None
        Bars at the points.
    words : sequence of str
        Written at the points; `bold` or not.
    hover : str or sequence of str
        Told at each point. A single text may hold {x} and {y}.
    fill : bool
        Fill the outline; its hover is a single text, told anywhere inside.
    opacity : float
        Of all of it.
    head : bool
        Draw a line as an arrow (files only).
    """

    x: npt.ArrayLike
    y: npt.ArrayLike
    colour: str
    name: str = ""
    listed: bool = True
    line: Line = ""
    width: float = 1.6
    symbol: Symbol | None = None
    size: float = 7.0
    bars: Bars | None = None
    words: Sequence[str] = ()
    bold: bool = False
    hover: str | Sequence[str] = ()
    fill: bool = False
    opacity: float = 1.0
    head: bool = False


class Picture(NamedTuple):
    """A grey picture in [0, 1] below the marks of a panel; `extent` is x0, x1, y1, y0. Files only."""

    values: npt.NDArray[np.float32]
    extent: tuple[float, float, float, float]


@dataclass(frozen=True)
class Panel:
    """A pair of axes with its marks; `share` is its part of the figure's height.

    With `equal`, both axes have one scale.
    """

    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    share: float = 1.0
    equal: bool = False
    picture: Picture | None = None

    @property
    def heights(self) -> list[npt.ArrayLike]:
        """All y that marks and bars reach."""
        return [part for mark in self.marks for part in (mark.y, *((mark.bars or ())[:2]))]


@dataclass(frozen=True)
class Chart:
    """A figure.

    Parameters
    ----------
    key : str
        Name of the figure in its page.
    title : str
        Heading.
    panels : tuple of Panel
        One above the other, with one x axis.
    height : int
        px of the page, without the legend.
    keys : tuple of Mark
        Further legend entries: what symbols and colours stand for.
    """

    key: str
    title: str
    panels: tuple[Panel, ...]
    height: int = 420
    keys: tuple[Mark, ...] = ()

    @property
    def widths(self) -> list[npt.ArrayLike]:
        """All x that marks reach."""
        return [mark.x for panel in self.panels for mark in panel.marks]

    @property
    def entries(self) -> list[Mark]:
        """Marks that stand in the legend, one a name."""
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
