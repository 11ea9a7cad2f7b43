"""From light to values: the response of a camera, falloffs over an angle, and the noise of a linear frame.

Light is a share of full scale, a value a share of the largest one. An angular profile is a light's emission or a lens's
vignetting.
"""

from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry.checks import check_integer, check_kind, check_number, check_numbers
from simtest.runtime.arrays import Array, Image, short_repr

_LEVELS = 2**16  # values that a picture has at most

Floats = TypeVar("Floats", npt.NDArray[np.float32], npt.NDArray[np.float64])

MAX_BITS = 32


def srgb_encode(linear: Floats) -> Floats:
    """Return the sRGB-encoded values of linear ones in [0, 1] (IEC 61966-2-1), in the array's type."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Floats) -> Floats:
    """Return the linear values of sRGB-encoded ones in [0, 1] (IEC 61966-2-1), in the array's type."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


@dataclass(frozen=True)
class Response:
    """A rising curve from light 0, value 0 to light 1, value 1.

    Parameters
    ----------
    kind : {"linear", "gamma", "srgb", "table"}
        Which curve.
    gamma : float
        For "gamma": value = light^(1/gamma).
    light, value : tuple of float
        For "table": points of the curve, linear between them; both rise from 0 to 1.

    Raises
    ------
    InputError
        If the kind is unknown, gamma is no finite number > 0, or the table is malformed.
    """

    kind: Literal["linear", "gamma", "srgb", "table"] = "linear"
    gamma: float = 1.0
    light: tuple[float, ...] = ()
    value: tuple[float, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if self.kind not in ("linear", "gamma", "srgb", "table"):
            raise InputError(f"response kind = {self.kind!r}: must be linear, gamma, srgb or table")
        check_number("response gamma", self.gamma, above=0)
        if self.kind == "table":
            check_table(self.light, self.value)

    def encode(self, light: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the values of light, any shape; light outside [0, 1] is clipped, unless the curve is linear."""
        x = np.asarray(light, dtype=float)
        if self.kind == "linear":
            return x
        x = np.clip(x, 0.0, 1.0)
        if self.kind == "gamma":
            return np.asarray(x ** (1 / self.gamma))
        return srgb_encode(x) if self.kind == "srgb" else np.asarray(np.interp(x, self.light, self.value))

    def encode_picture(self, light: Image) -> Image:
        """Return the values of a picture's light, float32, shape (H, W) or (H, W, C): those of `encode` to 3e-7.

        It takes a third of the time of sRGB's curve: powers are those of OpenCV, in single precision.
        """
        if self.kind in ("linear", "table"):
            return self.encode(light).astype(np.float32)
        import cv2

        x = np.clip(light, np.float32(0), np.float32(1))
        if self.kind == "gamma":
            return np.asarray(cv2.pow(x, 1 / self.gamma), dtype=np.float32).reshape(x.shape)
        curve = np.asarray(cv2.pow(x, 1 / 2.4), dtype=np.float32).reshape(x.shape)
        curve *= np.float32(1.055)
        curve -= np.float32(0.055)
        np.multiply(x, np.float32(12.92), out=curve, where=x <= np.float32(0.0031308))
        return curve

    def decode(self, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the light of values, any shape: the inverse of `encode`."""
        y = np.asarray(values, dtype=float)
        if self.kind == "linear":
            return y
        y = np.clip(y, 0.0, 1.0)
        if self.kind == "gamma":
            return np.asarray(y**self.gamma)
        return srgb_decode(y) if self.kind == "srgb" else np.asarray(np.interp(y, self.value, self.light))

    def decode_picture(self, values: Image) -> Image:
        """Return the light of a picture of at most 16 bits, shape (H, W) or (H, W, C), in [0, 1]."""
        if self.kind == "linear":
            return values
        import cv2

        # A table of all 16-bit values is faster than the curve at each pixel, and exact for pictures of 8 and 16 bits.
        table = self.decode(np.linspace(0, 1, _LEVELS)).astype(np.float32)
        # `take` needs half the time of an index.
        return np.asarray(table.take(cv2.multiply(values, (_LEVELS - 1,) * 4, dtype=cv2.CV_16U)))


def check_table(light: tuple[float, ...], value: tuple[float, ...]) -> None:
    """Raise `InputError` where the points of a curve do not both rise from 0 to 1."""
    check_numbers("light", light)
    check_numbers("value", value)
    if len(light) != len(value):
        raise InputError(f"value has {len(value)} entries, light {len(light)}; must be as many")
    for name, points in (("light", light), ("value", value)):
        steps = np.diff(points)
        if len(points) < 2 or points[0] != 0 or points[-1] != 1 or not (steps > 0).all():
            raise InputError(f"{name} = {list(points)}: must rise from 0 to 1, each more than the one before")


@dataclass(frozen=True)
class AngularProfile:
    """A factor over the angle from an axis: cos^k, which is 1 on the axis, or a table in any unit.

    Parameters
    ----------
    power : float
        k of cos^k; used where there is no table. 0 is isotropic.
    angles : tuple of float
        Angles of a table, rad, rising from 0 to at most pi; empty for cos^k.
    values : tuple of float
        Factors at those angles, >= 0; interpolated linearly, constant beyond the table.

    Raises
    ------
    InputError
        If the power is no finite number >= 0, or the table is malformed.
    """

    power: float = 0.0
    angles: tuple[float, ...] = ()
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_number("profile power", self.power, least=0)
        for name in ("angles", "values"):
            check_numbers(f"profile {name}", getattr(self, name))
        if len(self.angles) != len(self.values):
            raise InputError(f"profile: {len(self.angles)} angles and {len(self.values)} values; must be as many")
        if not self.angles:
            return
        angles, values = np.array(self.angles), np.array(self.values)
        if len(angles) < 2 or angles[0] != 0 or not (np.diff(angles) > 0).all() or angles[-1] > np.pi + 1e-12:
            raise InputError(f"profile angles = {list(self.angles)}: must rise from 0 to at most pi, two or more")
        if not ((values >= 0).all() and values[0] > 0):
            raise InputError(f"profile values = {list(self.values)}: must be >= 0 and positive on the axis")

    @property
    def is_uniform(self) -> bool:
        """Whether the factor is 1 in all directions."""
        return self.power == 0 and not self.angles

    def at(self, cosine: npt.ArrayLike, sine: npt.ArrayLike | None = None) -> Array:
        """Return the factor at an angle from the axis, named by its cosine, any shape.

        With the sine >= 0 of the same angle a table keeps the digits that the cosine has lost near the axis. cos^k is 0
        at angles of 90 deg and more, unless k is 0.
        """
        c = np.clip(np.asarray(cosine, dtype=float), -1.0, 1.0)
        if self.angles:
            angle = np.arccos(c) if sine is None else np.arctan2(sine, c)
            return np.asarray(np.interp(angle, self.angles, self.values))
        return np.ones_like(c) if self.power == 0 else np.asarray(np.maximum(c, 0.0) ** self.power)


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
