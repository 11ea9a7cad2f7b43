"""Noise of a frame's pixels in what is linear in its smoothed pixels."""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

KERNEL_SIGMAS = 4.0
"""Half-width of the smoothing kernel over its standard deviation."""


def covariance_of(
    pixels: npt.NDArray[np.intp], moves: Array, width: int, noise: float | npt.NDArray[np.float32], smoothing_px: float
) -> Array:
    """Give the covariance by noise of K quantities, shape (K, K).

    What hangs on the smoothed pixels does on the raw ones, whose noise is independent, by the transpose of smoothing.

    Parameters
    ----------
    pixels : ndarray of int, shape (N,)
        Places in the flattened patch; each may occur several times.
    moves : ndarray, shape (K, N)
        Change of each quantity per unit of intensity there.
    width : int
        Of the patch, px.
    noise : float, or ndarray of float32, shape (h, w)
        Standard deviation before smoothing.
    smoothing_px : float
        Standard deviation of the Gaussian smoothing, px.

    Returns
    -------
    ndarray, shape (K, K)
    """
    images, box = _images(pixels, moves, width)
    margin = int(np.ceil(KERNEL_SIGMAS * smoothing_px))
    level = np.pad(noise[box], margin, mode="edge") if isinstance(noise, np.ndarray) else noise
    smoothed = [_transposed_smoothing(image, smoothing_px, margin) * level for image in images]
    raw = np.stack(smoothed).reshape(len(smoothed), -1)
    return np.asarray(raw @ raw.T)


def _images(flat: npt.NDArray[np.intp], moves: Array, width: int) -> tuple[Array, tuple[slice, slice]]:
    """Sum weights, shape (7, N), at their pixels of a patch; gives the images, cut to where they are, and the cut."""
    rows, columns = np.divmod(flat, width)
    top, left, high, wide = rows.min(), columns.min(), np.ptp(rows) + 1, np.ptp(columns) + 1
    place = (rows - top) * wide + columns - left
    images = np.array([np.bincount(place, each, high * wide).reshape(high, wide) for each in moves], dtype=float)
    return images, (slice(top, top + high), slice(left, left + wide))


def _transposed_smoothing(image: Array, sigma_px: float, margin: int) -> Array:
    if sigma_px <= 0:
        return image
    padded = cv2.copyMakeBorder(image, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=0.0)
    side = 2 * margin + 1
    return np.asarray(cv2.GaussianBlur(padded, (side, side), sigma_px, borderType=cv2.BORDER_CONSTANT))
