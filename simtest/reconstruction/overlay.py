"""The picture with its isophotes, ellipses and normals: overlay.png of `simtest reconstruct`."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from simtest.estimators.protocol import Estimate
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
RAY: Colour = (235, 235, 235)
RAY_SHARE = 0.35
PLATE_SHARE = 0.25
"""Share of the picture's light that is left behind a number."""
EDGE: Colour = (0, 0, 0)
HALF = 0.5
"""Isovalue of the isophote that is drawn."""

FRACTION_BITS = 4
LINE_PX = 22


def draw_overlay(picture: Image, spots: Sequence[SpecularityRecord]) -> Picture:
    """Draw a picture with the best normal of each specularity: its isophote, fitted ellipse, candidates and number.

    A cloud of highlights is drawn as its centre and base normal, with a line to each of its glints. The picture, shape
    (H, W) or (H, W, 3), is RGB in [0, 1], as encoded; the drawing is in OpenCV's order of channels, with a legend
    below. Specularities are numbered by their tracks where they have one, else by their ids; a number that would cover
    another is left out.
    """
    height, width = picture.shape[:2]
    # enlarge
    wanted = CROWDED_PX if len(spots) > MANY else SHORTEST_PX
    scale = max(1, -(-wanted // max(height, width)))
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    canvas = cv2.cvtColor(values, cv2.COLOR_GRAY2BGR if values.ndim == 2 else cv2.COLOR_RGB2BGR)
    if scale > 1:
        canvas = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    # draw: clouds first, under what stands on them
    palette = {name: _bgr(colour) for name, colour in colours(n for s in spots for n in s.estimates).items()}
    reach = ARROW_SHARE * max(width, height) * scale * min(1.0, 3 / np.sqrt(max(len(spots), 1)))
    shown: dict[str, Colour] = {}
    _draw_rays(canvas, spots, scale)
    ordered = sorted(spots, key=lambda spot: spot.best_estimate is None or spot.best_estimate.cloud is None)
    for spot in ordered:
        _draw_spot(canvas, spot, palette, (scale, reach), shown)
    _draw_numbers(canvas, ordered, scale)
    return np.vstack([canvas, _legend(canvas.shape[1], len(spots), shown)])


def _draw_spot(
    canvas: Picture, spot: SpecularityRecord, palette: dict[str, Colour], size: tuple[int, float],
    shown: dict[str, Colour],
) -> None:  # fmt: skip
    """Draw the best estimate: the isophote nearest to half height with its ellipse, or the cloud, and the normals."""
    result = spot.best_estimate
    if spot.best is None or result is None:
        return
    colour, drawing = palette[spot.best], spot.drawings.get(spot.best)
    shown[spot.best] = colour
    if drawing is not None and drawing.isophotes:
        # Curves stand in the isophotes' order where each isophote has one.
        nearest = min(range(len(drawing.isophotes)), key=lambda i: abs(drawing.isophotes[i][0] - HALF))
        _polyline(canvas, drawing.isophotes[nearest][1], ISOPHOTE, size[0])
        shown["isophote"] = ISOPHOTE
        if len(drawing.curves) == len(drawing.isophotes):
            _polyline(canvas, drawing.curves[nearest], colour, size[0])
    if result.cloud is not None:
        _draw_cloud(canvas, result, size[0], colour)
        for curve in drawing.curves if drawing is not None else ():
            for shade, width in ((RAY, 4), (colour, 2)):
                _polyline(canvas, curve, shade, size[0], width)
    if np.isfinite(result.look_px).all():
        width = 4 if result.cloud is not None else 2
        for k, normal in enumerate(result.candidates):
            _arrow(canvas, result.look_px, normal, colour, size, 1 if k else width)


def _draw_rays(canvas: Picture, spots: Sequence[SpecularityRecord], scale: int) -> None:
    """Draw faint lines from the centre of each cloud to its glints."""
    best = (spot.best_estimate for spot in spots)
    clouds = [(result, result.cloud) for result in best if result is not None and result.cloud is not None]
    if not clouds:
        return
    layer = canvas.copy()
    for result, cloud in clouds:
        for glint in cloud.points_px:
            _polyline(layer, [result.look_px.tolist(), glint.tolist()], RAY, scale)
    cv2.addWeighted(layer, RAY_SHARE, canvas, 1 - RAY_SHARE, 0, dst=canvas)


def _draw_cloud(canvas: Picture, result: Estimate, scale: int, colour: Colour) -> None:
    """Draw a cloud's glints as dots and its centre as a diamond, with bright edges."""
    assert result.cloud is not None
    for glint in result.cloud.points_px:
        for shade, radius in ((RAY, 3), (colour, 2)):
            at = _at(glint, scale).tolist()
            cv2.circle(canvas, at, radius << FRACTION_BITS, shade, -1, cv2.LINE_AA, FRACTION_BITS)
    corners = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)]) << FRACTION_BITS
    for shade, half in ((RAY, 9), (colour, 7)):
        cv2.fillConvexPoly(canvas, _at(result.look_px, scale) + half * corners, shade, cv2.LINE_AA, FRACTION_BITS)


