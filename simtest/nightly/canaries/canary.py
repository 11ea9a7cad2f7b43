"""A canary: a figure whose value is known beforehand."""

import math
from collections.abc import Callable

import polars as pl

from simtest.nightly.records import Cell, Figure, figure_table


def canary(
    name: str, quantity: str, unit: str, value: float, high: float, low: float = 0.0, n: int = 1, about: str = ""
) -> Figure:
    """Compare a measured value with its bounds; NaN, where there was nothing to measure, does not pass.

    `name` is what is watched, `quantity` what of it was measured, `n` how many numbers the value was made of, and
    `about` what is right, and why the tolerance is what it is.
    """
    return Figure(
        "canary", Cell(name), quantity, unit, value, low, high, n, passed=bool(low <= value <= high), about=about
    )


def or_failed_canary(
    name: str, measure: Callable[[], pl.DataFrame], fatal: tuple[type[Exception], ...] = ()
) -> pl.DataFrame:
    """Measure figures; where an error that is not fatal stops that, return a failed canary with the error instead."""
    try:
        return measure()
    except fatal:
        raise
    except Exception as error:
        return figure_table([canary(name, "error", "", math.nan, 0.0, n=0, about=f"{type(error).__name__}: {error}")])
