"""Quantiles of distributions whose distribution function has a closed form."""

from collections.abc import Callable


def check_quantile(share: float, freedom: int) -> None:
    """Raise `ValueError` if `share` is not inside (0, 1), or `freedom` is below 1."""
    if not 0 < share < 1 or freedom < 1:
        raise ValueError(f"share = {share}, freedom = {freedom}: must be inside (0, 1), and at least 1")


def first_not_below(is_below: Callable[[float], bool], high: float) -> float:
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
