"""The noise of a linear frame as a function of its level."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.calibration.response import Response
from simtest.errors import InputError
from simtest.geometry import Array
from simtest.geometry.checks import check_integer, check_kind, check_number

MAX_BITS = 32


@dataclass(frozen=True)
class NoiseModel:
    """White, shot, read and quantisation noise of one channel; level and noise are shares of full scale.

    Parameters
    ----------
    sigma : float
        Standard deviation of white noise.
    full_well : float, optional
        Electrons at full scale; their number is Poisson distributed. Default: no shot noise.
    read_noise : float
        Standard deviation, electrons; needs `full_well`.
    bits : int, optional
        Of a value; default: not quantised.
    response : Response
        The curve before quantisation: it sets the step of light between two values.

    Raises
    ------
    InputError
        If a number is not finite or out of range, the response is no `Response`, or read noise has no full well.
    """

    sigma: float = 0.0
    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None
    response: Response = field(default_factory=Response)

    def __post_init__(self) -> None:
        check_number("noise sigma", self.sigma, least=0)
        check_number("noise read_noise", self.read_noise, least=0)
        if self.full_well is not None:
            check_number("noise full_well", self.full_well, above=0)
        elif self.read_noise > 0:
            raise InputError(f"noise read_noise = {self.read_noise:g} electrons: needs full_well as well")
        if self.bits is not None:
            check_integer("noise bits", self.bits, 1, MAX_BITS)
        check_kind("noise response", self.response, Response)

    @property
    def is_silent(self) -> bool:
        """Whether there is no noise at any level."""
        return self.sigma == 0 and self.full_well is None and self.bits is None

    def at(self, level: npt.ArrayLike, channels: int = 1) -> Array:
        """Return the standard deviation at a level.

        The level, any shape, is linear light without noise, the mean of `channels` of independent noise. The deviation
        is sqrt((sigma^2 + level/full_well + (read_noise/full_well)^2 + step^2/12) / channels), where step is the light
        between neighbouring values.
        """
        x = np.asarray(level, dtype=float)
        if self.full_well is None and self.bits is None:
            return np.full(x.shape, self.sigma / np.sqrt(channels))
        variance = np.full(x.shape, self.sigma**2)
        if self.full_well is not None:  # shot and read noise
            variance = variance + np.maximum(x, 0) / self.full_well + (self.read_noise / self.full_well) ** 2
        if self.bits is not None:  # quantisation
            half = 0.5 / (2**self.bits - 1)
            value = self.response.encode(np.clip(x, 0, 1))
            above, below = (self.response.decode(np.clip(value + d, 0, 1)) for d in (half, -half))
            variance = variance + (above - below) ** 2 / 12
        return np.asarray(np.sqrt(variance / channels))
