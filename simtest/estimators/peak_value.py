"""The peak value of a lobe, from all pixels around the peak instead of the highest one alone."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.geometry import Array, Index, Mask, Patch

TOP_ISOVALUE = 0.8
"""Above it the logarithm of a glossy lobe is quadratic to a part in a thousand."""

CLIPPED_ISOVALUE = 0.5
"""The same where the top is clipped: the rest must be wide enough to show the paraboloid's curvature."""

CLIPPED_NEAR = 0.05
"""Largest share of clipped pixels around a fitted one: with more, clipping has lowered its smoothed value."""

MIN_PIXELS = 12
"""Twice the number of the paraboloid's coefficients."""


@dataclass(frozen=True)
class PeakValue:
    """The peak value of a lobe and how it moves with the patch's pixels.

    Parameters
    ----------
    value : float
        Intensity.
    pixels : ndarray of int, shape (N,)
        Indices in the flattened patch.
    weights : ndarray, shape (N,)
        Change of log(value) per unit of intensity of each.
    """

    value: float
    pixels: Index
    weights: Array


def fit_peak_value(patch: Patch) -> PeakValue:
    """Return the apex of a patch, fitted once (see `_fit`)."""
    _, kept = patch.kept.get("peak value", (None, None))
    if not isinstance(kept, PeakValue):
        kept = _fit(patch)
        patch.kept["peak value"] = (None, kept)
    return kept


def _fit(patch: Patch) -> PeakValue:
    """Fit a paraboloid to the logarithm of a patch above t = 0.8 and return its apex.

    Where pixels there are clipped, the ring around them down to t = 0.5 is fitted. Where the region does not close, is
    small, or is no dome, the peak's own pixel is used.
    """
    # candidates: the pixels of the region, their coordinates centred and scaled
    column, row = patch.peak_pixel
    own = np.array([row * patch.values.shape[1] + column])
    fallback = PeakValue(patch.peak_value, own, np.array([1 / patch.peak_value]))
    inside = _region(patch)
    pixels = np.flatnonzero(inside)
    values = patch.values.ravel()[pixels].astype(float)
    if len(pixels) < MIN_PIXELS or values.min() <= 0 or len(pixels) == inside.size:
        return fallback
    rows = pixels // patch.values.shape[1]
    x, y = _centred(pixels - rows * patch.values.shape[1]), _centred(rows)
    # least squares by the normal equations
    design = np.array([np.ones_like(x), x, y, x * x, x * y, y * y])
    normal = design @ design.T
    # The eigenvalues show the condition and, with the vectors, solve for both right sides.
    spread, vectors = np.linalg.eigh(normal)
    if not spread[0] * 1e12 > spread[-1]:
        return fallback
    inverse = (vectors / spread) @ vectors.T
    f, d, e, a, b, c = (inverse @ (design @ np.log(values))).tolist()
    if not (a < 0 and 4 * a * c > b * b):
        return fallback
    # apex; rejected outside of the pixels
    determinant = 4 * a * c - b * b
    u, v = (b * e - 2 * c * d) / determinant, (b * d - 2 * a * e) / determinant
    apex = np.array([1.0, u, v, u * u, u * v, v * v])
    value = float(np.exp(apex @ [f, d, e, a, b, c]))
    if u * u + v * v > 1:
        return fallback
    # At the apex the value's derivative by position is 0, so only the fit's coefficients move it.
    return PeakValue(value, pixels, (inverse @ apex) @ design / values)


def _centred(indices: Index) -> Array:
    """Return indices relative to their mean, over their range."""
    return np.asarray((indices - indices.mean()) / max(indices.max() - indices.min(), 1))


def _region(patch: Patch) -> Mask:
    """Return the pixels that the paraboloid is fitted to, shape (h, w)."""
    inside = patch.inside(TOP_ISOVALUE, cut=True)
    if patch.saturated is None or not (patch.saturated & inside).any():
        return inside
    side = 2 * int(np.ceil(2 * patch.smoothing_px)) + 1
    near = cv2.blur(patch.saturated.astype(np.float32), (side, side), borderType=cv2.BORDER_REFLECT)
    return np.asarray(patch.inside(CLIPPED_ISOVALUE, cut=True) & (near < CLIPPED_NEAR))
