"""A strip of frames: real ones above generated ones, to be looked at."""

from collections.abc import Sequence

import cv2
import numpy as np

from simtest.pages.sheet import Pixels, Sheet, text_width
from simtest.runtime.arrays import Picture

GAP_PX, TITLE_PX, CAPTION_PX = 8, 26, 16
_INK, _SOFT = "#1b1f24", "#59616b"

Named = Sequence[tuple[str, Picture]]
"""Names and pictures, RGB."""


def draw_strip(rows: Sequence[tuple[str, Named]], height: int) -> Pixels:
    """Draw rows of pictures, each row below its title and each picture above its name.

    Parameters
    ----------
    rows : sequence of (str, sequence)
        Title and pictures of each row.
    height : int
        Of each picture, px; all are brought to it.
    """
    fitted = [(title, [(name, _fitted(picture, height)) for name, picture in held]) for title, held in rows]
    widths = [sum(picture.shape[1] + GAP_PX for _, picture in held) for _, held in fitted]
    titles = [round(text_width(title, 0.7 * TITLE_PX)) + GAP_PX for title, _ in rows]
    line = TITLE_PX + height + CAPTION_PX + 2 * GAP_PX
    sheet = Sheet.white(max([*widths, *titles], default=0) + GAP_PX, line * len(rows) + GAP_PX)
    for number, (title, held) in enumerate(fitted):
        x, y = GAP_PX, GAP_PX + number * line
        sheet.text((x, y), title, 0.7 * TITLE_PX, _INK, across=0.0, down=0.0, bold=True)
        y += TITLE_PX
        for name, picture in held:
            sheet.pixels[y : y + height, x : x + picture.shape[1]] = picture
            caption = _shortened(name, picture.shape[1])
            sheet.text((x, y + height + 2), caption, 0.75 * CAPTION_PX, _SOFT, across=0.0, down=0.0)
            x += picture.shape[1] + GAP_PX
    return sheet.pixels


def _fitted(picture: Picture, height: int) -> Picture:
    share = height / picture.shape[0]
    how = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    size = (max(round(picture.shape[1] * share), 1), height)
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


def _shortened(name: str, width: int) -> str:
    """Return a name that fits below its picture, px."""
    text = name
    while len(text) > 4 and text_width(text, 0.75 * CAPTION_PX) > width:
        text = text[: -2 if text == name else -3].rstrip(".…") + "…"
    return text
