"""Priors: what is known beside the picture of lights, distance and lobe, each with its distribution."""

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from simtest.errors import InputError
from simtest.geometry import Array
from simtest.geometry.checks import check_number

MAX_LIGHTS = 32


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


@dataclass(frozen=True)
class Normal:
    """About mean with the standard deviation sd >= 0; with sd = 0 the value is exact (see `exactly`)."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        check_number("Normal mean", self.mean)
        check_number("Normal sd", self.sd, least=0)


Distribution = Uniform | Normal | LogUniform


def exactly(value: float) -> Normal:
    """Return the distribution of a value that is known exactly."""
    return Normal(value, 0.0)


@dataclass(frozen=True)
class Priors:
    """What estimators are told beside the picture and the camera; each part may be missing.

    Parameters
    ----------
    lights_mm : tuple of tuple of float
        Nominal positions of the lights, camera frame, mm; empty: not known.
    distance_mm : Uniform, Normal or LogUniform, optional
        Working distance along the sightline, mm.
    lobe_curvature : Uniform, Normal or LogUniform, optional
        c = -(log f)''(0) of the reflectance f as a function of the angle between normal and view, rad; 4 n for Phong.
        Estimators use its mean.

    Raises
    ------
    InputError
        If a light is no finite position, or a distribution is none or does not lie above 0.
    """

    lights_mm: tuple[tuple[float, float, float], ...] = ()
    distance_mm: Distribution | None = None
    lobe_curvature: Distribution | None = None

    def __post_init__(self) -> None:
        if len(self.lights_mm) > MAX_LIGHTS or not all(
            len(light) == 3 and np.isfinite(light).all() for light in self.lights_mm
        ):
            raise InputError(f"lights_mm: must be at most {MAX_LIGHTS} positions of three finite numbers, mm")
        for name in ("distance_mm", "lobe_curvature"):
            prior = getattr(self, name)
            if prior is None:
                continue
            if not isinstance(prior, Distribution):
                raise InputError(f"{name} = {prior!r}: must be a Uniform, Normal or LogUniform, or exactly({prior!r})")
            # A Normal has no lower end: its mean must lie above 0.
            least = prior.mean if isinstance(prior, Normal) else prior.low
            if not least > 0:
                raise InputError(f"{name} = {least!r}: must be a finite number > 0")

    @cached_property
    def lights(self) -> Array:
        """Nominal positions of the lights, shape (L, 3), camera frame, mm."""
        return np.array(self.lights_mm, dtype=float).reshape(-1, 3)


NO_PRIORS = Priors()
"""Nothing is known beside the picture and the camera."""
