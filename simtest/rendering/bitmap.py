"""Reads and writes OpenEXR files with Mitsuba's own image library."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.rendering import backend
from simtest.runtime.arrays import Image
from simtest.runtime.resources import shown


def write_exr(path: Path, image: Image, variant: str | None = None) -> None:
    """Write linear values, shape (H, W) or (H, W, 3), as a float32 OpenEXR file; the path ends in .exr."""
    mi = backend.load(variant)
    bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
    with _two_threads():
        bitmap.write(str(path))


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
    """Read an OpenEXR file as float32, shape (H, W) or (H, W, C).

    Raises
    ------
    InputError
        If the file is not an image.
    """
    mi = backend.load(variant)
    try:
        with _two_threads():
            bitmap = mi.Bitmap(str(path))
    except RuntimeError as error:
        raise InputError(f"{shown(path)}: cannot be read ({shown(str(error).splitlines()[-1], 120)})") from None
    return np.array(bitmap.convert(component_format=mi.Struct.Type.Float32), dtype=np.float32)
