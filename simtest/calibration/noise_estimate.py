"""The noise of a frame, estimated from the frame."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Image, Mask
from simtest.geometry.patch import share_of_noise

_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
"""Difference of two Laplacians: blind to any quadratic image (Immerkaer 1996); its norm is 6."""

MAD_TO_SIGMA = 1.4826

CLEAR_SIDE_PX = 7
"""A pixel counts if at most one pixel is clipped in the square of this side around it."""

COLOURED = 1.15
"""A smoothed frame with so many times the noise that white noise leaves has noise that is not white; less is chance, or
the tissue's shading."""

SPACING = 2
"""Spacing of the second differences over the width of the smoothing: nearer pixels share their noise."""

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


def estimate_coarse_noise(
    smoothed: Image, sigma_px: float, seen: Mask | None = None, clipped: Mask | None = None
) -> float:
    """Estimate the noise of a smoothed frame, as the standard deviation of white noise that would leave as much of it.

    Demosaicing and coding take noise from the finest scale, where `estimate_noise` looks, and leave or add it at the
    coarser one that isophotes are found at. Second differences of the smoothed frame, two widths of the smoothing
    apart, show it there.

    Parameters
    ----------
    smoothed : ndarray of float32, shape (H, W)
        The frame, smoothed by a Gaussian of `sigma_px`.
    sigma_px : float
        px; below 1, where pixels are no fine grid, and of frames too small for the differences, 0: not known.
    seen, clipped : ndarray of bool, shape (H, W), optional
        As in `estimate_noise`.
    """
    step = round(sigma_px)
    reach = 2 * SPACING * step
    if sigma_px < 1 or min(smoothed.shape) <= 2 * reach:
        return 0.0
    # The smoothed frame is smooth over a step: every pixel of a coarser grid suffices.
    coarse = np.ascontiguousarray(smoothed[::step, ::step])
    kernel = np.zeros(2 * SPACING + 1, dtype=np.float32)
    kernel[[0, SPACING, -1]] = 1, -2, 1
    inner = (slice(SPACING, -SPACING),) * 2
    response = cv2.sepFilter2D(coarse, cv2.CV_32F, kernel, kernel)[inner]
    # reject what a clipped or unseen pixel is near to
    whole = np.ones(smoothed.shape, dtype=np.uint8) if seen is None else seen.astype(np.uint8)
    if clipped is not None:
        whole[clipped] = 0
    around = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    kept = cv2.erode(whole, around, borderValue=1)[::step, ::step][inner] > 0
    if np.count_nonzero(kept) < MIN_CLEAR:
        return 0.0
    # Smoothed white noise has the correlation exp(-l^2 / 4 s^2) at a distance l.
    near, far = (math.exp(-((SPACING * step * k / sigma_px) ** 2) / 4) for k in (1, 2))
    left = (6 - 8 * near + 2 * far) * share_of_noise(sigma_px)
    return MAD_TO_SIGMA * float(median(np.abs(response[kept]))) / left


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
