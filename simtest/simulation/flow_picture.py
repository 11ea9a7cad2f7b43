"""Shows flow as colour: the hue is its direction, the saturation its length."""

import math

import cv2
import numpy as np

from simtest.runtime.arrays import Array, Picture
from simtest.simulation.flow import SEEN, Flow

PERCENTILE = 99.0
"""Of the flow's lengths: it and longer ones have full colour."""

WHEEL_SHARE = 0.2
"""Diameter of the key's wheel over the picture's height."""

HIDDEN_VALUE = 0.45
"""Brightness of what the other frame does not see; what has no flow is black."""


def flow_picture(flow: Flow, full_px: float | None = None) -> Picture:
    """Return flow as a picture, shape (H, W, 3), uint8, blue first, with a wheel as its key.

    Parameters
    ----------
    flow : Flow
        What to show.
    full_px : float, optional
        Length of full colour, px; default the percentile `PERCENTILE` of the flow's own.
    """
    known = np.isfinite(flow.flow_px).all(axis=-1)
    if full_px is None:
        lengths = np.hypot(*flow.flow_px[known].T)
        full_px = float(np.percentile(lengths, PERCENTILE)) if len(lengths) else 1.0
    value = np.where(flow.state == SEEN, 1.0, HIDDEN_VALUE) * known
    picture = _coloured(np.nan_to_num(flow.flow_px), value, full_px)
    _draw_key(picture, full_px)
    return picture


def _coloured(flow_px: Array, value: Array, full_px: float) -> Picture:
    """Return the colours, blue first, of flow, shape (H, W, 2), with a brightness, shape (H, W), in [0, 1]."""
    x, y = flow_px[..., 0], flow_px[..., 1]
    # OpenCV's hue of 8 bits counts 2 deg; right is red, down is yellow-green.
    hue = np.degrees(np.arctan2(y, x)) % 360 / 2
    length = np.minimum(np.hypot(x, y) / max(full_px, 1e-12), 1.0)
    hsv = np.stack([hue, 255 * length, 255 * value], axis=-1).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), dtype=np.uint8)


def _draw_key(picture: Picture, full_px: float) -> None:
    """Draw the wheel in the lower right corner: a point's colour is that of the flow from the centre to it."""
    height, width = picture.shape[:2]
    size = min(math.ceil(WHEEL_SHARE * height), width)
    radius = size / 2
    axis = (np.arange(size) + 0.5 - radius) / radius
    pairs = np.stack(np.meshgrid(axis, axis), axis=-1)
    inside = np.hypot(pairs[..., 0], pairs[..., 1]) <= 1
    wheel = _coloured(pairs, np.ones(pairs.shape[:2]), 1.0)
    corner = picture[height - size :, width - size :]
    corner[inside] = wheel[inside]
    label, scale = f"{full_px:.3g} px", max(size / 200, 0.3)
    (text_width, text_height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    at = (width - text_width - 2, height - size - max(text_height // 2, 2))
    # A dark border: the picture below may have any colour.
    for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(picture, label, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA)
