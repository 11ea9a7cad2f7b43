"""Propagation of pixel noise to quantities that depend on the crossings of isophotes."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Array, Index
from simtest.runtime.arrays import Image

Rows = npt.NDArray[np.float32]

KERNEL_SIGMAS = 4.0
"""Half-width of the smoothing kernel over its standard deviation."""


def conics_by_crossings(
    tangents: Array, gradient: Array, steps: Array, parts: Sequence[slice], weighted: Sequence[bool]
) -> tuple[Array, Array]:
    """Compute how fitted conics a x^2 + b x y + c y^2 + d x + e y = 1 move with their points.

    To first order a fit to points near an ellipse moves as the linear fit does, where a gradient-weighted fit weights
    each point by the conic's gradient.

    Parameters
    ----------
    tangents, gradient, steps : ndarray, shape (2, N)
        The points of all conics, the conic's gradient there, and the motion of each point per unit along its line.
    parts : sequence of slice
        The points of each conic.
    weighted : sequence of bool
        Whether each fit is gradient-weighted.

    Returns
    -------
    by_moment, moments : ndarray, shapes (K, 5, 5) and (5, N)
        Conic k moves by by_moment[k] @ moments[:, parts[k]] as its points move.
    """
    (x, y), (by_x, by_y) = tangents, gradient
    design = np.array([x * x, x * y, y * y, x, y])
    moments = design
    if any(weighted):
        counts = [part.stop - part.start for part in parts]
        moments = design / np.where(np.repeat(weighted, counts), by_x**2 + by_y**2, 1.0)
    normal = np.array([moments[:, part] @ design[:, part].T for part in parts])
    # Powers of small tangents differ by orders of magnitude, so the equations are scaled to a diagonal of 1.
    scale = 1 / np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    scales = scale[:, :, None] * scale[:, None, :]
    by_moment = -scales * np.linalg.inv(normal * scales)
    return by_moment, moments * (by_x * steps[0] + by_y * steps[1])


def raw_moves(pixels: Index, moves: Array, width: int, noise: float | Image, smoothing_px: float) -> Rows:
    """Return how far one standard deviation of noise in each raw pixel moves K quantities, shape (K, P).

    The transpose of smoothing carries derivatives by smoothed pixels to raw pixels, whose noise is independent. The
    product of the result with its transpose is therefore the quantities' covariance.

    Parameters
    ----------
    pixels : ndarray of int, shape (N,)
        Indices in the flattened patch, whose rows are `width` long; each may occur several times.
    moves : ndarray, shape (K, N)
        Change of each quantity per unit of intensity there.
    noise : float, or ndarray of float32, shape (h, w)
        Standard deviation before smoothing by a Gaussian of `smoothing_px`.
    """
    # box around the pixels, with a margin of the kernel's half-width
    rows = pixels // width
    columns = pixels - rows * width
    top, bottom, left, right = int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1
    margin = int(np.ceil(KERNEL_SIGMAS * smoothing_px))
    wide, high = right - left + 2 * margin, bottom - top + 2 * margin
    flat = (rows - (top - margin)) * wide + (columns - (left - margin))
    # Scaled by the noise first, so that the numbers have the size of angles, whatever the unit of the intensities.
    scale = float(noise.max()) if isinstance(noise, np.ndarray) else noise
    # Single precision, which takes half the time, suffices for standard deviations.
    raw = np.empty((len(moves), high * wide), np.float32)
    for image, each in zip(raw, moves, strict=True):
        image[:] = np.bincount(flat, scale * each, high * wide)
    # The margins separate the images, so one call smooths all.
    smoothed = _smooth_transposed(raw.reshape(-1, wide), smoothing_px, margin).reshape(len(moves), high, wide)
    if isinstance(noise, np.ndarray) and scale > 0:
        smoothed *= np.pad(noise[top:bottom, left:right] / np.float32(scale), margin, mode="edge")
    return smoothed.reshape(len(moves), -1)


def gram(rows: Rows) -> Array:
    """Return the products of few long rows, shape (K, P), with each other, shape (K, K)."""
    # A copy, because BLAS's routine for a matrix times its own transpose is several times slower on so few rows.
    with np.errstate(over="ignore", invalid="ignore"):
        products = np.dot(rows, rows.copy().T).astype(float)
    if not np.isfinite(products).all():
        # Noise far above the signal leaves the range of single precision.
        products = rows.astype(float) @ rows.astype(float).T
    return np.asarray((products + products.T) / 2)


def _smooth_transposed(images: Rows, sigma_px: float, margin: int) -> Rows:
    """Smooth images, one below the other, that are 0 in a margin of the kernel's half-width."""
    if sigma_px <= 0:
        return images
    side = 2 * margin + 1
    return np.asarray(cv2.GaussianBlur(images, (side, side), sigma_px, borderType=cv2.BORDER_CONSTANT), np.float32)
