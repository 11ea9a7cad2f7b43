"""What isophotes that are no ellipses say of their centre.

A highlight whose isophotes are bent holds more than one point that shines: a second glint that it melts with, or a near
miss beside its own (theory.md 7.1b). Both pull the centre by a share of the highlight's size, and ripples do not show
it: the bend lies in harmonics 2 and 3, which the highlight's own shape has as well. Isophotes of a single highlight
are ellipses to a percent or better; a melted one may look no less like an ellipse than to 2 or 3 %.
"""

import numpy as np

from simtest.geometry import Array

MEAN_BENDS, PEAK_BENDS = 5.5, 4.5
"""Standard deviation of the mean axis, and of the axis at the peak, over that of the bend ..."""

MELTED, MELTED_RESIDUAL, STEEPNESS = 0.3, 0.02, 4
"""... and, as a share of the radius, where the residual is so large that a melted spot is as likely as a single one;
below it the share falls with this power of the residual. All were fitted to 506 highlights on 32 of the scenes 0 to 35
of the corpus `hard`, 396 of which hold one glint (docs/concepts/uncertainty.md)."""


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
