"""Symbols and number formats of all pages and figures; their colours are those of `palette`."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

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
    "SHAPES",
    "STROKES",
    "TRUTH",
    "colours",
    "degrees",
    "estimator_order",
    "hexadecimal",
    "labelled",
    "number",
    "rgb",
    "symbols",
]


SHAPES: Mapping[str, str] = {
    "●": "circle",
    "■": "square",
    "▲": "triangle-up",
    "◆": "M0,-1.3L1.3,0L0,1.3L-1.3,0Z",
    "▼": "triangle-down",
    "✚": "cross",
    "✖": "M-1,-.5L-.5,-1L0,-.5L.5,-1L1,-.5L.5,0L1,.5L.5,1L0,.5L-.5,1L-1,.5L-.5,0Z",
    "★": "M0,-1L.23,-.31L.95,-.31L.37,.12L.59,.81L0,.38L-.59,.81L-.37,.12L-.95,-.31L-.23,-.31Z",
    "+": "M-1,0H1M0,-1V1",
    "×": "M-1,-1L1,1M-1,1L1,-1",
    "–": "M-1,0H1",
    "|": "M0,-1V1",
    "▮": "M0,-1V1",
}
"""Vega's name of each symbol, which is a character, or its path."""

STROKES = ("+", "×", "–", "|", "▮")
"""Symbols without an area."""

_IN_TURN = tuple(SHAPES)[:8]


def symbols(labels: Iterable[str]) -> dict[str, str]:
    """Return the symbol of each label, by order of appearance."""
    return {label: _IN_TURN[i % len(_IN_TURN)] for i, label in enumerate(dict.fromkeys(labels))}


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
