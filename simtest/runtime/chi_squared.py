"""Quantiles of the chi-squared distribution with a whole number of degrees of freedom, without SciPy.

Reconstruction of a picture needs no other distribution, and loading SciPy's takes longer than reconstructing it.
"""

import math
from collections.abc import Callable
from functools import lru_cache


def survival(x: float, freedom: int) -> float:
    """Return the probability that a chi-squared variable exceeds x > 0, by its finite sums.

    Abramowitz and Stegun, "Handbook of Mathematical Functions", 1964, 26.4.4 and 26.4.5.
    """
    half = x / 2
    # Q(a + 1) = Q(a) + half^a exp(-half) / Gamma(a + 1), from a = 1/2 or from a = 1 up to freedom/2.
    order = 0.5 if freedom % 2 else 1.0
    total = math.erfc(math.sqrt(half)) if freedom % 2 else math.exp(-half)
    while order < freedom / 2:
        total += math.exp(order * math.log(half) - half - math.lgamma(order + 1))
        order += 1
    return total


@lru_cache(maxsize=256)
def quantile(share: float, freedom: int) -> float:
    """Return the value that a chi-squared variable stays below with a probability of `share`, inside (0, 1)."""
    if not 0 < share < 1 or freedom < 1:
        raise ValueError(f"share = {share}, freedom = {freedom}: must be inside (0, 1), and at least 1")
    if freedom == 2:
        return -2 * math.log1p(-share)
    return _first_not_below(lambda x: survival(x, freedom) > 1 - share, float(freedom))


def _first_not_below(is_below: Callable[[float], bool], high: float) -> float:
    """Return the least positive number for which `is_below`, true up to it and false from it on, is false.

    `high` is where the search begins. It ends when two neighbouring numbers are left.
    """
    low = 0.0
    while is_below(high):
        low, high = high, 2 * high
    while low < (middle := (low + high) / 2) < high:
        if is_below(middle):
            low = middle
        else:
            high = middle
    return high
