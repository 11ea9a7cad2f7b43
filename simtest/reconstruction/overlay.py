"""The picture with its isophotes, ellipses and normals: overlay.png of `simtest reconstruct`."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from simtest.pages.style import colours, rgb
from simtest.reconstruction.records import Points, Specularity
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


class _Sheet:
    """An enlarged picture that is drawn on, in OpenCV's order of channels; points are px of the frame."""

    def __init__(self, picture: Image, wanted_px: int, origin_px: tuple[int, int]) -> None:
        self.origin = np.array(origin_px)
        self.scale = max(1, -(-wanted_px // max(picture.shape[:2])))
        values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
        self.pixels: Picture = cv2.cvtColor(values, cv2.COLOR_GRAY2BGR if values.ndim == 2 else cv2.COLOR_RGB2BGR)
        if self.scale > 1:
            self.pixels = cv2.resize(self.pixels, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_CUBIC)

    def at(self, points: npt.ArrayLike) -> npt.NDArray[np.int32]:
        """Return points, shape (..., 2), in OpenCV's fractions of a px of the drawing."""
        # Pixel centres are at + 0.5 here, and integers in OpenCV.
        drawn = (np.asarray(points, dtype=float) - self.origin) * self.scale - 0.5
        return np.rint(drawn * 2**FRACTION_BITS).astype(np.int32)

    def line(self, points: Points, colour: Colour, width: int = 1) -> None:
        """Draw an open line."""
        if len(points) >= 2:
            drawn = [self.at(points).reshape(-1, 1, 2)]
            cv2.polylines(self.pixels, drawn, False, colour, width, cv2.LINE_AA, FRACTION_BITS)

    def arrow(self, look: Array, normal: Array, colour: Colour, reach: float, width: int) -> None:
        """Draw the part of a normal across the view."""
        start = (look - self.origin) * self.scale - 0.5
        end = start + reach * normal[:2]
        if not (np.abs([start, end]) < 2**20).all():
            return
        ends = [tuple(int(v) for v in np.rint(point * 2**FRACTION_BITS)) for point in (start, end)]
        length = float(np.hypot(*(end - start)))
        tip = min(0.25, 6 / length) if length > 0 else 0.25
        # A dark edge keeps the arrow readable on a highlight.
        for shade, wide in ((EDGE, width + 2), (colour, width)):
            cv2.arrowedLine(self.pixels, ends[0], ends[1], shade, wide, cv2.LINE_AA, FRACTION_BITS, tip)

    def cloud(self, centre: Array, glints: Array, colour: Colour) -> None:
        """Draw a cloud's glints as dots and its centre as a diamond, with bright edges."""
        for glint in glints:
            for shade, radius in ((RAY, 3), (colour, 2)):
                at = self.at(glint).tolist()
                cv2.circle(self.pixels, at, radius << FRACTION_BITS, shade, -1, cv2.LINE_AA, FRACTION_BITS)
        corners = np.array([(0, -1), (1, 0), (0, 1), (-1, 0)]) << FRACTION_BITS
        for shade, half in ((RAY, 9), (colour, 7)):
            cv2.fillConvexPoly(self.pixels, self.at(centre) + half * corners, shade, cv2.LINE_AA, FRACTION_BITS)


def draw_overlay(
    picture: Image, spots: Sequence[Specularity], origin_px: tuple[int, int] = (0, 0), with_curves: bool = True
) -> Picture:
    """Draw a picture with the best normal of each specularity: its isophote, fitted ellipse, candidates and number.

    A cloud of highlights is drawn as its centre and base normal, with a line to each of its glints. The picture, shape
    (H, W) or (H, W, 3), is RGB in [0, 1], as encoded, and may be a part of the frame with its first pixel at
    `origin_px`; the drawing is in OpenCV's order of channels, with a legend below. Specularities are numbered by their
    tracks where they have one, else by their ids; a number that would cover another is left out. Fitted curves are left
    out where they are not wanted.
    """
    sheet = _Sheet(picture, CROWDED_PX if len(spots) > MANY else SHORTEST_PX, origin_px)
    palette = {name: _bgr(colour) for name, colour in colours(n for s in spots for n in s.estimates).items()}
    crowded = min(1.0, 3 / np.sqrt(max(len(spots), 1)))
    reach = ARROW_SHARE * max(picture.shape[:2]) * sheet.scale * crowded
    shown: dict[str, Colour] = {}
    # Clouds come first, under what stands on them.
    _draw_rays(sheet, spots)
    ordered = sorted(spots, key=lambda spot: spot.best_estimate is None or spot.best_estimate.cloud is None)
    for spot in ordered:
        if (result := spot.best_estimate) is None or spot.best is None:
            continue
        colour, drawing = palette[spot.best], spot.drawings[spot.best]
        curves = drawing.curves if with_curves else []
        shown[spot.best] = colour
        if drawing.isophotes:
            # The isophote nearest to half height; curves stand in the isophotes' order where each isophote has one.
            nearest = min(range(len(drawing.isophotes)), key=lambda i: abs(drawing.isophotes[i][0] - HALF))
            sheet.line(drawing.isophotes[nearest][1], ISOPHOTE)
            shown["isophote"] = ISOPHOTE
            if len(curves) == len(drawing.isophotes):
                sheet.line(curves[nearest], colour)
        if result.cloud is not None:
            sheet.cloud(result.look_px, result.cloud.points_px, colour)
            for curve in curves:
                for shade, width in ((RAY, 4), (colour, 2)):
                    sheet.line(curve, shade, width)
        if np.isfinite(result.look_px).all():
            for k, normal in enumerate(result.candidates):
                sheet.arrow(result.look_px, normal, colour, reach, 1 if k else 2 if result.cloud is None else 4)
    _draw_numbers(sheet, ordered)
    return np.vstack([sheet.pixels, _legend(sheet.pixels.shape[1], len(spots), shown)])


def _draw_rays(sheet: _Sheet, spots: Sequence[Specularity]) -> None:
    """Draw faint lines from the centre of each cloud to its glints."""
    best = (spot.best_estimate for spot in spots)
    clouds = [(result, result.cloud) for result in best if result is not None and result.cloud is not None]
    if not clouds:
        return
    ground = sheet.pixels.copy()
    for result, cloud in clouds:
        for glint in cloud.points_px:
            sheet.line([result.look_px.tolist(), glint.tolist()], RAY)
    cv2.addWeighted(sheet.pixels, RAY_SHARE, ground, 1 - RAY_SHARE, 0, dst=sheet.pixels)


def _draw_numbers(sheet: _Sheet, spots: Sequence[Specularity]) -> None:
    """Write the numbers of specularities; leave out numbers that would cover another one."""
    taken, canvas = np.empty((0, 4)), sheet.pixels
    for spot in spots:
        (x, y), (w, h) = spot.region.box[:2] - sheet.origin, spot.region.box[2:]
        text = str(spot.id if spot.track is None else spot.track)
        left, low = int((x + 0.75 * w) * sheet.scale), int((y + 0.25 * h) * sheet.scale)
        area = np.array([left, low - 12, left + 9 * len(text), low + 3])
        if ((area[:2] < taken[:, 2:]) & (taken[:, :2] < area[2:])).all(axis=1).any():
            continue
        taken = np.vstack([taken, area])
        # The ground of a number, which is yellow and often stands on a white highlight, is darkened.
        edges = area + np.array([-2, -2, 2, 2])
        first, top, end, bottom = np.clip(edges, 0, np.tile(canvas.shape[1::-1], 2))
        canvas[top:bottom, first:end] = (PLATE_SHARE * canvas[top:bottom, first:end]).astype(np.uint8)
        write_text(canvas, text, (left, low), NUMBER, 0.42)


def write_text(canvas: Picture, text: str, corner: tuple[int, int], colour: Colour, size: float) -> None:
    """Write on a picture from a lower left corner, with a dark edge."""
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
    write_text(strip, f"{count} {what}", (8, 20), (255, 255, 255), 0.45)
    for x, y, name, colour in entries:
        cv2.line(strip, (x, y - 4), (x + 18, y - 4), colour, 2, cv2.LINE_AA)
        write_text(strip, name, (x + 24, y), (230, 230, 230), 0.42)
    return strip


def _bgr(colour: str) -> Colour:
    red, green, blue = rgb(colour)
    return blue, green, red
