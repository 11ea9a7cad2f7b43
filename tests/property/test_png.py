"""PNG files of datasets: any image comes back, any reader opens them, and any PNG is read."""

import contextlib
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from simtest.dataset.png import decode, encode
from tests.example_counts import examples

IMAGES = st.sampled_from([np.uint8, np.uint16]).flatmap(
    lambda kind: arrays.arrays(
        kind, st.tuples(st.integers(1, 9), st.integers(1, 9)).flatmap(lambda s: st.sampled_from([s, (*s, 3)]))
    )
)


def opened_by_opencv(data):
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    return image if image.ndim == 2 else image[:, :, ::-1]


@given(IMAGES, st.sampled_from(["none", "up"]))
@settings(max_examples=examples(200), deadline=None)
def test_an_image_comes_back(image, rows):
    data = encode(image, rows)
    for found in (decode(data), opened_by_opencv(data)):
        np.testing.assert_array_equal(found, image)
        assert found.dtype == image.dtype


@given(IMAGES)
@settings(max_examples=examples(50), deadline=None)
def test_files_of_other_writers_are_read(image):
    _, data = cv2.imencode(".png", image if image.ndim == 2 else image[:, :, ::-1])
    np.testing.assert_array_equal(decode(data.tobytes()), image)


@given(st.data())
@settings(max_examples=examples(200), deadline=None)
def test_damaged_files_give_an_error_or_an_image(data):
    good = encode(np.arange(64 * 48, dtype=np.uint16).reshape(48, 64), "up")
    place = data.draw(st.integers(0, len(good) - 1))
    bad = good[:place] if data.draw(st.booleans()) else good[:place] + bytes([good[place] ^ 0x55]) + good[place + 1 :]
    # OpenCV forgives more than we do: what it makes of a damaged file is for the hashes to find.
    with contextlib.suppress(ValueError):
        assert decode(bad).dtype in (np.uint8, np.uint16)


def without_rows():
    head = struct.pack(">IIBBBBB", 5, 0, 16, 0, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", zlib.compress(b"")), (b"IEND", b"")
    made = [struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


@pytest.mark.parametrize("data", [b"", b"no", b"\x89PNG\r\n\x1a\n", without_rows()])
def test_what_is_no_png_is_refused(data):
    with pytest.raises(ValueError, match="no PNG"):
        decode(data)
