"""The colour filter mosaic of a sensor: what each pixel measures, and how the other colours are filled in."""

import cv2
import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Image
from simtest.spec.sensor import Mosaic

_CHANNEL = {"r": 0, "g": 1, "b": 2}

_16_BITS, _8_BITS = 65535, 255


def sample(frame: Image, mosaic: Mosaic) -> Image:
    """Return what the pixels behind the filters measure, shape (H, W), of a linear frame, shape (H, W, 3) or (H, W)."""
    if frame.ndim == 2:
        # White light: all filters pass the same share of it.
        return frame
    plane = np.empty(frame.shape[:2], dtype=frame.dtype)
    for i, letter in enumerate(mosaic.pattern):
        cells = np.s_[i // 2 :: 2, i % 2 :: 2]
        plane[cells] = frame[..., _CHANNEL[letter]][cells]
    return plane


def demosaic(plane: Image, mosaic: Mosaic) -> Image:
    """Fill in the colours that the pixels did not measure.

    Parameters
    ----------
    plane : ndarray of float32, shape (H, W)
        Linear values; those outside [0, 1] are clipped, as by a converter.
    mosaic : Mosaic
        Pattern and method.

    Returns
    -------
    ndarray of float32, shape (H, W, 3)
        In [0, 1], in steps of 1/65535; with "vng" in steps of 1/255 of the square root.
    """
    pattern, clipped = mosaic.pattern.upper(), np.clip(plane, 0.0, 1.0)
    if mosaic.demosaicing == "vng":
        # OpenCV has it for 8 bits alone; the square root makes the noise of light alike at all levels.
        values = np.rint(np.sqrt(clipped) * _8_BITS).astype(np.uint8)
        root = _convert(values, f"COLOR_Bayer{pattern}2RGB_VNG").astype(np.float32) / np.float32(_8_BITS)
        return np.square(root)
    suffix = "_EA" if mosaic.demosaicing == "edge_aware" else ""
    values = np.rint(clipped * np.float32(_16_BITS)).astype(np.uint16)
    filled = _convert(values, f"COLOR_Bayer{pattern}2RGB{suffix}")
    return np.asarray(filled.astype(np.float32) / np.float32(_16_BITS))


def _convert(plane: npt.NDArray[np.unsignedinteger], code: str) -> npt.NDArray[np.unsignedinteger]:
    return np.asarray(cv2.demosaicing(plane, getattr(cv2, code)))
