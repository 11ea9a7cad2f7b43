"""Pictures of real frames for the eye: normals as needles with their deviation."""

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from simtest.estimators import Estimate
from simtest.reconstruction import Specularity
from simtest.runtime.arrays import Image, Picture

NEEDLE, REGION = (255, 220, 0), (255, 255, 255)

NEEDLE_SHARE = 0.10
"""Length of a needle across the view, as a share of the picture's width."""

TILE_PX, QUALITY, LEAST_QUALITY, LARGEST_BYTES = 300, 80, 30, 300_000


def needles(picture: Image, found: Sequence[Specularity], name: str, scale: int = 1) -> Picture:
    """Draw an estimator's normals: a needle from each highlight, as its normal points, and its stated deviation.

    The circle around a needle's tip has the radius of the stated deviation, on the needle's scale.
    """
    canvas = _canvas(picture, scale)
    length = NEEDLE_SHARE * picture.shape[1] * scale
    for each in found:
        result = each.estimates.get(name)
        if not isinstance(result, Estimate):
            continue
        start = np.rint(result.look_px * scale).astype(int)
        end = np.rint(result.look_px * scale + length * result.normal[:2]).astype(int)
        cv2.line(canvas, start.tolist(), end.tolist(), NEEDLE, 1, cv2.LINE_AA)
        cv2.circle(canvas, start.tolist(), 2, NEEDLE, -1, cv2.LINE_AA)
        if result.deviation_deg is not None:
            radius = round(length * math.radians(min(result.deviation_deg, 90.0)))
            cv2.circle(canvas, end.tolist(), radius, REGION, 1, cv2.LINE_AA)
    return canvas


def _canvas(picture: Image, scale: int) -> Picture:
    """Return a picture in OpenCV's order of channels, enlarged, and darker so that lines stand out."""
    values = np.rint(255 * 0.8 * np.clip(picture, 0, 1)).astype(np.uint8)
    canvas = cv2.cvtColor(values, cv2.COLOR_RGB2BGR)
    if scale > 1:
        canvas = cv2.resize(canvas, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return np.asarray(canvas, dtype=np.uint8)


def write_sheet(rows: Sequence[Sequence[Picture]], titles: Sequence[str], file: Path) -> None:
    """Write pictures as one JPEG below a line of titles, of 300 kB at most."""
    drawn = [_titles(titles)]
    for row in rows:
        height = max(round(picture.shape[0] * TILE_PX / picture.shape[1]) for picture in row)
        tiles = []
        for picture in row:
            own = round(picture.shape[0] * TILE_PX / picture.shape[1])
            tile = cv2.resize(picture, (TILE_PX, own), interpolation=cv2.INTER_AREA)
            tiles.append(cv2.copyMakeBorder(tile, 0, height - own + 3, 0, 3, cv2.BORDER_CONSTANT))
        drawn.append(np.hstack(tiles))
    sheet = np.vstack(drawn)
    for quality in range(QUALITY, LEAST_QUALITY - 1, -5):
        done, data = cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if done and len(data) <= LARGEST_BYTES:
            break
    file.write_bytes(data.tobytes())


def _titles(titles: Sequence[str]) -> Picture:
    band = np.zeros((20, len(titles) * (TILE_PX + 3), 3), dtype=np.uint8)
    for number, title in enumerate(titles):
        at = (number * (TILE_PX + 3) + 4, 14)
        cv2.putText(band, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return band
