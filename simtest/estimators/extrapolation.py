"""Linear extrapolation of the isophotes' properties to the peak, as weights of the single isophotes."""

import numpy as np

from simtest.geometry import Array
from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2

LEAST_VARIANCE_PX2 = 4.0
"""A lobe's variance is not trusted below this: little but the widths of pixel and smoothing is then left of it."""


def weights_at_zero(levels: Array) -> Array:
    """Return the weights of values at some levels in the value at level 0 of the straight line through them."""
    gaps = levels - levels.mean()
    spread = float(gaps @ gaps)
    # One level alone, or several equal ones, do not determine the slope: it is taken as 0.
    slope = gaps / spread if spread > 0 else np.zeros_like(levels)
    return np.asarray(1 / len(levels) - levels.mean() * slope)


def weights_of_axes(conics: Array, isovalues: Array, px2: Array, smoothing_px: float) -> Array:
    """Return the weights of the cones' axes in the axis of the peak before smoothing, shape (K,); their sum is 1.

    The axis moves linearly with the isophote's area: without a base that is as with -ln t, but it also holds where the
    lobe stands on a base. Let log I have terms of third order in w. Smoothing by s then moves the peak as far as the
    isophotes' centres move while -ln t grows by 2 s^2 / V, V the lobe's variance before smoothing; where V differs
    between the lobe's axes, by an amount between both, usually near that of the longer axis. The line is therefore
    followed that far beyond area 0.

    Parameters
    ----------
    conics : ndarray, shape (K, 5)
        (a, b, c, d, e) of each isophote's a x^2 + b x y + c y^2 + d x + e y = 1, tangents across the axis.
    isovalues : ndarray, shape (K,)
        t of each.
    px2 : ndarray, shape (2, 2)
        1 px^2 in squared tangents.
    smoothing_px : float
        s, px.
    """
    a, b, c = conics.T[:3]
    smoothing = smoothing_px**2 + LINEAR_INTERPOLATION_PX2
    # area of each isophote from its second moments 11, 12, 22, to which the loss by interpolation is added back
    added = LINEAR_INTERPOLATION_PX2 * np.array([[px2[0, 0]], [px2[0, 1]], [px2[1, 1]]])
    p, q, r = np.array([c, -b / 2, a]) / (a * c - b * b / 4) + added
    areas = np.sqrt(np.maximum(p * r - q * q, 0.0))
    # variance of the smoothed lobe, px^2; the highest pixel is accurate enough for its peak
    sums = np.array([[p.sum(), q.sum()], [q.sum(), r.sum()]]) / float(-2 * np.log(isovalues).sum())
    lobe = np.linalg.solve(px2, sums)
    # how far beyond area 0, from the lobe's longer axis
    half, product = float(np.trace(lobe)) / 2, float(np.linalg.det(lobe))
    longer = half + np.sqrt(max(half * half - product, 0.0)) - smoothing
    beyond = 4 * smoothing * np.sqrt(max(product, 0.0) * np.linalg.det(px2)) / max(longer, LEAST_VARIANCE_PX2)
    return weights_at_zero(areas + float(beyond))
