"""PNG written and read by ISA-L: our own, since no library uses its deflate, several times faster than zlib's.

With OpenCV encoding took most of the time of writing and reading a dataset (docs/howto/datasets.md). The files are
plain PNG, which any reader opens. Any PNG can be read: one that was not written here is left to OpenCV.
"""

import struct
from typing import Literal

import cv2
import numpy as np
from isal import isal_zlib

from simtest.runtime.arrays import AnyArray

Filter = Literal["none", "up"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FILTERS: dict[Filter, int] = {"none": 0, "up": 2}
_COLOURS = {0: 1, 2: 3}
"""Channels by PNG's colour type: grey, and red, green, blue."""

LEVEL = 1
"""Of ISA-L's 0 to 3: higher ones take longer for files 1 % smaller (docs/howto/datasets.md)."""


def encode(image: AnyArray, rows: Filter, level: int = LEVEL) -> bytes:
    """Encode an image as a PNG file.

    Parameters
    ----------
    image : ndarray of uint8 or uint16, shape (H, W) or (H, W, 3)
        R, G, B where there are channels.
    rows : {"none", "up"}
        Filter of all rows: "up" keeps differences to the row above, which are small where the image is smooth.
    level : int
        ISA-L's, 0 to 3.
    """
    height, width = image.shape[:2]
    wide = image if image.dtype == np.uint8 else image.astype(">u2")
    flat = np.ascontiguousarray(wide).view(np.uint8).reshape(height, -1)
    # Each row begins with the number of its filter.
    table = np.empty((height, flat.shape[1] + 1), np.uint8)
    table[:, 0] = _FILTERS[rows]
    table[:, 1:] = flat
    if rows == "up":
        table[1:, 1:] -= flat[:-1]
    colour = 0 if image.ndim == 2 else 2
    head = struct.pack(">IIBBBBB", width, height, 8 * image.itemsize, colour, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", isal_zlib.compress(table, level)), (b"IEND", b"")
    return _SIGNATURE + b"".join(_chunk(kind, data) for kind, data in chunks)


def decode(data: bytes) -> AnyArray:
    """Decode a PNG file to an image as `encode` takes it; raise `ValueError` if the data are none."""
    own = _decode_own(data)
    if own is not None:
        return own
    try:
        # OpenCV allocates memory for a chunk of any stated length before it looks whether the chunk is there.
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if _is_whole(data) else None
    except cv2.error:
        image = None
    if image is None:
        raise ValueError("no PNG")
    return np.asarray(image if image.ndim == 2 else image[:, :, 2::-1])


def _is_whole(data: bytes) -> bool:
    """Return whether the stated lengths of a file's chunks add up to the length of the file."""
    offset = len(_SIGNATURE)
    while offset + 8 <= len(data):
        offset += 12 + int(struct.unpack_from(">I", data, offset)[0])
    return data.startswith(_SIGNATURE) and offset == len(data)


def _chunk(kind: bytes, data: bytes) -> bytes:
    crc = isal_zlib.crc32(data, isal_zlib.crc32(kind))
    return b"".join((struct.pack(">I", len(data)), kind, data, struct.pack(">I", crc)))


def _decode_own(data: bytes) -> AnyArray | None:
    """Decode a file of `encode`; return None if it is of another kind, or damaged."""
    found = _split(data)
    if found is None:
        return None
    (height, width, itemsize, channels), packed = found
    try:
        table = np.frombuffer(isal_zlib.decompress(packed), np.uint8)
    except isal_zlib.error:  # type: ignore[misc]  # its stub says nothing of what it is
        return None
    wide = width * channels * itemsize
    if table.size != height * (wide + 1):
        return None
    table = table.reshape(height, wide + 1)
    values = table[:, 1:].copy()
    if (table[:, 0] == _FILTERS["up"]).all():
        # Row by row: six times as fast as NumPy's cumulative sum along that axis.
        last = values[0]
        for row in values[1:]:
            np.add(last, row, row)
            last = row
    elif table[:, 0].any():
        return None
    if itemsize == 2:
        values = values.view(">u2").astype(np.uint16)
    return values.reshape((height, width) if channels == 1 else (height, width, channels))


def _split(data: bytes) -> tuple[tuple[int, int, int, int], bytes] | None:
    """Return (height, width, bytes per value, channels) and the packed rows; None if the file is of another kind."""
    # One IDAT chunk right after IHDR, and IEND right after it, is what `encode` writes.
    if data[:8] != _SIGNATURE or data[12:16] != b"IHDR" or data[37:41] != b"IDAT":
        return None
    width, height, bits, colour, *rest = struct.unpack(">IIBBBBB", data[16:29])
    length = struct.unpack(">I", data[33:37])[0]
    end = 41 + length
    plain = bits in (8, 16) and colour in _COLOURS and not any(rest)
    if not (plain and width and height) or data[end + 8 : end + 12] != b"IEND":
        return None
    packed = data[41:end]
    if struct.unpack(">I", data[end : end + 4])[0] != isal_zlib.crc32(packed, isal_zlib.crc32(b"IDAT")):
        return None
    return (height, width, bits // 8, _COLOURS[colour]), packed
