"""The noise of a frame, estimated from the frame."""

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Mask

_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
"""Difference of two Laplacians: blind to any quadratic image (Immerkaer 1996); its norm is 6."""

MAD_TO_SIGMA = 1.4826

CLEAR_SIDE_PX = 7
"""A pixel counts if at most one pixel is clipped in the square of this side around it."""

MIN_CLEAR = 100
"""With fewer pixels clear of clipped ones, all pixels are the better sample."""

SAMPLE = 2048
"""So many values show where the median of many more lies."""


def estimate_noise(frame: npt.ArrayLike, seen: Mask | None = None, clipped: Mask | None = None) -> float:
    """Estimate the standard deviation of white noise in a frame before smoothing, robust against edges and highlights.

    Parameters
    ----------
    frame : array_like, shape (H, W)
        Intensities; frames, or views, under 3 x 3 px have noise 0.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all. Outside it there is more than the sensor's noise.
    clipped : ndarray of bool, shape (H, W), optional
        Pixels at either end of the sensor's range. Their noise is truncated, on a dark ground by half, so pixels near
        them are left out where enough others remain.
    """
    image = np.ascontiguousarray(frame, dtype=np.float32)
    if min(image.shape) < 3:
        return 0.0
    # second differences: noise, edges and highlights are left
    response = cv2.filter2D(image, cv2.CV_32F, _KERNEL)[1:-1, 1:-1]
    # reject pixels at the view's border and near clipped ones
    whole = np.ones(response.shape, dtype=bool)
    if seen is not None:
        whole = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)[1:-1, 1:-1] > 0
    if clipped is not None and clipped.any():
        size = (CLEAR_SIDE_PX, CLEAR_SIDE_PX)
        near = cv2.boxFilter(clipped.astype(np.float32), -1, size, normalize=False)[1:-1, 1:-1]
        clear = whole & (near < 1.5)
        whole = clear if np.count_nonzero(clear) >= MIN_CLEAR else whole
    response = response[whole]
    if not response.size:
        return 0.0
    # robust spread
    return float(MAD_TO_SIGMA * median(np.abs(response)) / 6.0)


def median(values: npt.NDArray[np.floating]) -> np.floating:
    """Return the median of real numbers, shape (n,), as `np.median` does, which loads `numpy.ma` first."""
    largest: np.floating = values.max()
    if np.isnan(largest):
        return largest
    middle = len(values) // 2
    lower = middle if len(values) % 2 else middle - 1
    below, near = _around_median(values)
    if not below <= lower <= middle < below + len(near):
        below, near = 0, values
    ordered = np.partition(near, (lower - below, middle - below))
    if lower == middle:
        return values.dtype.type(ordered[middle - below])
    return values.dtype.type((ordered[lower - below] + ordered[middle - below]) / values.dtype.type(2))


def _around_median(values: npt.NDArray[np.floating]) -> tuple[int, npt.NDArray[np.floating]]:
    """Return the values in a range that usually holds the median of many, and how many lie below it.

    The tenth of the values about the median of a sample: the rest need not be put in order.
    """
    if len(values) < 16 * SAMPLE:
        return 0, values
    sample = np.sort(values[:: len(values) // SAMPLE])
    low, high = sample[int(0.45 * len(sample))], sample[int(0.55 * len(sample))]
    return int(np.count_nonzero(values < low)), values[(values >= low) & (values <= high)]
