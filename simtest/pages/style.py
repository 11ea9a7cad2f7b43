"""Symbols and number formats of all pages and figures; their colours are those of `palette`."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from simtest.pages.palette import (
    ESTIMATOR_COLOURS,
    LIGHT,
    NEUTRAL,
    TRUTH,
    colours,
    estimator_order,
    hexadecimal,
    rgb,
)

__all__ = [
    "ESTIMATOR_COLOURS",
    "LIGHT",
    "NEUTRAL",
    "TRUTH",
    "Symbol",
    "colours",
    "degrees",
    "estimator_order",
    "hexadecimal",
    "labelled",
    "number",
    "rgb",
    "symbols",
]


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


def symbols(labels: Iterable[str]) -> dict[str, Symbol]:
    """Return the marker of each label, by order of appearance."""
    return {label: _SYMBOLS[i % len(_SYMBOLS)] for i, label in enumerate(dict.fromkeys(labels))}


ROUNDING = 1e-12


def number(value: Any, digits: int = 3) -> str:
    """Write a number with a few significant digits; what is null or not finite becomes a dash."""
    if value is None or isinstance(value, str | bool) or not np.isfinite(value):
        return "–"
    if isinstance(value, int):
        return str(value)
    # Below what double precision resolves of a number near 1 stands rounding, not a figure.
    if abs(value) < ROUNDING:
        return "0"
    if 1e-3 <= abs(value) < 1e4:
        text = f"{value:.{digits}g}"
        return f"{value:.0f}" if "e" in text else text
    return f"{value:.{digits - 1}e}"


def degrees(value: Any) -> str:
    """Write an angle in degrees."""
    text = number(value)
    return text if text == "–" else f"{text}°"


def labelled(names: Sequence[str]) -> str:
    """Join names as an English list."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
