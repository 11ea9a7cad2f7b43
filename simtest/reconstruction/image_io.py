"""Reading pictures, folders of pictures and videos: values in [0, 1], or an error of one line that says why not."""

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")


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


@dataclass(frozen=True)
class SequenceFrame:
    """A frame of a sequence.

    Parameters
    ----------
    index : int
        From 0.
    name : str
        The file, or the video's name with the index.
    time_s : float or None
        From the video's start; None in folders.
    read : callable
        Gives the values as encoded, in [0, 1]; raises `InputError` where they cannot be read.
    """

    index: int
    name: str
    time_s: float | None
    read: Callable[[], Image]


@dataclass(frozen=True)
class Source:
    """A folder of pictures, or a video.

    Parameters
    ----------
    path : Path
    count : int
        How many frames there are; of a video, how many it says it has.
    is_video : bool
    files : tuple of Path
        Of a folder.
    """

    path: Path
    count: int
    is_video: bool
    files: tuple[Path, ...] = ()

    def frames(self) -> Iterator[SequenceFrame]:
        """Give the frames in order; a video's end where it cannot be read any more."""
        if not self.is_video:
            for index, file in enumerate(self.files):
                yield SequenceFrame(index, file.name, None, lambda file=file: read_picture(file))  # type: ignore[misc]
            return
        capture = cv2.VideoCapture(str(self.path))
        try:
            rate = float(capture.get(cv2.CAP_PROP_FPS))
            index = 0
            # A frame that is not wanted is skipped without being decoded.
            while capture.grab():
                time = index / rate if rate > 0 else None
                yield SequenceFrame(index, f"{self.path.name}#{index}", time, lambda: _retrieve(capture, self.path))
                index += 1
        finally:
            capture.release()


def _retrieve(capture: cv2.VideoCapture, path: Path) -> Image:
    done, frame = capture.retrieve()
    if not done or frame is None:
        raise InputError(f"{shown(path)}: a frame cannot be decoded")
    values = frame.astype(np.float32) / np.float32(255)
    return values if values.ndim == 2 else np.ascontiguousarray(values[:, :, ::-1])


def is_sequence(path: Path) -> bool:
    """Tell whether a path is a folder, or a video by its suffix."""
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def open_source(path: Path) -> Source:
    """Open a folder or a video.

    Raises
    ------
    InputError
        If there is none, or it holds no frame.
    """
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES and file.is_file()]
        if not files:
            raise InputError(f"{shown(path)}: holds no pictures ({', '.join(PICTURE_SUFFIXES)})")
        return Source(path, len(files), False, tuple(sorted(files, key=_natural)))
    if not path.is_file():
        raise InputError(f"{shown(path)}: no such file")
    capture = cv2.VideoCapture(str(path)) if path.stat().st_size else None
    try:
        if capture is None or not capture.isOpened() or not capture.grab():
            raise InputError(f"{shown(path)}: no video that can be read ({path.stat().st_size} bytes)")
        width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PIXELS:
            raise InputError(f"{shown(path)}: {width} x {height} px; at most {MAX_PIXELS} px are allowed")
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        if capture is not None:
            capture.release()
    return Source(path, max(count, 1), True)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort frame10 behind frame9."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name) if part]
