"""What a network that finds highlights sees of a frame: its light, the split by colour, and where it is clipped."""

import cv2
import numpy as np

from simtest.calibration.calibration import mean_channel
from simtest.detection.light_split import SplitLight
from simtest.geometry import Image, Mask

DARKEST = 0.02
"""Share of the frame's median light that is added before the logarithm; what lies outside the view is this dark."""

LIT = 0.003
"""Share of full scale above which a pixel is lit, 10 of 255 steps of sRGB: a black background sets no scale."""

SPECULAR_SCALE = 0.1
"""Specular light, share of the tissue's, below which its input is linear, and above logarithmic."""

INPUTS = ("logarithm of red", "logarithm of green", "logarithm of blue", "specular light", "clipped")
"""The channels. The first three are over the median light of the lit pixels."""


def highlight_inputs(linear: Image, clipped: Mask, light: SplitLight, seen: Mask | None = None) -> Image:
    """Return the inputs of a frame, float32, shape (5, H, W).

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear values, share of full scale.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    light : SplitLight
        The frame's two parts (`simtest.detection.light_split.split_light`).
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.
    """
    height, width = clipped.shape
    inside = np.ones((height, width), dtype=bool) if seen is None else seen
    median = median_light(linear, inside)
    made = np.empty((len(INPUTS), height, width), dtype=np.float32)
    for number, channel in enumerate(cv2.split(np.ascontiguousarray(linear, dtype=np.float32))):
        made[number] = cv2.log(np.where(inside, channel / median, np.float32(0)) + np.float32(DARKEST))
    share = light.specular / np.maximum(light.tissue, DARKEST * median)
    made[3] = np.where(inside, np.arcsinh(share / np.float32(SPECULAR_SCALE)), np.float32(0))
    made[4] = clipped & inside
    return made


def median_light(linear: Image, inside: Mask) -> float:
    """Return the median of the mean of the channels of lit pixels inside the view, from every other row and column.

    It is 1e-6 where none is lit.
    """
    light = mean_channel(linear[::2, ::2])[inside[::2, ::2]]
    light = light[light > LIT]
    return float(np.median(light)) if light.size else 1e-6


def frame_statistics(linear: Image, seen: Mask | None, longer_side_px: int) -> tuple[float, float]:
    """Return longer side, px, as the network sees the frame, and logarithm of the median light, share of full scale."""
    inside = np.ones(linear.shape[:2], dtype=bool) if seen is None else seen
    return float(longer_side_px), float(np.log(median_light(linear, inside)))
