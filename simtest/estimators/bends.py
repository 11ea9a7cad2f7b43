"""What isophotes that are no ellipses say of their centre.

A highlight whose isophotes are bent holds more than one point that shines: a second glint that it melts with, or a near
miss beside its own (theory.md 7.1b). Both pull the centre by a share of the highlight's size, and ripples do not show
it: the bend lies in harmonics 2 and 3, which the highlight's own shape has as well. Isophotes of a single highlight
are ellipses to a percent or better; a melted one may look no less like an ellipse than to 2 or 3 %.
"""

import numpy as np

from simtest.geometry import Array
from simtest.runtime.fitted import fitted_number

MEAN_BENDS, PEAK_BENDS = fitted_number("bends.mean"), fitted_number("bends.peak")
MELTED, MELTED_RESIDUAL = fitted_number("bends.melted"), fitted_number("bends.melted_residual")
STEEPNESS = fitted_number("bends.steepness")


def bend_variance(residuals: Array, by_noise: Array, moments: Array, slope: float) -> float:
    """Return the variance of a highlight's centre along each axis, by the bend of its isophotes, rad^2.

    Parameters
    ----------
    residuals : ndarray, shape (K,)
        RMS distance of each isophote from its ellipse, over its radius. The least counts: outer isophotes may bend
        towards neighbours that do not reach the peak.
    by_noise : ndarray, shape (K,)
        What of it may be noise.
    moments : ndarray, shape (2, 2)
        Second moments of the highlight, rad^2.
    slope : float
        `MEAN_BENDS` or `PEAK_BENDS`.
    """
    bend = float(np.sqrt(np.maximum(residuals**2 - by_noise**2, 0.0)).min())
    share = max(
        slope * bend if bend > MELTED_RESIDUAL else 0.0, MELTED * min(1.0, (bend / MELTED_RESIDUAL) ** STEEPNESS)
    )
    return share**2 * float(np.sqrt(max(np.linalg.det(moments), 0.0)))
