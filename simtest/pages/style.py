"""One place for colours, symbols, number formats and axes, so that both drawing backends agree."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ESTIMATOR_COLOURS = {
    "cone_axis": "#0072B2",
    "circle_pose": "#D55E00",
    "brightest_point": "#009E73",
    "bisector": "#CC79A7",
    "curved": "#56B4E9",
    "photometric": "#E69F00",
    "inverse_rendering": "#8A6FC9",
}
"""Colours of Okabe and Ito's colour-blind-safe palette, plus one violet."""

_FURTHER = ("#A6761D", "#7A8B99", "#B2478F", "#4E9A9A", "#9A9A2E", "#C08A7A")

NEUTRAL = "#7D828A"
"""Grey of laws and truth: readable on light and on dark."""

LIGHT = "#F2C500"
"""Yellow of lights in 3D views."""

TRUTH = "#F5D90A"
"""Yellow of the truth on top of frames."""

SEQUENTIAL = "cividis"
"""Colour map of heat maps; perceptually uniform and colour-blind-safe."""


class Symbol(NamedTuple):
    """One marker, by its name in matplotlib, in plotly and as a character."""

    matplotlib: str
    plotly: str
    text: str


_SYMBOLS = (
    Symbol("o", "circle", "●"),
    Symbol("s", "square", "■"),
    Symbol("^", "triangle-up", "▲"),
    Symbol("D", "diamond", "◆"),
    Symbol("v", "triangle-down", "▼"),
    Symbol("P", "cross", "✚"),
    Symbol("X", "x", "✖"),
    Symbol("*", "star", "★"),
)


def colours(estimators: Iterable[str]) -> dict[str, str]:
    """Give each estimator its colour; names without a fixed one take further colours in alphabetical order.

    Parameters
    ----------
    estimators : iterable of str
        Names, in any order.

    Returns
    -------
    dict of str to str
        Hexadecimal colours by name.
    """
    names = list(dict.fromkeys(estimators))
    unknown = sorted(name for name in names if name not in ESTIMATOR_COLOURS)
    further = {name: _FURTHER[i % len(_FURTHER)] for i, name in enumerate(unknown)}
    return {name: ESTIMATOR_COLOURS.get(name) or further[name] for name in names}


def estimator_order(names: Iterable[str]) -> list[str]:
    """Sort estimator names: the known ones in the order of the palette, then the others by name."""
    known = list(ESTIMATOR_COLOURS)
    return sorted(set(names), key=lambda name: (known.index(name) if name in known else len(known), name))


def symbols(labels: Iterable[str]) -> dict[str, Symbol]:
    """Give each curve label its marker, in order of appearance."""
    return {label: _SYMBOLS[i % len(_SYMBOLS)] for i, label in enumerate(dict.fromkeys(labels))}


def number(value: Any, digits: int = 3) -> str:
    """Write a number with a few significant digits; what is null or not finite becomes a dash."""
    if value is None or isinstance(value, str | bool) or not np.isfinite(value):
        return "–"
    if isinstance(value, int):
        return str(value)
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        text = f"{value:.{digits}g}"
        return f"{value:.0f}" if "e" in text else text
    return f"{value:.{digits - 1}e}"


def degrees(value: Any) -> str:
    """Write an angle that is given in degrees."""
    text = number(value)
    return text if text == "–" else f"{text}°"


_STRETCH = 0.01
_TICKS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)


@dataclass(frozen=True)
class Axis:
    """An axis of a figure.

    Parameters
    ----------
    title : str
        Name and unit.
    scale : {"linear", "log", "stretched"}
        "stretched" is asinh(x / 0.01), near-logarithmic on both sides of zero; both backends draw at `place(x)`.
    limits : (float, float), optional
        Range in data units, for linear axes.
    """

    title: str
    scale: Literal["linear", "log", "stretched"] = "linear"
    limits: tuple[float, float] | None = None

    def place(self, values: npt.ArrayLike) -> Array:
        """Give the drawing coordinates of data values, same shape."""
        data = np.asarray(values, dtype=float)
        return np.arcsinh(data / _STRETCH) if self.scale == "stretched" else data

    def unplace(self, places: npt.ArrayLike) -> Array:
        """Give the data values at drawing coordinates, same shape."""
        data = np.asarray(places, dtype=float)
        return np.sinh(data) * _STRETCH if self.scale == "stretched" else data

    def ticks(self, values: npt.ArrayLike) -> tuple[list[float], list[str]] | None:
        """Give tick places and texts that cover the values of a stretched axis; None leaves them to the backend."""
        data = np.asarray(values, dtype=float)
        data = data[np.isfinite(data)]
        if self.scale != "stretched" or not data.size:
            return None
        low, high = float(data.min()) * 1.8, float(data.max()) * 1.8
        every = sorted({0.0, *(sign * tick for tick in _TICKS[1:] for sign in (-1, 1))})
        ticks = [tick for tick in every if min(low, 0) <= tick <= max(high, 0)]
        return [float(p) for p in self.place(ticks)], [f"{t:g}".replace("-", "−") for t in ticks]


def curvature_axis(values: npt.ArrayLike, title: str) -> Axis:
    """Choose the axis for curvature: stretched where the values span more than a factor of ten, else linear.

    The smallest twentieth and the largest do not count: among the many highlights of anatomies there are always some.
    """
    size = np.abs(np.asarray(values, dtype=float))
    size = size[np.isfinite(size) & (size > 1e-9)]
    wide = size.size > 1 and np.quantile(size, 0.95) / np.quantile(size, 0.05) > 10
    return Axis(title, "stretched" if wide else "linear")


def hexadecimal(colour: Sequence[float]) -> str:
    """Write a colour, red, green and blue in [0, 1] first."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour[:3])


def labelled(names: Sequence[str]) -> str:
    """Join names as an English list."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
