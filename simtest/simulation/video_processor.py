"""What a video processor does to a picture: colour, sharpening, scaling and what it draws into it.

Pictures are float32, shape (H, W) or (H, W, 3), red, green, blue; encoded ones lie in [0, 1] where the sensor clips.
"""

import cv2
import numpy as np

from simtest.runtime.arrays import Array, Image, Mask
from simtest.spec.sensor import Caption, ColourProcessing, Overlay, Scaling, Sharpening

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of red, green and blue in the luma of encoded pictures (ITU-R BT.601)."""

_METHODS = {
    "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "area": cv2.INTER_AREA, "lanczos": cv2.INTER_LANCZOS4,
}  # fmt: skip

_FONT, _CAPITAL_PX = cv2.FONT_HERSHEY_SIMPLEX, 20.0
"""Font of captions, and the height of its capitals at scale 1, px."""


def luma(picture: Image) -> Image:
    """Return the luma of an encoded picture, shape (H, W)."""
    return picture if picture.ndim == 2 else np.asarray(cv2.transform(picture, LUMA[None]))


# Colour ---------------------------------------------------------------------------------------------------------------


def as_seen_by_sensor(frame: Image, colour: ColourProcessing) -> Image:
    """Return the light that the sensor's own colours receive, shape (H, W, 3); none is negative."""
    inverse = np.asarray(np.linalg.inv(np.array(colour.matrix) * colour.gains), dtype=float)
    return np.asarray(np.maximum(_mix(frame, inverse), 0.0), dtype=np.float32)


def develop(frame: Image, colour: ColourProcessing, clips: bool) -> Image:
    """Apply white balance and colour matrix to the sensor's values, shape (H, W, 3).

    With `clips` values end at 1 before and behind the gains, so that what fills the wells becomes white, not magenta.
    """
    balanced = _mix(np.clip(frame, 0.0, 1.0) if clips else frame, np.diag(colour.gains))
    if clips:
        np.minimum(balanced, np.float32(1), out=balanced)
    return _mix(balanced, np.array(colour.matrix))


def _mix(frame: Image, matrix: Array) -> Image:
    colours = frame if frame.ndim == 3 else np.repeat(frame[..., None], 3, axis=2)
    return np.asarray(cv2.transform(np.ascontiguousarray(colours, dtype=np.float32), matrix.astype(np.float32)))


# Detail ---------------------------------------------------------------------------------------------------------------


def sharpen(picture: Image, sharpening: Sharpening) -> Image:
    """Return an encoded picture whose luma was unsharp masked; all channels change alike. It is not clipped."""
    value = luma(picture)
    smooth = cv2.GaussianBlur(value, (0, 0), sharpening.radius_px, borderType=cv2.BORDER_REFLECT_101)
    change = np.float32(sharpening.amount) * (value - smooth)
    return np.asarray(cv2.add(picture, change if picture.ndim == 2 else cv2.merge([change] * 3)))


def rescale(picture: Image, scaling: Scaling) -> Image:
    """Return a picture that was recorded at another size and scaled back to its own."""
    height, width = picture.shape[:2]
    size = (max(round(width * scaling.factor), 1), max(round(height * scaling.factor), 1))
    method = _METHODS[scaling.method]
    # Towards a smaller size areas are averaged, or else fine detail would alias.
    smaller = scaling.factor < 1
    recorded = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else method)
    return np.asarray(cv2.resize(recorded, (width, height), interpolation=method if smaller else cv2.INTER_AREA))


# Graphics -------------------------------------------------------------------------------------------------------------


def draw(picture: Image, overlay: Overlay, seen: Mask | None) -> Image:
    """Return an encoded picture with what the processor draws: black outside `seen`, then boxes, then captions."""
    drawn = picture.copy() if seen is None else np.asarray(cv2.copyTo(picture, seen.astype(np.uint8)))
    height, width = drawn.shape[:2]
    for box in overlay.boxes:
        left, top = round(box.x * width), round(box.y * height)
        right, bottom = round((box.x + box.width) * width), round((box.y + box.height) * height)
        drawn[top:bottom, left:right] = _paint(box.colour, drawn)
    for caption in overlay.captions:
        cover = _cover(caption, (height, width))
        cover = cover if drawn.ndim == 2 else cover[..., None]
        drawn += cover * (_paint(caption.colour, drawn) - drawn)
    return drawn


def _paint(colour: tuple[float, float, float], picture: Image) -> Image:
    values = np.array(colour, dtype=np.float32)
    return values if picture.ndim == 3 else np.asarray(values @ LUMA)


def _cover(caption: Caption, size: tuple[int, int]) -> Image:
    """Return the share of each pixel, shape (H, W), that a caption covers."""
    height, width = size
    # OpenCV smooths the edges of letters in pictures of 8 bits alone.
    cover = np.zeros(size, np.uint8)
    thickness = max(1, round(caption.height_px / 12))
    scale = caption.height_px / _CAPITAL_PX
    corner = (round(caption.x * width), round(caption.y * height))
    cv2.putText(cover, caption.text, corner, _FONT, scale, 255, thickness, cv2.LINE_AA)
    return np.asarray(cover.astype(np.float32) / 255)
