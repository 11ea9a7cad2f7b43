"""The picture with its isophotes, ellipses and normals: overlay.png of `simtest reconstruct`."""

from collections.abc import Sequence

import cv2
import numpy as np

from simtest.pages.style import colours
from simtest.reconstruction.description import Points, SpecularityRecord
from simtest.runtime.arrays import Array, Image, Picture

Colour = tuple[int, int, int]

SHORTEST_PX, CROWDED_PX = 900, 2000
"""A picture whose longer side is shorter is enlarged, by a whole number, so that lines and numbers have room; the
second where there are many."""

MANY = 40

ARROW_SHARE = 0.09
"""Length of a drawn normal over the picture's larger side, for a normal across the view; less where there are many."""

ISOPHOTE: Colour = (0, 235, 255)
NUMBER: Colour = (0, 255, 255)
FRACTION_BITS = 4


def draw_overlay(picture: Image, spots: Sequence[SpecularityRecord]) -> Picture:
    """Draw a picture with what was reconstructed in it, as the article does: isophote, ellipse, both normals, number.

    The picture, shape (H, W) or (H, W, 3), is RGB in [0, 1], as encoded; the drawing is in OpenCV's order of channels,
    with a legend below. Specularities are numbered by their tracks where they have one, else by their ids.
    """
    height, width = picture.shape[:2]
    # enlarge
    wanted = CROWDED_PX if len(spots) > MANY else SHORTEST_PX
    scale = max(1, -(-wanted // max(height, width)))
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    canvas = cv2.cvtColor(values, cv2.COLOR_GRAY2BGR if values.ndim == 2 else cv2.COLOR_RGB2BGR)
    if scale > 1:
        canvas = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    # draw
    palette = {name: _bgr(colour) for name, colour in colours(n for s in spots for n in s.estimates).items()}
    reach = ARROW_SHARE * max(width, height) * scale * min(1.0, 3 / np.sqrt(max(len(spots), 1)))
    shown: dict[str, Colour] = {}
    for spot in spots:
        _draw_spot(canvas, spot, palette, (scale, reach), shown)
        x, y, w, h = spot.box_px
        corner = (int((x + 0.75 * w) * scale), int((y + 0.25 * h) * scale))
        _text(canvas, str(spot.id if spot.track is None else spot.track), corner, NUMBER, 0.42)
    return np.vstack([canvas, _legend(canvas.shape[1], len(spots), shown)])


def _draw_spot(
    canvas: Picture, spot: SpecularityRecord, palette: dict[str, Colour], size: tuple[int, float],
    shown: dict[str, Colour],
) -> None:  # fmt: skip
    """Draw the isophote at half height, the ellipses and candidates of circle_pose, clouds, and the best normal."""
    for of_cloud in (name for name, estimate in spot.normals.items() if estimate.cloud is not None):
        for curve in spot.drawings[of_cloud].curves:
            _polyline(canvas, curve, palette[of_cloud], size[0])
        shown[of_cloud] = palette[of_cloud]
    for name in dict.fromkeys(("circle_pose", spot.best)):
        result = spot.normals.get(name) if name else None
        if name is None or result is None:
            continue
        colour = palette[name]
        shown[name] = colour
        if name == "circle_pose":
            for _, points in spot.drawings[name].isophotes:
                _polyline(canvas, points, ISOPHOTE, size[0])
                shown["isophote"] = ISOPHOTE
            for curve in spot.drawings[name].curves:
                _polyline(canvas, curve, colour, size[0])
        if np.isfinite(result.look_px).all():
            for k, normal in enumerate(result.candidates):
                _arrow(canvas, result.look_px, normal, colour, size, 1 if k else 2)


def _polyline(canvas: Picture, points: Points, colour: Colour, scale: int) -> None:
    if len(points) < 2:
        return
    # Pixel centres are at + 0.5 here, and integers in OpenCV.
    corners = np.rint((np.array(points) * scale - 0.5) * 2**FRACTION_BITS).astype(np.int32)
    cv2.polylines(canvas, [corners.reshape(-1, 1, 2)], False, colour, 1, cv2.LINE_AA, FRACTION_BITS)


def _arrow(canvas: Picture, look: Array, normal: Array, colour: Colour, size: tuple[int, float], width: int) -> None:
    """Draw the part of a normal across the view."""
    scale, reach = size
    start = look * scale - 0.5
    end = start + reach * normal[:2]
    if not (np.abs([start, end]) < 2**20).all():
        return
    ends = [tuple(int(v) for v in np.rint(point * 2**FRACTION_BITS)) for point in (start, end)]
    length = float(np.hypot(*(end - start)))
    tip = min(0.25, 6 / length) if length > 0 else 0.25
    cv2.arrowedLine(canvas, ends[0], ends[1], colour, width, cv2.LINE_AA, FRACTION_BITS, tip)


def _text(canvas: Picture, text: str, corner: tuple[int, int], colour: Colour, size: float) -> None:
    for shade, width in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, shade, width, cv2.LINE_AA)


def _legend(width: int, count: int, shown: dict[str, Colour]) -> Picture:
    strip = np.full((30, width, 3), 32, dtype=np.uint8)
    what = "specularity" if count == 1 else "specularities"
    _text(strip, f"{count} {what}", (8, 20), (255, 255, 255), 0.45)
    x = 150
    for name, colour in shown.items():
        cv2.line(strip, (x, 16), (x + 18, 16), colour, 2, cv2.LINE_AA)
        _text(strip, name, (x + 24, 20), (230, 230, 230), 0.42)
        x += 44 + 8 * len(name)
    return strip


def _bgr(colour: str) -> Colour:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
