"""The noise of a frame, from the frame."""

import cv2
import numpy as np
import numpy.typing as npt

_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
"""Difference of two Laplacians: blind to any quadratic image (Immerkaer 1996); its norm is 6."""

MAD_TO_SIGMA = 1.4826


def estimate_noise(frame: npt.ArrayLike) -> float:
    """Estimate the standard deviation of white noise, robust against edges and highlights.

    Parameters
    ----------
    frame : array_like, shape (H, W)
        Intensities before smoothing.

    Returns
    -------
    float
        In the frame's units; 0 for frames under 3 x 3 px.
    """
    image = np.ascontiguousarray(frame, dtype=np.float32)
    if min(image.shape) < 3:
        return 0.0
    response = cv2.filter2D(image, cv2.CV_32F, _KERNEL)[1:-1, 1:-1]
    return float(MAD_TO_SIGMA * np.median(np.abs(response)) / 6.0)
