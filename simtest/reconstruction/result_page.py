"""The pages of a picture and of a sequence: one file each that needs nothing else, but for a sequence's pictures."""

import base64
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.estimators.budget import deviations
from simtest.pages.html import write_page
from simtest.pages.style import colours
from simtest.reconstruction.description import PictureRecord, Points, SpecularityRecord
from simtest.reconstruction.ranking import deviation_deg
from simtest.reconstruction.tracking import Track, TrackedFrame
from simtest.runtime.arrays import Image
from simtest.runtime.files import JsonObject

MAX_PICTURE_BYTES = 1_200_000

LEAST_FRAMES = 3
"""Shorter tracks are counted, not listed."""


def write_picture_page(path: Path, record: PictureRecord, picture: Image) -> None:
    """Write the page of a picture in [0, 1], RGB as encoded: its highlights one by one, to zoom and click."""
    spots = record.specularities
    palette = colours(name for spot in spots for name in spot.estimates)
    data = {
        "spots": [_spot(spot, palette) for spot in spots],
        "others": [
            {"kind": h.kind, "outline": _rounded(h.outline, 1), "peak": np.add(h.region.peak, 0.5).tolist(),
             "score": h.score}
            for h in (*record.other_highlights, *(s.highlight for s in spots if s.highlight and s.peak_px is None))
        ],
        "colours": palette,
    }  # fmt: skip
    height, width = picture.shape[:2]
    address = _data_address(picture)
    title, stated = Path(record.image).name, str(record.stated or "")
    write_page(
        path, "picture.html.j2", data, record=record, stated=stated, picture=address, title=title, width=width,
        height=height,
    )  # fmt: skip


def write_sequence_page(path: Path, frames: Sequence[TrackedFrame], tracks: Sequence[Track]) -> None:
    """Write the page of a sequence: its frames, whose pictures lie beside it in frames/, and its tracks."""
    data = {
        "frames": [
            {"file": f"frames/{frame.index:06d}.jpg", "name": frame.name, "time": frame.time_s,
             "count": len(frame.specularities)}
            for frame in frames
        ],
        "position": {frame.index: i for i, frame in enumerate(frames)},
    }  # fmt: skip
    listed = [track for track in tracks if len(track.frames) >= LEAST_FRAMES]
    write_page(path, "sequence.html.j2", data, count=len(frames), tracks=listed, short=len(tracks) - len(listed))


def _data_address(picture: Image) -> str:
    """Return the picture as a JPEG's data address, of lower quality where it would be large."""
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    values = values if values.ndim == 2 else cv2.cvtColor(values, cv2.COLOR_RGB2BGR)
    data = b""
    # lower the quality until the page is small enough
    for quality in (92, 80, 65, 45):
        data = cv2.imencode(".jpg", values, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= MAX_PICTURE_BYTES:
            break
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")


def _spot(spot: SpecularityRecord, palette: dict[str, str]) -> JsonObject:
    return {
        "id": spot.id,
        "peak": spot.position_px.tolist(),
        "size": max(spot.box_px[2:]),
        "kind": spot.kind,
        "score": spot.score,
        "best": spot.best,
        "because": spot.best_because,
        "rows": [
            {"name": name, "colour": palette[name], **_row(name, result, spot)}
            for name, result in spot.estimates.items()
        ],
    }


def _row(name: str, result: Estimate | Failure, spot: SpecularityRecord) -> JsonObject:
    if isinstance(result, Failure):
        return {"status": str(result.reason), "detail": result.detail}
    # Rounded: a tenth of a pixel cannot be seen, and the digits would double the page.
    error = spot.reference.errors.get(name) if spot.reference else None
    drawing = spot.drawings[name]
    return {
        "status": "ok",
        "normals": _rounded(result.candidates, 4),
        "margin": result.choice_margin,
        "look": [v if np.isfinite(v) else None for v in result.look_px.tolist()],
        "isophotes": [_rounded(points, 1) for _, points in drawing.isophotes],
        "curves": [_rounded(curve, 1) for curve in drawing.curves],
        "deviation": deviation_deg(result),
        "target": result.target,
        "parts": {name: round(float(np.degrees(v)), 4) for name, v in deviations(result.budget or {}).items()},
        "flags": result.flags,
        "error": error and error.error_deg,
    }


def _rounded(points: npt.ArrayLike, digits: int) -> Points:
    return np.round(np.asarray(points, dtype=float), digits).tolist()
