"""A strip of frames: real ones above generated ones, to be looked at."""

from collections.abc import Sequence

import cv2
import numpy as np

from simtest.pages.pixels import Pixels, font
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
    from PIL import Image, ImageDraw

    fitted = [(title, [(name, _fitted(picture, height)) for name, picture in held]) for title, held in rows]
    widths = [sum(picture.shape[1] + GAP_PX for _, picture in held) for _, held in fitted]
    large, small = font(0.7 * TITLE_PX, bold=True), font(0.75 * CAPTION_PX)
    titles = [round(large.getlength(title)) + GAP_PX for title, _ in rows]
    line = TITLE_PX + height + CAPTION_PX + 2 * GAP_PX
    size = max([*widths, *titles], default=0) + GAP_PX, line * len(rows) + GAP_PX
    sheet = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(sheet)
    for number, (title, held) in enumerate(fitted):
        x, y = GAP_PX, GAP_PX + number * line
        pen.text((x, y), title, fill=_INK, font=large)
        y += TITLE_PX
        for name, picture in held:
            sheet.paste(Image.fromarray(picture), (x, y))
            pen.text((x, y + height + 2), _shortened(name, picture.shape[1]), fill=_SOFT, font=small)
            x += picture.shape[1] + GAP_PX
    return np.asarray(sheet)


def _fitted(picture: Picture, height: int) -> Picture:
    share = height / picture.shape[0]
    how = cv2.INTER_AREA if share < 1 else cv2.INTER_CUBIC
    size = (max(round(picture.shape[1] * share), 1), height)
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)


def _shortened(name: str, width: int) -> str:
    """Return a name that fits below its picture, px."""
    text = name
    while len(text) > 4 and font(0.75 * CAPTION_PX).getlength(text) > width:
        text = text[: -2 if text == name else -3].rstrip(".…") + "…"
    return text
