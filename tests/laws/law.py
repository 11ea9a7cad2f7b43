"""A law: a number that is known beforehand."""

from typing import NamedTuple


class Law(NamedTuple):
    """A measured number with its bounds; `about` says what is right, and why the tolerance is what it is."""

    name: str  # what is watched
    quantity: str  # what of it was measured
    unit: str
    value: float
    high: float
    low: float
    n: int  # how many numbers the value was made of
    about: str

    @property
    def holds(self) -> bool:
        """Whether the value lies within its bounds; NaN, where there was nothing to measure, does not."""
        return bool(self.low <= self.value <= self.high)


def law(
    name: str, quantity: str, unit: str, value: float, high: float, low: float = 0.0, n: int = 1, about: str = ""
) -> Law:
    """Compare a measured value with its bounds."""
    return Law(name, quantity, unit, float(value), high, low, n, about)
