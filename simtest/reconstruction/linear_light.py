"""The first stage: the values of a picture, checked and brought to linear light."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, CorrectedFrame, Response
from simtest.errors import InputError
from simtest.geometry import Camera

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

_LEVELS = 2**16
"""How many values a picture can have; its response is looked up in a table of them."""


@dataclass(frozen=True)
class LinearPicture:
    """A picture in linear light.

    Kept are the values as given, shape (H, W) or (H, W, C), and the mean of the channels with everything undone that
    the calibration knows; where light is to be split by colour also the linear channels, falloff included.
    """

    encoded: Image
    corrected: CorrectedFrame
    channels: Image | None = None


def linear_picture(encoded: Image, calibration: Calibration, in_colour: bool) -> LinearPicture:
    """Bring a picture to linear light; `in_colour` keeps its channels too, for light that is split by colour."""
    if not in_colour:
        return LinearPicture(encoded, calibration.correct(encoded))
    level = 1.0 if calibration.saturation_level is None else calibration.saturation_level
    channels = decode(encoded, calibration.response or Response("srgb"))
    # What is decoded already has no response of its own, and its clipped pixels show in the encoded values alone.
    corrected = replace(calibration, response=None, saturation_level=None).correct(channels)
    return LinearPicture(encoded, replace(corrected, saturated=clipped_pixels(encoded, level)), channels)


def decode(picture: Image, response: Response) -> Image:
    """Return the linear values of a picture of at most 16 bits, shape (H, W, 3), in [0, 1]."""
    if response.kind == "linear":
        return picture
    # A table of all 16-bit values is faster than the curve at each pixel, and exact for pictures of 8 and 16 bits.
    table = response.decode(np.linspace(0, 1, _LEVELS)).astype(np.float32)
    steps = cv2.multiply(picture, (_LEVELS - 1,) * 4, dtype=cv2.CV_16U)
    return np.asarray(table[steps])


def clipped_pixels(picture: Image, level: float) -> Mask:
    """Return the pixels of a colour picture, shape (H, W, 3), where a channel is at or above `level`."""
    red, green, blue = cv2.split(picture)
    return np.asarray(cv2.max(cv2.max(red, green), blue) >= np.float32(level))


def check_frame(frame: npt.ArrayLike, camera: Camera) -> Image:
    """Return a frame as float32 values, shape (H, W) or (H, W, C); raise `InputError` where it does not fit."""
    try:
        given = np.asarray(frame)
    except (TypeError, ValueError):
        raise InputError(
            "frame: must be an array of numbers; its rows differ in length or hold something else"
        ) from None
    if given.dtype.kind not in "biuf":
        raise InputError(f"frame holds values of type {given.dtype}: must be an array of real numbers")
    # What float32 cannot hold becomes infinite and is refused below.
    with np.errstate(all="ignore"):
        image = given.astype(np.float32)
    if image.ndim not in (2, 3) or image.size == 0:
        raise InputError(f"frame has shape {image.shape}: must be (H, W) or (H, W, C)")
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"frame is {image.shape[1]} x {image.shape[0]} px: must be {camera.width} x {camera.height}, "
            "the size of the camera's calibration"
        )
    # The channels' mean may be beyond what float32 holds.
    with np.errstate(all="ignore"):
        finite = np.isfinite(image if image.ndim == 2 else image.mean(axis=2, dtype=np.float32))
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        raise InputError(f"frame holds {bad} values that are NaN, infinite or beyond 3e38: all must be finite")
    return image
