"""The frames of a folder or a video, one after the other."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.reconstruction.image_io import MAX_PIXELS, PICTURE_SUFFIXES, read_picture
from simtest.runtime.resources import shown

Image = npt.NDArray[np.float32]

VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv")


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
