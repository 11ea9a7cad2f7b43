"""Pictures, folders of pictures and videos: their values in [0, 1], or an error of one line that says why not."""

import contextlib
import operator
import os
import re
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image as PillowImage

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.runtime.arrays import Image
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import check_limit, check_picture_size, require_plain

PATIENCE_MS = 5000
"""After so long FFmpeg gives up opening a film, or reading a frame."""

MOST_BITS = 96
"""Of a pixel, for which the limit of pixels is meant: three channels of 32 bits."""

ORIENTATION = 0x0112
"""Tag of files that viewers turn or mirror."""

TURNED = {"JPEG": "as they are stored", "MPO": "as they are stored", "TIFF": "as the tag turns them"}
"""What OpenCV makes of that tag, by formats that have it."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")

_ERROR_STREAM = threading.RLock()


def read_picture(path: Path) -> Image:
    """Read a picture of 8 or 16 bits as values in [0, 1], as they are encoded; shape (H, W) or (H, W, 3), RGB.

    Grey, RGB and RGBA are read; alpha is ignored, with a warning where pixels are transparent. Raises
    `InputError` as `read_raw` does, and for other depths.
    """
    picture = read_raw(path, "a picture (PNG, JPEG, BMP, TIFF)")
    scaled = scale_picture(picture, str(path))
    if scaled is None:
        raise InputError(f"{path}: pixels are {picture.dtype}; must be 8 or 16 bits")
    alpha = picture[..., 3] if picture.ndim == 3 and picture.shape[2] == 4 else None
    if alpha is not None and (clear := float(np.less(alpha, OPAQUE * LARGEST[alpha.dtype.name]).mean())):
        told = f"{path}: its alpha channel is ignored, by which {clear:.2g} of the pixels are transparent"
        warnings.warn(told, stacklevel=3)
    # OpenCV's order of channels is BGR.
    return scaled if scaled.ndim == 2 else np.ascontiguousarray(scaled[:, :, ::-1])


@plain_errors
def read_raw(path: Path, wanted: str) -> npt.NDArray[np.generic]:
    """Read the pixels of a picture file as they are, in OpenCV's order of channels; of several pages the first."""
    require_plain(path, "picture_bytes", wanted)
    _check_header(path)
    data = np.fromfile(path, dtype=np.uint8)
    try:
        with quiet_libraries():
            picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded ({str(error).splitlines()[0][:120]})") from error
    if picture is None:
        raise InputError(f"{path}: no picture ({data.size} bytes); must be PNG, JPEG, BMP or TIFF")
    check_picture_size(path, picture.shape[1], picture.shape[0])
    return np.asarray(picture)


def _check_header(path: Path) -> None:
    """Raise `InputError` where a file's header announces too many pixels; warn where it holds several pictures."""
    try:
        # Pillow warns of large pictures, and refuses them at twice its own limit.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(path) as header:
                (width, height), animated = header.size, bool(getattr(header, "is_animated", False))
                turned = header.getexif().get(ORIENTATION, 1) if header.format in TURNED else 1
                bits = 0  # Of what Pillow knows none takes more.
    except PillowImage.DecompressionBombError as error:
        # Beyond a limit of its own Pillow tells the size in words alone.
        pixels = re.search(r"\d+", str(error))
        check_limit("picture_pixels", int(pixels[0]) if pixels else 2**40, path, "px")
        return
    except Exception:
        # OpenCV reads more than Pillow, whose parsers raise whatever they run into, and says what is wrong with others.
        width, height, bits = _tiff_size(path)
        animated, turned = False, 1
    check_picture_size(path, width, height)
    # Floats of several channels may need more memory than the pixels alone tell.
    share = bits / MOST_BITS
    check_limit("picture_pixels", width * height * share, f"{path}: {bits} bits a pixel", f"times {MOST_BITS} bits")
    if turned != 1:
        tag = f"{path}: its orientation tag is {turned}"
        how = f"pixels are taken {TURNED.get(str(header.format), '')}, and the calibration must be of such pictures"
        warnings.warn(f"{tag}: {how}", stacklevel=4)
    if animated:
        warnings.warn(f"{path}: holds several pictures; the first is used", stacklevel=4)


