"""Quantiles of Student's t distribution with a whole number of degrees of freedom, without SciPy.

They stand beside those of chi-squared for the same reason: the page of a run needs nothing else of SciPy, and loading
it takes longer than drawing the page's figures.
"""

import math
from functools import lru_cache
from statistics import NormalDist

from simtest.geometry.quantiles import check_quantile, first_not_below

_MANY = 1000
"""Degrees of freedom above which the expansion about the normal distribution is exact to rounding."""


def within(t: float, freedom: int) -> float:
    """Return the probability that |T| < t, t >= 0, by its finite sums [AS, 26.7.3, 26.7.4].

    Notes
    -----
    [AS] M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions", 1964.
    """
    angle = math.atan2(t, math.sqrt(freedom))
    square = freedom / (freedom + t * t)  # of the angle's cosine
    odd = freedom % 2
    # Terms cos^k, each by a ratio from the one before; of odd freedom the first one is cos itself.
    term, total = (math.sqrt(square), 0.0) if odd else (1.0, 0.0)
    for k in range(1 + odd, freedom, 2):
        total += term
        term *= k / (k + 1) * square
    if odd:
        return 2 / math.pi * (angle + math.sin(angle) * total)
    return math.sin(angle) * total


@lru_cache(maxsize=4096)
def quantile(share: float, freedom: int) -> float:
    """Return the value that a t variable stays below with a probability of `share`, inside (0, 1).

    Raises
    ------
    ValueError
        If `share` is not inside (0, 1), or `freedom` is below 1.
    """
    check_quantile(share, freedom)
    if share < 0.5:
        return -quantile(1 - share, freedom)
    if freedom > _MANY:
        return _expanded(NormalDist().inv_cdf(share), freedom)
    wanted = 2 * share - 1
    return first_not_below(lambda x: within(x, freedom) < wanted, 2.0)


def _expanded(z: float, freedom: int) -> float:
    """Return the quantile from the normal distribution's, z, by its expansion in 1/freedom [AS, 26.7.5]."""
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / freedom**order for order, term in enumerate(terms, 1))
