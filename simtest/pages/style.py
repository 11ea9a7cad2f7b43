"""How pages and charts look: colours that stay apart for all eyes, and how numbers are written."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

ESTIMATOR_COLOURS: Mapping[str, str] = {
    "cone_axis": "#166B90",
    "circle_pose": "#B15912",
    "brightest_point": "#109B6D",
    "bisector": "#B486B1",
    "curved": "#009AF8",
    "photometric": "#CC8600",
    "inverse_rendering": "#644FFA",
    "cloud": "#7F5C43",
}
"""Colour of each estimator: blue, vermilion, green, pink, sky blue, orange, violet, brown; hexadecimal.

`learned_spot` and `learned_dense` take further ones: no ninth colour is far enough from these eight for all three
observers.
"""

NEUTRAL = "#747981"
"""Grey of laws and truth in charts."""

LEAST_DIFFERENCE = 12.0
"""Least CIEDE2000 between two of these colours, seen by any of the three observers; about 2 is a just visible step."""

LEAST_CONTRAST = 3.0
"""Least contrast between one of these colours and a ground: what WCAG 2 asks of marks that carry a meaning."""

FURTHER = ("#B2478F", "#4E9A9A", "#98982E", "#BC8777", "#A6761D", "#5D6B2F")
"""Colours of estimators from other packages; text and symbols tell them apart too."""

SERIES = tuple(ESTIMATOR_COLOURS.values())
"""The same colours in order, for series that are no estimators."""

LIGHT = "#F2C500"
"""Yellow of lights in 3D views."""

TRUTH = "#F5D90A"
"""Yellow of the truth on top of frames."""

GROUNDS = ("#ffffff", "#14171b")
"""Grounds of the pages, light and dark."""


def colours(estimators: Iterable[str]) -> dict[str, str]:
    """Return the colour of each estimator, hexadecimal, by name.

    Names without a fixed colour take further ones in alphabetical order.
    """
    names = list(dict.fromkeys(estimators))
    unknown = sorted(name for name in names if name not in ESTIMATOR_COLOURS)
    further = {name: FURTHER[i % len(FURTHER)] for i, name in enumerate(unknown)}
    return {name: ESTIMATOR_COLOURS.get(name) or further[name] for name in names}


def estimator_order(names: Iterable[str]) -> list[str]:
    """Sort estimator names: those of the palette in its order, then the others by name."""
    known = list(ESTIMATOR_COLOURS)
    return sorted(set(names), key=lambda name: (known.index(name) if name in known else len(known), name))


def hexadecimal(colour: Sequence[float]) -> str:
    """Write a colour whose first three parts are red, green and blue in [0, 1]."""
    return "#" + "".join(f"{round(255 * part):02x}" for part in colour[:3])


@cache
def rgb(colour: str) -> tuple[int, int, int]:
    """Read a hexadecimal colour: red, green and blue in 0..255."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


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


def counted(count: int, word: str) -> str:
    """Return a number of things, such as "1 row" or "2 rows"."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"


def degrees(value: Any) -> str:
    """Write an angle in degrees."""
    text = number(value)
    return text if text == "–" else f"{text}°"


def labelled(names: Sequence[str]) -> str:
    """Join names as an English list."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