def _draw_numbers(canvas: Picture, spots: Sequence[SpecularityRecord], scale: int) -> None:
    """Write the numbers of specularities; leave out numbers that would cover another one."""
    taken = np.empty((0, 4))
    for spot in spots:
        x, y, w, h = spot.box_px
        text = str(spot.id if spot.track is None else spot.track)
        left, low = int((x + 0.75 * w) * scale), int((y + 0.25 * h) * scale)
        area = np.array([left, low - 12, left + 9 * len(text), low + 3])
        if ((area[:2] < taken[:, 2:]) & (taken[:, :2] < area[2:])).all(axis=1).any():
            continue
        taken = np.vstack([taken, area])
        _plate(canvas, area)
        _text(canvas, text, (left, low), NUMBER, 0.42)


def _plate(canvas: Picture, area: Array) -> None:
    """Darken the ground of a number, which is yellow and often stands on a white highlight."""
    left, top, right, low = np.clip(area.astype(int) + np.array([-2, -2, 2, 2]), 0, np.tile(canvas.shape[1::-1], 2))
    canvas[top:low, left:right] = (PLATE_SHARE * canvas[top:low, left:right]).astype(np.uint8)


def _at(points: npt.ArrayLike, scale: int) -> npt.NDArray[np.int32]:
    """Return points, px of the picture, shape (..., 2), in OpenCV's fractions of a px of the drawing."""
    # Pixel centres are at + 0.5 here, and integers in OpenCV.
    return np.rint((np.asarray(points, dtype=float) * scale - 0.5) * 2**FRACTION_BITS).astype(np.int32)


def _polyline(canvas: Picture, points: Points, colour: Colour, scale: int, width: int = 1) -> None:
    if len(points) < 2:
        return
    cv2.polylines(canvas, [_at(points, scale).reshape(-1, 1, 2)], False, colour, width, cv2.LINE_AA, FRACTION_BITS)


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
    # A dark edge keeps the arrow readable on a highlight.
    for shade, wide in ((EDGE, width + 2), (colour, width)):
        cv2.arrowedLine(canvas, ends[0], ends[1], shade, wide, cv2.LINE_AA, FRACTION_BITS, tip)


def _text(canvas: Picture, text: str, corner: tuple[int, int], colour: Colour, size: float) -> None:
    for shade, width in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, size, shade, width, cv2.LINE_AA)


def _legend(width: int, count: int, shown: dict[str, Colour]) -> Picture:
    """Return a strip with the number of specularities and the colours, in as many lines as they need."""
    what = "specularity" if count == 1 else "specularities"
    entries, x, line = [], 150, 0
    for name, colour in shown.items():
        wide = 44 + 8 * len(name)
        if x > 8 and x + wide > width:
            x, line = 8, line + 1
        entries.append((x, LINE_PX * line + 20, name, colour))
        x += wide
    strip = np.full((LINE_PX * line + 30, width, 3), 32, dtype=np.uint8)
    _text(strip, f"{count} {what}", (8, 20), (255, 255, 255), 0.45)
    for x, y, name, colour in entries:
        cv2.line(strip, (x, y - 4), (x + 18, y - 4), colour, 2, cv2.LINE_AA)
        _text(strip, name, (x + 24, y), (230, 230, 230), 0.42)
    return strip


def _bgr(colour: str) -> Colour:
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
