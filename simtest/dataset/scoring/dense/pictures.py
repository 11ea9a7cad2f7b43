"""Pictures of a frame for the page: the frame, true and estimated normals as colours, and the error."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.dataset.scoring.dense.frame_truth import FrameTruth
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array, Image, Picture

WIDTH = 320
"""Width of a picture, px."""

ERROR_END_DEG = 30.0
"""Error at which the colours end."""

_UNANSWERED, _EXCLUDED = (190, 60, 160), (60, 64, 70)
"""Colours of pixels without an answer, and of those that are not scored."""

_TO_VIEWER = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Shown:
    """The pictures of one frame, with their captions."""

    frame: str
    setting: str
    source: str | None
    pictures: list[tuple[str, Picture]]
    median_deg: float | None


def picture_row(truth: FrameTruth, estimate: Array | None, source: str | None) -> Shown:
    """Return the pictures of a frame; `estimate` are the normals of a source, shape (H, W, 3), None for no answer."""
    normal = truth.normal["fine"]
    pictures = [] if truth.image is None else [("frame", _small(_grey(truth.image)))]
    pictures.append(("true normal (fine surface)", _small(normal_colours(normal, truth))))
    error = np.full(truth.size, np.nan)
    if estimate is not None:
        error = angle_deg(estimate, normal)
        pictures.append(("estimated normal", _small(normal_colours(estimate, truth))))
    error[~truth.scored] = np.nan
    known = error[np.isfinite(error)]
    pictures.append(("error", _small(error_colours(error, truth))))
    return Shown(truth.name, truth.setting, source, pictures, float(np.median(known)) if known.size else None)


def normal_colours(normal: Array, truth: FrameTruth) -> Picture:
    """Return normals as colours: red right, green up, blue towards the camera."""
    known = np.isfinite(normal).all(axis=-1)
    colours = np.rint(127.5 * (1 + np.nan_to_num(normal) * _TO_VIEWER)).astype(np.uint8)
    colours[~known] = _UNANSWERED
    colours[~truth.scored] = _EXCLUDED
    return colours


def error_colours(error: Array, truth: FrameTruth) -> Picture:
    """Return errors, deg, as colours from dark (0) to bright (`ERROR_END_DEG` and beyond)."""
    share = np.clip(np.nan_to_num(error) / ERROR_END_DEG, 0, 1)
    colours = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)[:, :, ::-1].copy()
    colours[~np.isfinite(error)] = _UNANSWERED
    colours[~truth.scored] = _EXCLUDED
    return np.asarray(colours, np.uint8)


def _grey(image: Image) -> Picture:
    """Return a frame for the eye, as it is encoded."""
    values = np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)
    return values if values.ndim == 3 else np.repeat(values[:, :, None], 3, axis=2)


def _small(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    if width <= WIDTH:
        return picture
    size = (WIDTH, max(1, round(height * WIDTH / width)))
    # Colours of single pixels, since a mean of two directions is none.
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_NEAREST), np.uint8)
