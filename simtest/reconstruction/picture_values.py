"""The values of a picture, from a file or an array: what is encoded, and what has colours."""

import operator

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.runtime.arrays import Image

LARGEST = {"uint8": 2**8 - 1, "uint16": 2**16 - 1}
"""The value that light of full scale has, by the type of the values."""

SAFE_SUM = 1e38
"""A sum of values up to this is finite in float32, whatever the rounding."""


def scale_picture(picture: npt.NDArray[np.generic], name: str) -> Image | None:
    """Return a picture of 8 or 16 bits as encoded values in [0, 1], shape (H, W) or (H, W, 3); None for other types.

    Alpha is left out. Raises `InputError`, with the picture's name, for other than 1, 3 or 4 channels.
    """
    largest = LARGEST.get(picture.dtype.name)
    if largest is None:
        return None
    if picture.ndim == 3 and picture.shape[2] not in (1, 3, 4):
        raise InputError(f"{name}: has {picture.shape[2]} channels; must have 1, 3 or 4")
    if picture.ndim == 3:
        picture = picture[:, :, 0] if picture.shape[2] == 1 else picture[:, :, :3]
    scaled: Image = np.asarray(picture, dtype=np.float32) / np.float32(largest)
    return scaled


def check_encoded(values: Image) -> None:
    """Raise `InputError` where real values that are said to be encoded leave [0, 1]."""
    low, high = float(values.min()), float(values.max())
    if low < 0 or high > 1:
        raise InputError(f"frame holds values from {low:g} to {high:g}: encoded real values must lie in [0, 1]")


CODED_GREY, COLOURED_SHARE = 2.5 / 255, 0.005
"""Where no larger share of the pixels has channels that differ by more, a picture is grey behind a coder."""


def is_coloured(picture: Image) -> bool:
    """Return whether a picture, values in [0, 1], has colours: channels further apart than coding makes of grey."""
    if picture.ndim != 3 or picture.shape[2] != 3:
        return False
    red, green, blue = cv2.split(picture)
    if not (np.any(red != green) or np.any(green != blue)):
        return False
    spread = cv2.max(cv2.max(red, green), blue) - cv2.min(cv2.min(red, green), blue)
    return bool(np.count_nonzero(spread > CODED_GREY) > COLOURED_SHARE * spread.size)


def check_frame(frame: npt.ArrayLike, camera: Camera, encoding: str | None = None) -> tuple[Image, bool]:
    """Return a frame as float32 values, shape (H, W) or (H, W, C), and whether it is a picture.

    Pictures are of 8 or 16 bits, or real numbers that are said to be sRGB-encoded; their values come back in [0, 1].
    Raises `InputError` where the frame does not fit.
    """
    try:
        given = np.asarray(frame)
    except (TypeError, ValueError):
        raise InputError(
            "frame: must be an array of numbers; its rows differ in length or hold something else"
        ) from None
    if given.dtype.kind not in "biuf":
        raise InputError(f"frame holds values of type {given.dtype}: must be an array of real numbers")
    if given.ndim not in (2, 3) or given.size == 0:
        raise InputError(f"frame has shape {given.shape}: must be (H, W) or (H, W, C)")
    image = scale_picture(given, "frame")
    is_picture = image is not None or encoding == "srgb"
    if image is None:
        if given.dtype.kind != "f":
            raise InputError(
                f"frame holds integers of type {given.dtype}, whose range is not known: must be uint8, uint16 or real"
            )
        # What float32 cannot hold becomes infinite and is refused below.
        with np.errstate(all="ignore"):
            image = given.astype(np.float32)
    check_size(image, camera)
    check_finite(image)
    if is_picture:
        check_encoded(image)
    return image, is_picture


def check_finite(image: Image) -> None:
    """Raise `InputError` where a frame, or the mean of its channels, holds values that are not finite."""
    with np.errstate(all="ignore"):
        # NaN and infinity show at both or either end of the range, which costs less than the means.
        low, high = float(image.min()), float(image.max())
        if max(-low, high) * (1 if image.ndim == 2 else image.shape[2]) < SAFE_SUM:
            return
        # The channels' mean may be beyond what float32 holds.
        finite = np.isfinite(image if image.ndim == 2 else image.mean(axis=2, dtype=np.float32))
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        raise InputError(f"frame holds {bad} values that are NaN, infinite or beyond 3e38: all must be finite")


def check_size(image: Image, camera: Camera) -> None:
    """Raise `InputError` where a frame is not of the camera's size."""
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"frame is {image.shape[1]} x {image.shape[0]} px: must be {camera.width} x {camera.height}, "
            "the size of the camera's calibration"
        )


def check_roi(roi: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    """Return a region as four plain integers; that it lies inside the frame is checked where it is cut."""
    try:
        x, y, width, height = (operator.index(value) for value in roi)
    except (TypeError, ValueError):
        raise InputError(f"roi = {roi!r:.80}: must be x, y, width, height: four integers, px") from None
    return x, y, width, height


def image_size(frame: npt.ArrayLike) -> tuple[int, int]:
    """Return height and width of a frame; raise `InputError` where it is no image."""
    shape = np.shape(frame) if isinstance(frame, np.ndarray) else ()
    if len(shape) not in (2, 3) or 0 in shape:
        raise InputError("frame: must be an array of shape (H, W) or (H, W, C) where the camera is a field of view")
    return int(shape[0]), int(shape[1])
