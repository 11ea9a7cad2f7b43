"""Dark borders of a picture: where they lie, and what they mean for a stated field of view."""

import numpy as np
import numpy.typing as npt

from simtest.detection.view import DARK, View

BORDERED = "the picture has dark borders"
"""How the note about borders begins."""

LEAST_SHARE = 0.02
"""Borders of less than this share of the picture's side say nothing about a field of view: focal lengths that follow
from one are known to 10 %."""

Span = tuple[int, int]


def visible_box(picture: npt.NDArray[np.floating], view: View) -> tuple[Span, Span]:
    """Return the columns and the rows between the dark borders of a picture, each as first and end.

    The picture has shape (H, W) or (H, W, 3), values as encoded in [0, 1]. A round view spans its circle, so that text
    beside it does not count; else a border is a run of rows or columns that are dark along their whole length.
    """
    height, width = picture.shape[:2]
    if view.circle is not None:
        circle = view.circle
        return _span(circle.cx, circle.radius, width), _span(circle.cy, circle.radius, height)
    lit = (picture >= DARK).reshape(height, width, -1)
    return _lit_span(np.asarray(lit.any(axis=(0, 2)))), _lit_span(np.asarray(lit.any(axis=(1, 2))))


def border_note(picture: npt.NDArray[np.floating], view: View) -> str:
    """Return a note of the dark borders' columns and rows, and what to do; empty where there are none to speak of."""
    columns, rows = visible_box(picture, view)
    height, width = picture.shape[:2]
    named = [
        f"{name} {first} to {end - 1} of {size}"
        for name, (first, end), size in (("columns", columns, width), ("rows", rows, height))
        if size - (end - first) >= LEAST_SHARE * size
    ]
    if not named:
        return ""
    round_view = ", or give --fov-of view" if view.circle is not None else ""
    return (
        f"{BORDERED}: its visible part is {' and '.join(named)}. The field of view is taken across the whole picture; "
        f"if it is that of the visible part, crop the picture to these{round_view}"
    )


def _span(centre: float, radius: float, size: int) -> Span:
    """Return the first and the end of the pixels within a radius of a centre, px."""
    return max(int(np.floor(centre - radius)), 0), min(int(np.ceil(centre + radius)), size)


def _lit_span(lit: npt.NDArray[np.bool_]) -> Span:
    """Return the first lit line and the end of the last; all lines where none is lit."""
    found = np.flatnonzero(lit)
    return (int(found[0]), int(found[-1]) + 1) if len(found) else (0, len(lit))
