"""Noise of quantities that are linear in smoothed pixels, against the smoothing written out as a matrix."""

import numpy as np
import pytest

from simtest.estimators.budget import gram, raw_moves
from simtest.geometry import smooth

SIZE, SMOOTHING = 41, 2.0


def test_the_product_with_the_transpose_is_the_covariance():
    rows = np.random.default_rng(0).normal(size=(3, 500)).astype(np.float32)
    np.testing.assert_allclose(gram(rows), rows.astype(float) @ rows.T.astype(float), rtol=1e-5)


@pytest.mark.parametrize("kind", ["one number", "a map"])
def test_raw_pixels_move_what_smoothed_pixels_move(kind):
    random = np.random.default_rng(1)
    # The margin of the kernel lies inside the patch.
    rows, columns = random.integers(15, 26, 12), random.integers(15, 26, 12)
    moves = random.normal(size=(2, 12))
    # A map that changes slowly: beyond the pixels the value at their edge is taken.
    slow = np.float32(0.02) * (1 + np.linspace(-0.3, 0.3, SIZE, dtype=np.float32)) * np.ones((SIZE, 1), np.float32)
    noise = 0.02 if kind == "one number" else slow
    found = gram(raw_moves(rows * SIZE + columns, moves, SIZE, noise, SMOOTHING))
    impulses = np.eye(SIZE * SIZE, dtype=np.float32).reshape(-1, SIZE, SIZE)
    near = [i for i in range(SIZE * SIZE) if 5 <= i // SIZE < 36 and 5 <= i % SIZE < 36]
    smoothed = np.stack([smooth(impulses[i], SMOOTHING)[rows, columns] for i in near]).astype(float)
    each = (smoothed @ moves.T) * np.broadcast_to(noise, (SIZE, SIZE)).ravel()[near, None]
    wanted = each.T @ each
    assert np.abs(found - wanted).max() < (5e-3 if kind == "one number" else 0.02) * np.abs(wanted).max()
