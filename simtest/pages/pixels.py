"""Draws on enlarged frames with OpenCV, writes pictures, and embeds them in pages."""

import base64
import importlib.util
import io
from collections.abc import Sequence
from functools import cache
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
Window = tuple[float, float, float, float]
GAMMA = 2.2  # frames are linear; they are shown with this display gamma. Isophotes are those of the linear frame
AVIF_QUALITY, AVIF_SPEED = 42, 10
PNG_COMPRESSION = 1  # noise hardly gets smaller at higher levels
_BITS = 4  # binary digits of a drawn coordinate behind the point
_DASH_PX, _FONT_PX, _LINE_PX = 4.0, 13, 20


def displayed(frame: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return a linear frame in [0, 1] with the display gamma; what is not finite becomes black."""
    return np.asarray(np.nan_to_num(np.clip(frame, 0, 1)) ** np.float32(1 / GAMMA))


def normal_colours(normal: Array, unknown: tuple[int, int, int] = (0, 0, 0)) -> Pixels:
    """Return normals, camera frame, shape (H, W, 3), as colours: red right, green up, blue towards the camera."""
    colours = np.rint(127.5 * (1 + np.nan_to_num(normal) * [1.0, -1.0, -1.0])).astype(np.uint8)
    colours[~np.isfinite(normal).all(axis=-1)] = unknown
    return colours


class Canvas:
    """A part of a frame, enlarged, RGB. All points are pixel coordinates of the frame, shape (n, 2) or (2,).

    The frame is linear, share of full scale, shape (H, W) or (H, W, 3); the window is x0, x1, y0, y1 of the part, px,
    all of the frame by default; the height is that of the drawing, px.
    """

    def __init__(self, frame: npt.NDArray[np.float32], window: Window | None, height: int) -> None:
        rows, columns = frame.shape[:2]
        x0, x1, y0, y1 = window or (0.0, float(columns), 0.0, float(rows))
        self.scale = height / (y1 - y0)
        self.corner = np.array([x0, y0])
        # Only what shows is brought to the display's values.
        first, last = max(int(x0) - 1, 0), min(int(np.ceil(x1)) + 1, columns)
        above, below = max(int(y0) - 1, 0), min(int(np.ceil(y1)) + 1, rows)
        values = np.rint(255 * displayed(frame[above:below, first:last])).astype(np.uint8)
        values = cv2.cvtColor(values, cv2.COLOR_GRAY2RGB) if values.ndim == 2 else values
        # Pixel centres are at + 0.5 here, and integers in OpenCV.
        shift = 0.5 * (self.scale - 1) - self.scale * self.corner
        shift += self.scale * np.array([first, above])
        affine = np.array([[self.scale, 0.0, shift[0]], [0.0, self.scale, shift[1]]])
        size = (round((x1 - x0) * self.scale), height)
        how = cv2.INTER_NEAREST if self.scale > 1 else cv2.INTER_AREA
        self.pixels: Pixels = np.asarray(cv2.warpAffine(values, affine, size, flags=how), np.uint8)

    def _at(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        drawn = (np.asarray(points, float) - self.corner) * self.scale - 0.5
        return np.rint(np.clip(drawn, -1e5, 1e5) * 2**_BITS).astype(np.int32)

    def line(self, points: npt.ArrayLike, colour: str, width: int, dashed: bool = False) -> None:
        """Draw a closed line through points, shape (n, 2)."""
        at = self._at(points).reshape(-1, 1, 2)
        parts, closed = ([at], True) if not dashed else (_dashes(at[:, 0] / 2.0**_BITS), False)
        cv2.polylines(self.pixels, parts, closed, rgb(colour), width, cv2.LINE_AA, _BITS)

    def arrow(self, ends: Array, colour: str, width: int) -> None:
        """Draw an arrow between two points, shape (2, 2), with a dot at its foot; a short one is the dot alone."""
        if not np.isfinite(ends).all():
            return
        foot, tip = self._at(ends)
        length = float(np.hypot(*(tip - foot))) / 2**_BITS
        cv2.circle(self.pixels, foot.tolist(), (width + 1) << _BITS, rgb(colour), -1, cv2.LINE_AA, _BITS)
        if length > 4:
            share = min(0.4, 9 / length)
            cv2.arrowedLine(self.pixels, foot.tolist(), tip.tolist(), rgb(colour), width, cv2.LINE_AA, _BITS, share)

    def cross(self, point: npt.ArrayLike, colour: str, edge: str, size: int, tilted: bool = False) -> None:
        """Draw an upright or tilted cross with an edge in another colour."""
        x, y = (self._at(point) / 2**_BITS).round().astype(int).tolist()
        kind = cv2.MARKER_TILTED_CROSS if tilted else cv2.MARKER_CROSS
        for shade, width in ((edge, 4), (colour, 2)):
            cv2.drawMarker(self.pixels, (x, y), rgb(shade), kind, size, width, cv2.LINE_AA)

    def ring(self, point: npt.ArrayLike, colour: str, radius: int) -> None:
        """Draw a circle of a radius in px of the drawing."""
        cv2.circle(self.pixels, self._at(point).tolist(), radius << _BITS, rgb(colour), 1, cv2.LINE_AA, _BITS)


def _dashes(points: Array) -> list[npt.NDArray[np.int32]]:
    """Cut a closed line, px of the drawing, into dashes as long as the gaps between them."""
    closed = np.vstack([points, points[:1]])
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    starts = np.arange(0.0, along[-1], 2 * _DASH_PX)
    at = starts[:, None] + np.linspace(0, _DASH_PX, 3)
    dashes = np.stack([np.interp(at, along, closed[:, i]) for i in (0, 1)], axis=-1)
    return list(np.rint(dashes * 2**_BITS).astype(np.int32))


def legend(width: int, entries: Sequence[tuple[str, str]]) -> Pixels:
    """Return a white strip, px wide, with (colour, text) entries in as many lines as they need."""
    from PIL import Image, ImageDraw

    x, line, drawn = 8, 0, []
    for colour, text in entries:
        wide = 22 + round(font(_FONT_PX).getlength(text)) + 14
        if x > 8 and x + wide > width:
            x, line = 8, line + 1
        drawn.append((x, 6 + _LINE_PX * line, colour, text))
        x += wide
    strip = Image.new("RGB", (width, 12 + _LINE_PX * (line + 1)), "white")
    pen = ImageDraw.Draw(strip)
    for x, y, colour, text in drawn:
        pen.rectangle((x, y + 3, x + 13, y + 13), fill=colour)
        pen.text((x + 20, y), text, fill="#1b1f24", font=font(_FONT_PX))
    return np.asarray(strip)


def fonts() -> Path:
    """Return the folder of the fonts of all pictures, DejaVu, which matplotlib brings; found without importing that."""
    found = importlib.util.find_spec("matplotlib")
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"


@cache
def font(size: float, bold: bool = False) -> "FreeTypeFont":
    """Return DejaVu Sans in a size, px."""
    from PIL import ImageFont

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(fonts() / name, size, layout_engine=ImageFont.Layout.BASIC)


def png(picture: Pixels) -> bytes:
    """Return a picture, RGB, as PNG.

    Without filters between neighbours: drawings have flat colours and frames have noise, so that filters make both
    larger, and take longer than the rest.
    """
    ordered = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR)
    how = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
    done, data = cv2.imencode(".png", ordered, how)
    assert done
    return data.tobytes()


def jpeg_address(picture: Pixels, quality: int = 85) -> str:
    """Return a picture, RGB or grey, as ``data:image/jpeg;base64,...``."""
    ordered = picture if picture.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def data_address(picture: Pixels, height: int | None = None) -> str:
    """Return a picture, RGB, as ``data:image/avif;base64,...``, made smaller where it is higher than px."""
    # The module of the format, or Pillow loads those of all formats to find it.
    from PIL import AvifImagePlugin, Image

    assert AvifImagePlugin.SUPPORTED
    if height is not None and picture.shape[0] > height:
        share = height / picture.shape[0]
        picture = np.asarray(cv2.resize(picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8)
    buffer = io.BytesIO()
    # One thread each: several pictures are made at a time.
    Image.fromarray(picture).save(buffer, "AVIF", quality=AVIF_QUALITY, speed=AVIF_SPEED, max_threads=1)
    return "data:image/avif;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
