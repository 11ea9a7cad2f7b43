"""One test over all cells of an estimator: what is too small to show in ten realisations of one setting shows in many.

Each cell contributes one number, its difference over the mean of the two runs' figures: symmetric about 0 where nothing
changed, and never beyond 2, however heavy the errors' tails. A sum of many such shares cannot hang on one of them.
"""

import numpy as np

from simtest.nightly.gate.contrasts import Outcomes, half_width, tail
from simtest.nightly.gate.quantities import Quantity
from simtest.runtime.arrays import Array

MIN_UNITS = 5
"""Where each cell has as many units, the cells' own standard errors are taken."""

MIN_CELLS = 10
"""Where not, but there are as many cells, the cells themselves are the sample."""

MOST_SHARE = 2.0
"""A difference over the mean of both runs is no larger."""


def pooled(found: Outcomes, quantity: Quantity) -> Outcomes:
    """Test many cells at once.

    Returns
    -------
    Outcomes
        Of shape (1,). Relative quantities are shares of the cells' own means: the baseline is 1, the margin the
        relative one, which is the absolute margin where a mean is so small that this is the larger. p-values are NaN
        where the cells are too few, with too few units.
    """
    shares, deviations = found.difference, found.deviation
    margin = quantity.relative or quantity.absolute
    if quantity.relative:
        scale = np.maximum((found.baseline + found.tonight) / 2, quantity.scale_floor)
        shares, deviations = shares / scale, deviations / scale
    span = MOST_SHARE if quantity.relative and quantity.span else quantity.span
    mean, deviation, freedom = _mean(shares, deviations, found, span)
    half = half_width(deviation, freedom)
    baseline = np.ones(1) if quantity.relative else np.array([found.baseline.mean()])
    return Outcomes(
        np.array([int(found.n.sum())]), baseline, baseline + mean, mean, mean - half, mean + half,
        np.array([margin]), tail(mean - margin, deviation, freedom), tail(-mean - margin, deviation, freedom),
        np.array([bool(found.within.all())]), deviation, freedom,
    )  # fmt: skip


def _mean(shares: Array, deviations: Array, found: Outcomes, span: float) -> tuple[Array, Array, Array]:
    """Compute the mean over cells, its standard error and degrees of freedom, each of shape (1,)."""
    count = len(shares)
    mean = np.array([shares.mean()])
    # The cells' own standard errors, with Welch and Satterthwaite's degrees of freedom.
    if (found.n >= MIN_UNITS).all():
        variances = deviations**2 / count**2
        whole = variances.sum()
        freedom = whole**2 / np.sum(variances**2 / found.freedom) if whole > 0 else float(found.freedom.min())
        return mean, np.array([np.sqrt(whole)]), np.array([freedom])
    if count < MIN_CELLS:
        return mean, np.array([np.nan]), np.zeros(1)
    # The cells as the sample.
    residuals = shares - mean
    if span:
        # Two invented units, as in each cell.
        extra = span * float(np.mean(1 / found.n))
        residuals = np.append(residuals, [extra, -extra])
    deviation = np.sqrt(np.sum(residuals**2) / (count - 1) / count)
    return mean, np.array([deviation]), np.array([count - 1.0])
