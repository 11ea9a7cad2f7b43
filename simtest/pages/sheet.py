"""A sheet of pixels: lines, markers and texts with OpenCV and Pillow, at a tenth of what matplotlib's artists cost."""

import importlib.util
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.style import rgb
from simtest.runtime.arrays import Array

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

Pixels = npt.NDArray[np.uint8]

_BITS = 4  # binary digits of a drawn coordinate behind the point
_FAR_PX = 1e5  # points beyond are drawn here: OpenCV counts in 32 bits
_DASHES = {"dash": (3.7, 1.6), "dashdot": (6.4, 1.6, 1.0, 1.6), "dot": (1.0, 1.65)}
"""Dash, gap, ... in widths of the line."""
_DASH_STEP_PX = 0.5
_HAIR_PX = 1.4  # what OpenCV's smooth edges add to the width of what they bound; also the width of its thinnest line
_MASKS = 4096  # texts that are kept drawn; ticks and legends repeat
_LINE_SPACING = 1.2


def _star() -> Array:
    angle = np.pi * np.arange(10) / 5
    radius = np.where(np.arange(10) % 2, 0.191, 0.5)
    return np.stack([radius * np.sin(angle), -radius * np.cos(angle)], axis=1)


def _plus() -> Array:
    low, high = 1 / 6, 0.5
    x = (-low, low, low, high, high, low, low, -low, -low, -high, -high, -low)
    y = (-high, -high, -low, -low, low, low, high, high, low, low, -low, -low)
    return np.array([x, y]).T


def _turned(points: Array) -> Array:
    return points @ np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2)


_SQUARE = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
_TRIANGLE = np.array([(0.0, -0.5), (0.5, 0.5), (-0.5, 0.5)])
_CROSS = np.array([[(-0.5, 0.0), (0.5, 0.0)], [(0.0, -0.5), (0.0, 0.5)]])
_FILLED = {
    "s": _SQUARE, "D": _turned(_SQUARE), "^": _TRIANGLE, "v": -_TRIANGLE, "P": _plus(), "X": 1.1 * _turned(_plus()),
    "*": _star(),
}  # fmt: skip
"""Outlines of filled symbols of size 1, y downwards."""

_THIN = {
    "+": _CROSS,
    "x": np.array([[(-0.5, -0.5), (0.5, 0.5)], [(-0.5, 0.5), (0.5, -0.5)]]),
    "_": _CROSS[:1],
    "|": _CROSS[1:],
}
"""Strokes of thin symbols of size 1."""

_NOTHING: Array = np.empty((0, 2))
_ALL_BUT_LAST, _REST = slice(None, -1), slice(1, None)

_ROUND = {"o": 0.5, ".": 0.25}  # radii


