"""Reads and writes OpenEXR files with Mitsuba's own image library."""

import errno
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.rendering import backend
from simtest.rendering.backend import mi
from simtest.runtime.arrays import Image
from simtest.runtime.files import check_picture_size

HEADER_BYTES = 65536
"""In which the size of an image must stand."""


def write_exr(path: Path, image: Image, variant: str | None = None) -> None:
    """Write linear values, shape (H, W) or (H, W, 3), as a float32 OpenEXR file; the path ends in .exr."""
    backend.load(variant)
    bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
    try:
        with _two_threads():
            bitmap.write(str(path))
    except RuntimeError as error:
        # Mitsuba's stream tells the system's error by its text alone.
        known = (number for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) if os.strerror(number) in str(error))
        number = next(known, errno.EIO)
        raise OSError(number, os.strerror(number), str(path)) from error


@contextmanager
def _two_threads() -> Iterator[None]:
    """Run with two threads at least: OpenEXR waits for a task of Dr.Jit's pool, for ever where that has one."""
    import drjit

    threads = drjit.thread_count()
    if threads < 2:
        drjit.set_thread_count(2)
    try:
        yield
    finally:
        if threads < 2:
            drjit.set_thread_count(threads)


def read_bitmap(path: Path, variant: str | None = None) -> Image:
    """Read an OpenEXR file as float32, shape (H, W) or (H, W, C)."""
    _check_size(path)
    backend.load(variant)
    try:
        with _two_threads():
            bitmap = mi.Bitmap(str(path))
    except Exception as error:
        # Mitsuba hands on whatever OpenEXR runs into.
        last = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(f"{path}: cannot be read ({last:.120})") from None
    # Converted here: Mitsuba converts no image of one channel that is called Z, as depth is.
    return np.array(np.array(bitmap), dtype=np.float32)


def _check_size(path: Path) -> None:
    """Raise `InputError` where an OpenEXR file's header announces too many pixels; it is asked for memory later."""
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
    key = b"dataWindow\0box2i\0\x10\0\0\0"
    start = head.find(key) + len(key)
    if start < len(key) or len(head) < start + 16:
        raise InputError(f"{path}: no OpenEXR image; its header has no data window")
    left, top, right, bottom = struct.unpack("<4i", head[start : start + 16])
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1:
        raise InputError(f"{path}: {width} x {height} px; must be 1 px or more along each side")
    check_picture_size(path, width, height)
