"""Files of named arrays that `numpy.load` reads (.npz), each array compressed only where that pays."""

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

WORTHWHILE = 0.75
"""Arrays whose sample shrinks to less than this share are compressed. Maps of floats shrink to 0.9, for 4 s a frame."""

SAMPLES, SAMPLE_BYTES = 32, 8192
"""Pieces of an array that are tried, evenly spaced, and their size."""

LEVEL = 1
"""Of zlib: higher ones take longer and gain less than one per cent."""


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays by name to an .npz file; the same arrays give the same bytes.

    Raises
    ------
    ValueError
        If an array holds Python objects.
    """
    with zipfile.ZipFile(path, "w") as file:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array), allow_pickle=False)
            data = content.getbuffer()
            # Without a date, which would differ from run to run.
            entry = zipfile.ZipInfo(f"{name}.npy")
            kind = zipfile.ZIP_DEFLATED if _shrinks(data) else zipfile.ZIP_STORED
            file.writestr(entry, data, kind, LEVEL)


def _shrinks(data: memoryview) -> bool:
    """Return whether a file's content is worth its compression."""
    step = max(len(data) // SAMPLES, SAMPLE_BYTES)
    pieces = [data[start : start + SAMPLE_BYTES] for start in range(0, len(data), step)]
    shrunk = sum(len(zlib.compress(piece, LEVEL)) for piece in pieces)
    return shrunk < WORTHWHILE * sum(map(len, pieces))
