"""Short ways of one picture's pipeline give the bits of the plain ones."""

import numpy as np
import pytest

from simtest import Camera, InputError
from simtest.calibration.calibration import brightest_channel, mean_channel
from simtest.detection.view import _row_ends
from simtest.geometry.vectors import basis_across, tangent_basis
from simtest.reconstruction.images import check_frame

CAMERA = Camera.from_fov(60.0, 8, 6)


@pytest.mark.parametrize("channels", [1, 3, 4, 6])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_channels_are_combined_as_along_the_last_axis(channels, dtype):
    frame = np.random.default_rng(channels).normal(size=(31, 45, channels)).astype(dtype)
    # A part of a frame, and one whose channels were reversed, too
    for values in (frame, frame[3:20, 5:], frame[:, :, ::-1]):
        assert np.array_equal(brightest_channel(values), values.max(axis=2))
        assert np.array_equal(mean_channel(values), values.mean(axis=2, dtype=np.float32))
    assert brightest_channel(frame[:, :, 0]) is not None
    assert mean_channel(frame[:, :, 0]).shape == (31, 45)


def test_a_basis_is_that_of_many_to_the_last_bit():
    vectors = np.random.default_rng(0).normal(size=(500, 3))
    vectors[:3] = (0, 0, 1), (0, 0, -1), (1, 0, 0)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    first, second = tangent_basis(vectors)
    for i, vector in enumerate(vectors):
        assert np.array_equal(basis_across(vector), [first[i], second[i]])


def test_channels_whose_sum_overflows_are_refused_and_large_ones_are_not():
    frame = np.zeros((6, 8, 3), dtype=np.float32)
    frame[1, 1] = 2e38
    with pytest.raises(InputError, match="beyond 3e38"):
        check_frame(frame, CAMERA)
    frame[1, 1] = 2e38, -2e38, 0
    assert check_frame(frame, CAMERA)[0][1, 1, 0] == np.float32(2e38)


def test_ends_of_rows_are_those_of_each():
    mask = np.random.default_rng(2).random((20, 30)) < 0.1
    mask[4] = False
    pairs = {(c, r) for r in range(20) if mask[r].any() for c in np.flatnonzero(mask[r])[[0, -1]].tolist()}
    assert {tuple(each) for each in _row_ends(mask)[:, 0].tolist()} == pairs
