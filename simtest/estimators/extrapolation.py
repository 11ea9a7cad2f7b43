"""Where what runs with the isophotes of a highlight has its value at the peak: weights of a straight line."""

import numpy as np
import numpy.typing as npt

from simtest.geometry.level_sets import LINEAR_INTERPOLATION_PX2

Array = npt.NDArray[np.float64]

LEAST_VARIANCE_PX2 = 4.0
"""A lobe's variance is not trusted below this: a pixel's width and the smoothing's are then all that is left of it."""


def weights_at_zero(levels: Array) -> Array:
    """Give the weights of values at some levels in the value at level 0 of the straight line through them."""
    gaps = levels - levels.mean()
    spread = float(gaps @ gaps)
    # One level alone, or several that are the same, leave the slope open: it is then taken as 0.
    slope = gaps / spread if spread > 0 else np.zeros_like(levels)
    return np.asarray(1 / len(levels) - levels.mean() * slope)


def weights_of_axes(conics: Array, isovalues: Array, px2: Array, smoothing_px: float) -> Array:
    """Give the weights of the cones' axes in the axis of the peak as it was before smoothing.

    The axis runs with the isophote's area: as with -ln t where the lobe stands on no base, and where it does, too. Let
    log I have terms of third order in w. Smoothing by s moves the peak by as much as the isophotes' centres run while
    -ln t grows by 2 s^2 / V, V the lobe's variance before smoothing; where it differs between the lobe's axes, by
    something between both, as a rule near that of the longer axis. So far the run is followed beyond area 0.

    Parameters
    ----------
    conics : ndarray, shape (K, 5)
        (a, b, c, d, e) of each isophote's a x^2 + b x y + c y^2 + d x + e y = 1, tangents across the axis.
    isovalues : ndarray, shape (K,)
        t of each.
    px2 : ndarray, shape (2, 2)
        What 1 px^2 is in squared tangents.
    smoothing_px : float
        s, px.

    Returns
    -------
    ndarray, shape (K,)
        Their sum is 1.
    """
    a, b, c = conics.T[:3]
    smoothing = smoothing_px**2 + LINEAR_INTERPOLATION_PX2
    # 11, 12, 22 of each isophote's second moments, with what interpolation takes off all of them put back.
    added = LINEAR_INTERPOLATION_PX2 * np.array([[px2[0, 0]], [px2[0, 1]], [px2[1, 1]]])
    p, q, r = np.array([c, -b / 2, a]) / (a * c - b * b / 4) + added
    areas = np.sqrt(np.maximum(p * r - q * q, 0.0))
    # The smoothed lobe's variance, px^2, needs no more of the peak's value than the highest pixel.
    sums = np.array([[p.sum(), q.sum()], [q.sum(), r.sum()]]) / float(-2 * np.log(isovalues).sum())
    lobe = np.linalg.solve(px2, sums)
    half, product = float(np.trace(lobe)) / 2, float(np.linalg.det(lobe))
    longer = half + np.sqrt(max(half * half - product, 0.0)) - smoothing
    beyond = 4 * smoothing * np.sqrt(max(product, 0.0) * np.linalg.det(px2)) / max(longer, LEAST_VARIANCE_PX2)
    return weights_at_zero(areas + float(beyond))
