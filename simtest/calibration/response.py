"""The response of a camera: from light, a share of full scale, to a value, a share of the largest one."""

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Image
from simtest.geometry.checks import check_number, check_numbers
from simtest.runtime.arrays import short_repr

_LEVELS = 2**16  # values that a picture has at most

Array = TypeVar("Array", npt.NDArray[np.float32], npt.NDArray[np.float64])


def srgb_encode(linear: Array) -> Array:
    """Return the sRGB-encoded values of linear ones in [0, 1] (IEC 61966-2-1), in the array's type."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Array) -> Array:
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