def header_size(path: Path) -> tuple[int, int] | None:
    """Return width and height by a picture's header, as it will be read; None where Pillow does not know the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with PillowImage.open(path) as header:
                is_on_its_side = header.format == "TIFF" and header.getexif().get(ORIENTATION, 1) > 4
                return header.size[::-1] if is_on_its_side else header.size
    except Exception:
        # Whoever reads the picture says what is wrong with it.
        return None


def _tiff_size(path: Path) -> tuple[int, int, int]:
    """Return width, height and bits a pixel of a TIFF file that Pillow does not know; zeros where it is none."""
    from PIL import TiffImagePlugin

    try:
        with path.open("rb") as file:
            head = file.read(16)
            if 43 in head[2:4]:
                # A BigTIFF: its header has 16 bytes; Pillow knows it by the little-endian one alone.
                tags = TiffImagePlugin.ImageFileDirectory_v2(b"II\x2b\0" + head[4:], prefix=head[:2])
            else:
                tags = TiffImagePlugin.ImageFileDirectory_v2(head[:8])
            file.seek(tags.next)
            # It warns of what it does not find; whoever decodes the picture tells that it cannot be read.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tags.load(file)
            width, height = int(tags[TiffImagePlugin.IMAGEWIDTH]), int(tags[TiffImagePlugin.IMAGELENGTH])
            return width, height, sum(tags.get(TiffImagePlugin.BITSPERSAMPLE, (1,)))
    except Exception:
        return 0, 0, 0


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
    is_cut: bool = False
    """Whether a video's file is shorter than its header says."""

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
    capture = _capture(path)

    def read() -> Image:
        with quiet_libraries():
            done, frame = capture.retrieve()
        if not done or frame is None:
            raise InputError(f"{path}: a frame cannot be decoded")
        values = frame.astype(np.float32) / np.float32(255)
        return values if values.ndim == 2 else np.ascontiguousarray(values[:, :, ::-1])

    try:
        rate = float(capture.get(cv2.CAP_PROP_FPS))
        index = 0
        # A frame that is not wanted is skipped without being decoded.
        while _grabbed(capture):
            yield SequenceFrame(index, f"{path.name}#{index}", index / rate if rate > 0 else None, read)
            index += 1
    finally:
        capture.release()


def _capture(path: Path) -> cv2.VideoCapture:
    """Open a film; FFmpeg gives up reading after `PATIENCE_MS`."""
    patience = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, PATIENCE_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, PATIENCE_MS]
    with quiet_libraries():
        return cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, patience)


def _grabbed(capture: cv2.VideoCapture) -> bool:
    with quiet_libraries():
        return bool(capture.grab())


def is_sequence(path: Path) -> bool:
    """Return whether a path is a folder, or a video by its suffix."""
    return path.is_dir() or path.suffix.lower() in VIDEO_SUFFIXES


