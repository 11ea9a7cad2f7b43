"""The colours of the estimators and of what stands beside them: in pages, figures, the viewer and overlays.

The colours are those of Okabe and Ito, moved so that every two of them, and the neutral grey, differ by at least
`LEAST_DIFFERENCE` (CIEDE2000) for a normal observer, a protanope and a deuteranope, and have a contrast of at least
`LEAST_CONTRAST` (WCAG 2) with white and with the pages' dark ground.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache

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
