"""Distributions of what is not known exactly: uniform, log-uniform and normal."""

import math
from dataclasses import dataclass, fields
from functools import cache
from statistics import NormalDist

import numpy as np

from simtest.errors import InputError
from simtest.geometry import Array
from simtest.geometry.checks import check_number

LEAST_SHARE = 0.05
"""A Normal that stands for something positive is cut off at this share of its mean."""


@dataclass(frozen=True)
class _Interval:
    """Two ends, the lower one first; `InputError` where they are not finite or not in order."""

    low: float
    high: float

    def __post_init__(self) -> None:
        for end in fields(self):
            check_number(f"{type(self).__name__} {end.name}", getattr(self, end.name))
        if not self.low < self.high:
            raise InputError(f"{type(self).__name__}({self.low!r}, {self.high!r}): low must be less than high")


@dataclass(frozen=True)
class Uniform(_Interval):
    """Anywhere from low to high, alike."""

    @property
    def mean(self) -> float:
        """Middle of the interval."""
        return (self.low + self.high) / 2

    @property
    def sd(self) -> float:
        """Standard deviation."""
        return (self.high - self.low) / math.sqrt(12)

    @property
    def least(self) -> float:
        """The lower end."""
        return self.low

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape."""
        return self.low + (self.high - self.low) * share

    def __str__(self) -> str:
        return f"uniform from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Assumed(Uniform):
    """A uniform distribution for what nobody gave; it equals no given one, not even of the same ends."""


@dataclass(frozen=True)
class LogUniform(_Interval):
    """From low > 0 to high, the logarithm uniform: a scale of which only the order of magnitude is known."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("LogUniform low", self.low, above=0)

    @property
    def mean(self) -> float:
        """Mean."""
        return (self.high - self.low) / math.log(self.high / self.low)

    @property
    def sd(self) -> float:
        """Standard deviation."""
        square = (self.high**2 - self.low**2) / (2 * math.log(self.high / self.low))
        return math.sqrt(max(square - self.mean**2, 0.0))

    @property
    def least(self) -> float:
        """The lower end."""
        return self.low

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape."""
        return np.asarray(self.low * (self.high / self.low) ** share)

    def __str__(self) -> str:
        return f"log-uniform from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Normal:
    """About mean with the standard deviation sd >= 0; with sd = 0 the value is exact (see `exactly`)."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        check_number("Normal mean", self.mean)
        check_number("Normal sd", self.sd, least=0)

    @property
    def least(self) -> float:
        """The mean, which must be positive where the value must be: a Normal has no lower end."""
        return self.mean

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape.

        Lengths and the like are positive: values below a twentieth of a positive mean are cut off there.
        """
        values = self.mean + self.sd * np.reshape([_deviate(s) for s in np.ravel(share).tolist()], np.shape(share))
        return np.maximum(values, LEAST_SHARE * self.mean) if self.mean > 0 else np.asarray(values)

    def __str__(self) -> str:
        return f"{self.mean:g} exactly" if self.sd == 0 else f"normal, {self.mean:g} ± {self.sd:g}"


Distribution = Uniform | Normal | LogUniform


def exactly(value: float) -> Normal:
    """Return the distribution of a value that is known exactly."""
    return Normal(value, 0.0)


def check_distribution(name: str, prior: object, above: float | None = None, least: float | None = None) -> None:
    """Raise `InputError` where a prior is no distribution, or does not lie above `above` or from `least` on."""
    if not isinstance(prior, Distribution):
        raise InputError(f"{name} = {prior!r}: must be a Uniform, Normal or LogUniform, or exactly({prior!r})")
    check_number(name, prior.least, least, above)


@cache
def _deviate(share: float) -> float:
    return NormalDist().inv_cdf(share)
