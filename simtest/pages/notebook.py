"""What a notebook shows of results: a picture with a short table, as HTML without scripts."""

from collections.abc import Iterable, Sequence
from html import escape

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.pixels import jpeg_address
from simtest.pages.style import NEUTRAL, SERIES

WIDEST_PX = 760
"""Pictures are made smaller to this width."""

DIAL_PX = 120


def picture_html(picture: npt.NDArray[np.uint8], text: str, widest: int = WIDEST_PX) -> str:
    """Return an RGB or grey picture, of 8 bits, as an image element up to px wide; `text` says what it shows."""
    shown = picture
    width = shown.shape[1]
    if width > widest:
        share = widest / width
        shown = np.asarray(cv2.resize(shown, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8)
    elif width < WIDEST_PX // 3:
        factor = WIDEST_PX // 3 // width + 1
        shown = np.asarray(cv2.resize(shown, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST), np.uint8)
    return f'<img src="{jpeg_address(shown)}" alt="{escape(text)}" style="max-width:100%;height:auto">'


def table_html(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table; texts are escaped."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(str(v))}</td>" for v in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def note_html(text: str) -> str:
    """Return a line of text."""
    return f"<div>{escape(text)}</div>"


def normal_html(across: npt.ArrayLike, region: npt.ArrayLike | None = None) -> str:
    """Draw the part of a unit normal across the view as an arrow in the unit circle, x right and y down.

    Parameters
    ----------
    across : array_like, shape (2,)
        The normal's x and y.
    region : array_like, shape (2, 2), optional
        Of x and y: the covariance times a quantile of chi-squared; its ellipse stands about the arrow's tip.
    """
    reach = DIAL_PX / 2 - 6
    x, y = (reach * np.asarray(across, dtype=float)).tolist()
    ellipse = ""
    if region is not None:
        values, vectors = np.linalg.eigh(np.asarray(region, dtype=float))
        small, large = (reach * np.sqrt(np.maximum(values, 0))).tolist()
        turn = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        ellipse = (
            f'<ellipse rx="{large:.2f}" ry="{small:.2f}" transform="translate({x:.2f} {y:.2f}) rotate({turn:.1f})" '
            f'fill="{SERIES[0]}" fill-opacity="0.25" stroke="{SERIES[0]}"/>'
        )
    half = DIAL_PX / 2
    return (
        f'<svg width="{DIAL_PX}" height="{DIAL_PX}" viewBox="{-half} {-half} {DIAL_PX} {DIAL_PX}" role="img" '
        'aria-label="normal across the view"><circle r="'
        f'{reach:.1f}" fill="none" stroke="{NEUTRAL}"/><circle r="1.5" fill="{NEUTRAL}"/>{ellipse}'
        f'<path d="M0 0L{x:.2f} {y:.2f}" stroke="{SERIES[0]}" stroke-width="2.5"/>'
        f'<circle cx="{x:.2f}" cy="{y:.2f}" r="3" fill="{SERIES[0]}"/></svg>'
    )