def open_source(path: Path) -> Source:
    """Open a folder or a video; raise `InputError` if there is none, or it holds no frame."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES and file.is_file()]
        if not files:
            raise InputError(f"{path}: holds no pictures ({', '.join(PICTURE_SUFFIXES)})")
        return Source(path, len(files), tuple(sorted(files, key=_natural)))
    size = require_plain(path, None, "a film, a picture or a folder of pictures").stat().st_size
    # FFmpeg takes whatever it can make sense of, playlists of other files among it.
    with path.open("rb") as file:
        head = file.read(16)
        if not _is_film(head):
            raise InputError(f"{path}: no video that can be read ({size} bytes, of no known container)")
    capture = _capture(path)
    # OpenCV opens some files that hold no frame, so the first is fetched.
    if not capture.isOpened() or not _grabbed(capture):
        raise InputError(f"{path}: no video that can be read ({size} bytes)")
    keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
    width, height, count = (int(capture.get(key)) for key in keys)
    capture.release()
    check_picture_size(path, width, height)
    # Only an AVI file tells its length at its beginning.
    is_cut = head[:4] == b"RIFF" and size < 8 + int.from_bytes(head[4:8], "little")
    return Source(path, max(count, 1), is_cut=is_cut)


def _is_film(head: bytes) -> bool:
    """Return whether a file begins as a film's container: MP4 or QuickTime, AVI, Matroska, ASF, MPEG."""
    return (
        head[4:8] in (b"ftyp", b"moov", b"mdat", b"free", b"wide", b"skip")
        or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
        or head.startswith((b"\x1a\x45\xdf\xa3", b"\x30\x26\xb2\x75", b"\0\0\1\xba", b"\0\0\1\xb3"))
        or head[:1] == b"G"
    )


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return the key that sorts frame10 behind frame9."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", path.name) if part]


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """Send nowhere what is written to the process's error stream meanwhile; for single calls of a library.

    libpng, libtiff and FFmpeg write to the descriptor itself, which no setting of OpenCV prevents.
    """
    with _ERROR_STREAM:
        try:
            sys.stderr.flush()
            kept = os.dup(2)
        except (OSError, ValueError, AttributeError):
            # There is no error stream.
            yield
            return
        try:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


# Values of a picture, from a file or an array -------------------------------------------------------------------------

LARGEST = {"uint8": 2**8 - 1, "uint16": 2**16 - 1}
"""The value that light of full scale has, by the type of the values."""

OPAQUE = 0.99
"""Share of full scale from which a pixel counts as opaque: full alpha of 8 bits, shifted to 16, is 0.996."""

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
        text = "frame: must be an array of numbers; its rows differ in length or hold something else"
        raise InputError(text) from None
    if given.dtype.kind not in "biuf":
        raise InputError(f"frame holds values of type {given.dtype}: must be an array of real numbers")
    if given.ndim not in (2, 3) or given.size == 0:
        raise InputError(f"frame has shape {given.shape}: must be (H, W) or (H, W, C)")
    image = scale_picture(given, "frame")
    is_picture = image is not None or encoding == "srgb"
    if image is None:
        if given.dtype.kind != "f":
            needed = "must be uint8, uint16 or real"
            raise InputError(f"frame holds integers of type {given.dtype}, whose range is not known: {needed}")
        # What float32 cannot hold becomes infinite and is refused below.
        with np.errstate(all="ignore"):
            image = given.astype(np.float32)
    check_size(image, camera)
    low, high = finite_range(image)
    if is_picture and (low < 0 or high > 1):
        raise InputError(f"frame holds values from {low:g} to {high:g}: encoded real values must lie in [0, 1]")
    if is_picture and image.ndim == 3 and image.shape[2] not in (1, 3):
        raise InputError(f"frame has {image.shape[2]} channels: a picture must have 1 or 3, or alpha beside them")
    if low < 0 and high <= 0:
        raise InputError(f"frame holds values from {low:g} to {high:g}: some must be above 0")
    return image, is_picture


def finite_range(image: Image) -> tuple[float, float]:
    """Return the least and the largest value; raise `InputError` where some, or means of channels, are not finite."""
    with np.errstate(all="ignore"):
        # NaN and infinity show at both or either end of the range, which costs less than the means.
        low, high = float(image.min()), float(image.max())
        if max(-low, high) * (1 if image.ndim == 2 else image.shape[2]) < SAFE_SUM:
            return low, high
        # The channels' mean may be beyond what float32 holds.
        finite = np.isfinite(image if image.ndim == 2 else image.mean(axis=2, dtype=np.float32))
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        raise InputError(f"frame holds {bad} values that are NaN, infinite or beyond 3e38: all must be finite")
    return low, high


def check_size(image: Image, camera: Camera) -> None:
    """Raise `InputError` where a frame is not of the camera's size."""
    if image.shape[:2] != (camera.height, camera.width):
        needed = f"must be {camera.width} x {camera.height}, the size of the camera's calibration"
        raise InputError(f"frame is {image.shape[1]} x {image.shape[0]} px: {needed}")


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
