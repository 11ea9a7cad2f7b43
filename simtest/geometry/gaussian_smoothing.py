"""Gaussian smoothing of a frame, normalised inside a view mask."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, Image, Mask

LEAST_SMOOTHING_PX = 0.5
"""What the parabola through three pixels amounts to, where a frame is not smoothed."""


def smooth(frame: npt.ArrayLike, sigma_px: float, seen: Mask | None = None) -> Image:
    """Smooth a frame, shape (H, W) or (H, W, C), with a Gaussian of a standard deviation in px; 0 leaves it as it is.

    With `seen`, shape (H, W), the pixels inside a camera's view mask, each smoothed value is the weighted mean of those
    alone, so that the dark outside does not lower the values at the mask's border; pixels outside become 0.
    """
    image = np.ascontiguousarray(frame, dtype=np.float32)
    if seen is None:
        return _blurred(image, sigma_px)
    inside = seen if image.ndim == 2 else seen[:, :, None]
    weights = _blurred(seen.astype(np.float32), sigma_px).reshape(inside.shape)
    blurred = _blurred(np.where(inside, image, np.float32(0)), sigma_px)
    return np.asarray(np.divide(blurred, weights, where=inside, out=np.zeros_like(image)))


def share_of_noise(sigma_px: float) -> float:
    """Return the share of white noise that smoothing leaves: 1 / (2 sqrt(pi) s) for a wide Gaussian."""
    return 1 / math.sqrt(1 + 4 * math.pi * sigma_px**2)


def slope_divisor_px2(sigma_px: npt.ArrayLike) -> Array:
    """Return what divides the standard deviation of white noise for that of the smoothed noise's slope an axis, px^2.

    The slope has the variance sigma^2 / (8 pi s^4).
    """
    return np.asarray(np.sqrt(8 * np.pi) * np.maximum(sigma_px, LEAST_SMOOTHING_PX) ** 2)


def _blurred(image: Image, sigma_px: float) -> Image:
    if sigma_px <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))