@dataclass(frozen=True)
class Sheet:
    """A picture, RGB, or a part of one, to be drawn on.

    Parameters
    ----------
    pixels : ndarray, uint8, shape (H, W, 3)
        The part; what is drawn beyond it does not show.
    left, top : int
        Where the part lies in the whole picture. All points are px of that, from its upper left corner, y downwards;
        pixel centres are at + 0.5.
    """

    pixels: Pixels
    left: int = 0
    top: int = 0

    @classmethod
    def white(cls, width: int, height: int) -> "Sheet":
        """Return an empty picture, px."""
        return cls(np.full((height, width, 3), 255, np.uint8))

    def part(self, x0: float, y0: float, x1: float, y1: float) -> "Sheet":
        """Return the part between two corners; it shares the sheet's pixels."""
        rows, columns = self.pixels.shape[:2]
        # Halves are rounded up alike, so that a whole width keeps its px.
        left, right = (min(max(math.floor(x + 0.5) - self.left, 0), columns) for x in (x0, x1))
        top, low = (min(max(math.floor(y + 0.5) - self.top, 0), rows) for y in (y0, y1))
        return Sheet(self.pixels[top:low, left:right], self.left + left, self.top + top)

    @contextmanager
    def faint(self, box: tuple[float, float, float, float], opacity: float) -> Iterator["Sheet"]:
        """Draw inside a box as if through paper; what is drawn in the body lies on what is there with an opacity."""
        part = self.part(*box)
        layer = Sheet(part.pixels.copy(), part.left, part.top)
        yield layer
        if part.pixels.size:
            part.pixels[...] = cv2.addWeighted(layer.pixels, opacity, part.pixels, 1 - opacity, 0)

    def _at(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        drawn = np.asarray(points, float) - (self.left, self.top) - 0.5
        return np.rint(np.clip(drawn, -_FAR_PX, _FAR_PX) * 2**_BITS).astype(np.int32)

    def box(self, x0: float, y0: float, x1: float, y1: float, colour: str) -> None:
        """Fill a rectangle, its edges rounded to whole pixels."""
        self.part(x0, y0, x1, y1).pixels[...] = rgb(colour)

    def line(self, points: npt.ArrayLike, colour: str, width: float, dash: str = "solid") -> None:
        """Join points, shape (n, 2); NaN leaves a gap. A dash is solid, dash, dashdot or dot."""
        runs = _runs(np.clip(np.asarray(points, float).reshape(-1, 2), -_FAR_PX, _FAR_PX))
        if dash != "solid":
            lengths = np.array(_DASHES[dash]) * max(width, 1.0)
            runs = [piece for run in runs for piece in _dashes(run, lengths)]
        if width < _HAIR_PX + 0.4:
            fixed = [self._at(run) for run in runs]
            cv2.polylines(self.pixels, fixed, False, rgb(colour), 1, cv2.LINE_AA, _BITS)
            return
        # OpenCV's own wide lines are 3.4, 5.4, 7.4 px wide.
        starts, ends = (np.concatenate([run[part] for run in runs] or [_NOTHING]) for part in (_ALL_BUT_LAST, _REST))
        for band in self._at(_bands(starts, ends, width - _HAIR_PX)):
            cv2.fillConvexPoly(self.pixels, band, rgb(colour), cv2.LINE_AA, _BITS)

    def outline(self, points: npt.ArrayLike, colour: str) -> None:
        """Fill an outline, shape (n, 2); upright rectangles in whole px."""
        corners = np.asarray(points, float)
        low, high = corners.min(axis=0), corners.max(axis=0)
        if ((corners == low) | (corners == high)).all():
            self.box(low[0], low[1], high[0], high[1], colour)
        else:
            cv2.fillPoly(self.pixels, [self._at(corners)], rgb(colour), cv2.LINE_AA, _BITS)

    def triangles(self, corners: npt.ArrayLike, colours: Pixels) -> None:
        """Fill triangles, shape (n, 3, 2), in this order, each with its colour, shape (n, 3); no seams show."""
        for points, colour in zip(self._at(corners), colours.tolist(), strict=True):
            cv2.fillConvexPoly(self.pixels, points, colour, cv2.LINE_8, _BITS)

    def markers(self, points: npt.ArrayLike, symbol: str, size: float, colour: str, width: float) -> None:
        """Draw a symbol, by matplotlib's letter, of a size at points, shape (n, 2); `width` is that of its lines."""
        edge = width - _HAIR_PX / 2
        for point in np.asarray(points, float).reshape(-1, 2):
            if not np.isfinite(point).all():
                continue
            if symbol in _ROUND:
                radius = round((_ROUND[symbol] * size + edge / 2) * 2**_BITS)
                cv2.circle(self.pixels, self._at(point).tolist(), radius, rgb(colour), -1, cv2.LINE_AA, _BITS)
            elif symbol in _THIN:
                for stroke in point + size * _THIN[symbol]:
                    self.line(stroke, colour, width)
            else:
                self.outline(point + (size + edge) * _FILLED[symbol], colour)

    def text(
        self, at: tuple[float, float], text: str, size: float, colour: str = "#000000", across: float = 0.5,
        down: float = 0.5, bold: bool = False, turn_deg: int = 0,
    ) -> tuple[int, int]:  # fmt: skip
        """Write a text of a font size; `across` and `down` are the shares of it that lie left of and above a point.

        Lines are centred. It may be turned by a multiple of 90 deg, anticlockwise. Returns its width and height.
        """
        mask = np.rot90(_mask(text, size, bold), turn_deg // 90)
        rows, columns = mask.shape
        x, y = round(at[0] - across * columns), round(at[1] - down * rows)
        part = self.part(x, y, x + columns, y + rows)
        shown = mask[part.top - y :, part.left - x :][: part.pixels.shape[0], : part.pixels.shape[1], None]
        there, ink = part.pixels.astype(np.uint16), np.array(rgb(colour), np.uint16)
        part.pixels[...] = (there * (255 - shown) + ink * shown + 127) // 255
        return columns, rows


def _runs(points: Array) -> list[Array]:
    """Split points where one is not finite; a single point is no line."""
    finite = np.isfinite(points).all(axis=1)
    if finite.all():
        return [points] if len(points) > 1 else []
    parts = np.split(points, np.flatnonzero(~finite))
    parts = [part[np.isfinite(part).all(axis=1)] for part in parts]
    return [part for part in parts if len(part) > 1]


def _bands(starts: Array, ends: Array, width: float) -> Array:
    """Return the corners of the bands of a width about straight lines, shape (n, 4, 2)."""
    along = ends - starts
    along = along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    side = width / 2 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.stack([starts + side, ends + side, ends - side, starts - side], axis=1)


def _dashes(points: Array, lengths: Array) -> list[Array]:
    """Cut a line, px, into dashes; `lengths` are those of dash, gap, dash, ..., px."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.arange(0.0, along[-1], _DASH_STEP_PX)
    if not len(at):
        return []
    which = np.searchsorted(np.cumsum(lengths), np.mod(at, lengths.sum()), side="right")
    drawn = np.stack([np.interp(at, along, points[:, i]) for i in (0, 1)], axis=-1)
    ends = np.flatnonzero(np.diff(which)) + 1
    return [piece for piece, kind in zip(np.split(drawn, ends), which[[0, *ends]], strict=True) if kind % 2 == 0]


@cache
def font(size: float, bold: bool = False) -> "FreeTypeFont":
    """Return the font of all figures: DejaVu Sans, which matplotlib brings, found without importing that."""
    from PIL import ImageFont

    spec = importlib.util.find_spec("matplotlib")
    assert spec is not None
    assert spec.origin is not None
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    path = Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf" / name
    return ImageFont.truetype(path, size, layout_engine=ImageFont.Layout.BASIC)


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text, px."""
    return float(font(size).getlength(text))


@lru_cache(_MASKS)
def _mask(text: str, size: float, bold: bool) -> npt.NDArray[np.uint16]:
    """Return the ink of a text in 0..255, shape (rows, columns)."""
    from PIL import Image, ImageDraw

    used, lines = font(size, bold), text.split("\n")
    width = max(round(used.getlength(line)) for line in lines) + 1
    ascent, descent = used.getmetrics()
    step = round(_LINE_SPACING * size)
    image = Image.new("L", (width, ascent + descent + step * (len(lines) - 1)))
    pen = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        pen.text(((width - used.getlength(line)) / 2, number * step), line, fill=255, font=used)
    return np.asarray(image).astype(np.uint16)
