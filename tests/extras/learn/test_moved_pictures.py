"""A moved picture gives the network of spots moved inputs."""

import numpy as np
import pytest
import test_network_geometry
import torch
from test_network_geometry import LIGHTS, PEAK, WIDTH, frame

from simtest.estimators.learned import rotation_of
from simtest.estimators.learned_spot import spot_inputs
from studies.networks.spots import moved as moved_batch

picture = test_network_geometry.picture


@pytest.mark.parametrize(
    ("change", "moved"),
    [
        (lambda p: p[:, ::-1], (True, False, False)),
        (lambda p: p[::-1], (False, True, False)),
        (lambda p: p.T, (False, False, True)),
        (lambda p: p.T[::-1], (True, False, True)),
    ],
    ids=["mirrored", "upside down", "transposed", "turned"],
)
def test_a_moved_picture_gives_moved_inputs(picture, change, moved):
    flip_x, flip_y, transpose = moved
    # The move of the picture as a matrix, for lights, peak and normal: mirrored first, then transposed.
    matrix = np.diag([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0, 1.0])
    matrix = matrix[[1, 0, 2]] if transpose else matrix
    middle = WIDTH / 2
    peak = (matrix[:2, :2] @ (PEAK - middle)) + middle
    normal = np.array([0.2, -0.1, -1.0]) / np.linalg.norm([0.2, -0.1, -1.0])
    before, after = frame(picture), frame(np.ascontiguousarray(change(picture)), LIGHTS @ matrix.T)
    batch = {}
    for name, seen, at, true in (("before", before, PEAK, normal), ("after", after, peak, matrix @ normal)):
        crops, extras = spot_inputs(seen, [at])
        rotation = rotation_of(seen.camera.unproject(at[None]), true[None])
        batch[name] = {
            "crops": torch.from_numpy(crops), "extras": torch.from_numpy(extras),
            "base": torch.from_numpy(rotation), "fine": torch.from_numpy(rotation),
        }  # fmt: skip
    turned = moved_batch(batch["before"], flip_x, flip_y, transpose)
    assert torch.allclose(turned["crops"], batch["after"]["crops"], atol=1e-4)
    # The basis follows the image's x, so off the axis a transposed one is turned by a small angle.
    tolerance = 0.03 if transpose else 1e-5
    for name in ("extras", "base", "fine"):
        assert torch.allclose(turned[name], batch["after"][name], atol=tolerance), name
    # What is compared does change with the move.
    assert not torch.allclose(batch["before"]["extras"], batch["after"]["extras"], atol=0.05)
