"""Colours, symbols and number formats of all pages and figures."""

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

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
NEUTRAL = "#7D828A"  # grey of laws and truth: readable on light and on dark
LIGHT = "#F2C500"  # yellow of lights in 3D views
TRUTH = "#F5D90A"  # yellow of the truth on top of frames


class Symbol(NamedTuple):
    """One marker, by its letter in files (matplotlib's), its name in plotly and as a character."""

    letter: str
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
    """Return the colour of each estimator, hexadecimal, by name.

    Names without a fixed colour take further ones in alphabetical order.
    """
    names = list(dict.fromkeys(estimators))
    unknown = sorted(name for name in names if name not in ESTIMATOR_COLOURS)
    further = {name: _FURTHER[i % len(_FURTHER)] for i, name in enumerate(unknown)}
    return {name: ESTIMATOR_COLOURS.get(name) or further[name] for name in names}


def estimator_order(names: Iterable[str]) -> list[str]:
    """Sort estimator names: those of the palette in its order, then the others by name."""
    known = list(ESTIMATOR_COLOURS)
    return sorted(set(names), key=lambda name: (known.index(name) if name in known else len(known), name))


def symbols(labels: Iterable[str]) -> dict[str, Symbol]:
    """Return the marker of each label, by order of appearance."""
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
    """Write an angle in degrees."""
    text = number(value)
    return text if text == "–" else f"{text}°"


def hexadecimal(colour: Sequence[float]) -> str:
    """Write a colour whose first three parts are red, green and blue in [0, 1]."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour[:3])


@cache
def rgb(colour: str) -> tuple[int, int, int]:
    """Read a hexadecimal colour: red, green and blue in 0..255."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


def labelled(names: Sequence[str]) -> str:
    """Join names as an English list."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
