"""Reading pictures, folders of pictures and videos: values in [0, 1], or an error of one line that says why not."""

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage
from PIL import UnidentifiedImageError

from simtest.errors import InputError
from simtest.reconstruction.picture_values import scale_picture
from simtest.runtime.arrays import Image
from simtest.runtime.resources import shown

MAX_PIXELS = 100_000_000
PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")


def read_picture(path: Path) -> Image:
    """Read a picture of 8 or 16 bits as values in [0, 1], as they are encoded; shape (H, W) or (H, W, 3), RGB.

    Grey, RGB and RGBA are read; alpha is ignored. Raises `InputError` as `read_raw` does, and for other depths.
    """
    picture = read_raw(path, "a picture (PNG, JPEG, BMP, TIFF)")
    scaled = scale_picture(picture, shown(path))
    if scaled is None:
        raise InputError(f"{shown(path)}: pixels are {picture.dtype}; must be 8 or 16 bits")
    # OpenCV's order of channels is BGR.
    return scaled if scaled.ndim == 2 else np.ascontiguousarray(scaled[:, :, ::-1])


def read_raw(path: Path, wanted: str) -> npt.NDArray[np.generic]:
    """Read the pixels of a picture file as they are, in OpenCV's order of channels.

    Raises
    ------
    InputError
        If the file is missing, no picture, or has more than 100 million pixels: checked before it is decoded.
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
        # Pillow warns of large pictures, and refuses them at twice its own limit.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(path) as header:
                width, height = header.size
    except PillowImage.DecompressionBombError as error:
        raise InputError(_too_large(path, str(error).split(",")[0])) from None
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        # OpenCV reads more formats than Pillow, and names what is wrong with the others.
        return
    if width * height > MAX_PIXELS:
        raise InputError(_too_large(path, f"{width} x {height} px"))


def _too_large(path: Path, size: str) -> str:
    return f"{shown(path)}: {size}; at most {MAX_PIXELS} px are allowed"


@dataclass(frozen=True)
class SequenceFrame:
    """A frame of a sequence: its number, the file's name or the video's with the number, and its time in a video.

    `read` returns the values as `read_picture` does; it raises `InputError` where they cannot be read.
    """

    index: int
    name: str
    time_s: float | None
    read: Callable[[], Image]


@dataclass(frozen=True)
class Source:
    """A folder with its picture files, or a video, which has none; `count` is how many frames it says it has."""

    path: Path
    count: int
    files: tuple[Path, ...] = ()

    @property
    def is_video(self) -> bool:
        """Whether the frames come from a video."""
        return not self.files

    def frames(self) -> Iterator[SequenceFrame]:
        """Yield the frames in order; a video ends where it cannot be read any more."""
        for index, file in enumerate(self.files):
            yield SequenceFrame(index, file.name, None, partial(read_picture, file))
        if self.is_video:
            yield from _video_frames(self.path)


def _video_frames(path: Path) -> Iterator[SequenceFrame]:
    capture = cv2.VideoCapture(str(path))

    def read() -> Image:
        done, frame = capture.retrieve()
        if not done or frame is None:
            raise InputError(f"{shown(path)}: a frame cannot be decoded")
        values = frame.astype(np.float32) / np.float32(255)
        return values if values.ndim == 2 else np.ascontiguousarray(values[:, :, ::-1])

    try:
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        index = 0
        # A frame that is not wanted is skipped without being decoded.
        while capture.grab():
            yield SequenceFrame(index, f"{path.name}#{index}", index / rate if rate > 0 else None, read)
            index += 1
    finally:
        capture.release()


def is_sequence(path: Path) -> bool:
    """Return whether a path is a folder, or a video by its suffix."""
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def open_source(path: Path) -> Source:
    """Open a folder or a video; raise `InputError` if there is none, or it holds no frame."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES and file.is_file()]
        if not files:
            raise InputError(f"{shown(path)}: holds no pictures ({', '.join(PICTURE_SUFFIXES)})")
        return Source(path, len(files), tuple(sorted(files, key=_natural)))
    if not path.is_file():
        raise InputError(f"{shown(path)}: no such file")
    size = path.stat().st_size
    capture = cv2.VideoCapture(str(path)) if size else None
    # OpenCV opens some files that hold no frame, so the first is fetched.
    if capture is None or not capture.isOpened() or not capture.grab():
        raise InputError(f"{shown(path)}: no video that can be read ({size} bytes)")
    keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
    width, height, count = (int(capture.get(key)) for key in keys)
    capture.release()
    if width * height > MAX_PIXELS:
        raise InputError(f"{shown(path)}: {width} x {height} px; at most {MAX_PIXELS} px are allowed")
    return Source(path, max(count, 1))


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return the key that sorts frame10 behind frame9."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name) if part]
