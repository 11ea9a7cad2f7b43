"""What a picture or film loses on its way is told once: transparency, missing ends, tags that are not there."""

import warnings

import cv2
import numpy as np
import pytest

from simtest.reconstruction.images import open_source, read_picture
from tests.refusals import refused


def picture(alpha=None):
    values = np.full((20, 30, 3), 90, np.uint8)
    return values if alpha is None else np.dstack([values, alpha])


def told(path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert read_picture(path).shape == (20, 30, 3)
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_pixels_that_are_transparent_are_told(tmp_path, depth):
    path, most = tmp_path / "x.png", np.iinfo(depth).max
    alpha = np.full((20, 30), most, depth)
    cv2.imwrite(str(path), np.dstack([picture().astype(depth), alpha]))
    assert told(path) == []
    alpha[:5] = 0
    cv2.imwrite(str(path), np.dstack([picture().astype(depth), alpha]))
    assert told(path) == [f"{path}: its alpha channel is ignored, by which 0.25 of the pixels are transparent"]
    # Full alpha of 8 bits, shifted to 16, as some programs write it.
    if depth is np.uint16:
        cv2.imwrite(str(path), np.dstack([picture().astype(depth), np.full_like(alpha, 255 << 8)]))
        assert told(path) == []
    # All alike, and below full.
    cv2.imwrite(str(path), np.dstack([picture().astype(depth), np.full_like(alpha, most // 2)]))
    assert told(path) == [f"{path}: its alpha channel is ignored, by which 1 of the pixels are transparent"]
    cv2.imwrite(str(path), picture())
    assert told(path) == []


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_cut_tiff_file_gives_one_line(tmp_path, share):
    path = tmp_path / "x.tif"
    cv2.imwrite(str(path), picture())
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        refused(lambda: read_picture(path), "x.tif: no picture")
    assert not caught


def test_a_cut_avi_file_is_known_by_its_length(tmp_path):
    path = tmp_path / "x.avi"
    film = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for _ in range(12):
        film.write(np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    film.release()
    assert not open_source(path).is_cut
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    assert open_source(path).is_cut
