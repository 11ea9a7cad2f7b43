"""Reading picture files: what they hold as values in [0, 1], or one line that says why not."""

import warnings
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage
from PIL import UnidentifiedImageError

from simtest.errors import InputError
from simtest.runtime.resources import shown

Image = npt.NDArray[np.float32]

MAX_PIXELS = 100_000_000
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def read_picture(path: Path) -> Image:
    """Read a picture of 8 or 16 bits as intensities in [0, 1].

    The values are as they are encoded.

    Parameters
    ----------
    path : Path
        PNG, JPEG, BMP or TIFF; grey, RGB or RGBA (alpha is ignored).

    Returns
    -------
    ndarray of float32, shape (H, W) or (H, W, 3)

    Raises
    ------
    InputError
        If the file is missing, no picture, or too large.
    """
    picture = read_raw(path, "a picture (PNG, JPEG, BMP, TIFF)")
    largest = {"uint8": 2**8 - 1, "uint16": 2**16 - 1}.get(picture.dtype.name)
    if largest is None:
        raise InputError(f"{shown(path)}: pixels are {picture.dtype}; must be 8 or 16 bits")
    if picture.ndim == 3 and picture.shape[2] not in (1, 3, 4):
        raise InputError(f"{shown(path)}: has {picture.shape[2]} channels; must have 1, 3 or 4")
    scaled: Image = np.asarray(picture, dtype=np.float32) / np.float32(largest)
    if scaled.ndim == 3 and scaled.shape[2] == 1:
        scaled = scaled[:, :, 0]
    return scaled if scaled.ndim == 2 else np.ascontiguousarray(scaled[:, :, 2::-1])


def read_raw(path: Path, wanted: str) -> npt.NDArray[np.generic]:
    """Read the pixels of a picture file as they are, in OpenCV's order of channels.

    Raises
    ------
    InputError
        If the file is missing, no picture, or has more than 100 million pixels: told before it is decoded.
    """
    if path.is_dir():
        raise InputError(f"{shown(path)}: is a folder; must be {wanted}")
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    _check_size(path)
    try:
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error as error:
        raise InputError(f"{shown(path)}: cannot be decoded ({str(error).splitlines()[0][:120]})") from error
    if picture is None:
        raise InputError(f"{shown(path)}: no picture ({data.size} bytes); must be PNG, JPEG, BMP or TIFF")
    if picture.shape[0] * picture.shape[1] > MAX_PIXELS:
        raise InputError(_too_large(path, f"{picture.shape[1]} x {picture.shape[0]} px"))
    return np.asarray(picture)


def _check_size(path: Path) -> None:
    """Raise `InputError` where a file's header announces too many pixels."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(path) as header:
                width, height = header.size
    except PillowImage.DecompressionBombError as error:
        raise InputError(_too_large(path, str(error).split(",")[0])) from None
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        # OpenCV reads more formats than this, and says what is wrong with the others.
        return
    if width * height > MAX_PIXELS:
        raise InputError(_too_large(path, f"{width} x {height} px"))


def _too_large(path: Path, size: str) -> str:
    return f"{shown(path)}: {size}; at most {MAX_PIXELS} px are allowed"


def is_coloured(picture: Image) -> bool:
    """Tell whether a picture has colours: three channels that are not all the same."""
    if picture.ndim != 3:
        return False
    red, green, blue = cv2.split(picture)
    return bool(np.any(red != green) or np.any(green != blue))
