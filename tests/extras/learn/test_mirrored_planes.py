"""A mirrored picture gives the dense network mirrored inputs and truths."""

import numpy as np
import pytest
import test_dense_inputs
import torch
from test_dense_inputs import LIGHTS, frame

from simtest.dataset.shard import Sample
from simtest.estimators.learned_dense import (
    dense_inputs,
    output_centres,
)
from studies.networks.dense import moved
from studies.networks.examples import truth_at

picture = test_dense_inputs.picture


@pytest.mark.parametrize("flips", [(True, False), (False, True), (True, True)], ids=["mirrored", "upside down", "both"])
def test_a_mirrored_tilted_plane_gives_mirrored_inputs_and_truths(picture, flips):
    mirror = np.diag([-1.0 if flips[0] else 1.0, -1.0 if flips[1] else 1.0, 1.0])
    axes = [axis for axis, flip in zip((1, 0), flips, strict=True) if flip]
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])

    def batch(values, facing, lights):
        seen = frame(values, lights=tuple(map(tuple, lights)))
        rays = seen.camera.unproject(seen.camera.pixel_centres())
        # A plane 40 mm away on the optical axis.
        depth = 40 * facing[2] / (rays @ facing)
        normals = np.broadcast_to(facing, rays.shape)
        images = {"depth": depth, "normal_base": normals, "instrument": np.zeros(depth.shape, np.uint8)}
        rotation, distance = truth_at(Sample({}, images), seen.camera, output_centres(seen.camera))
        made = {"planes": dense_inputs(seen), "rotation": rotation, "distance": distance}
        return {name: torch.from_numpy(np.float32(each))[None] for name, each in made.items()}

    before = batch(picture, normal, np.array(LIGHTS))
    after = batch(np.ascontiguousarray(np.flip(picture, axes)), mirror @ normal, np.array(LIGHTS) @ mirror)
    turned = moved(before, *flips)
    for name in before:
        # Truths are read in the pixel of the cell's centre, which mirroring moves by up to one.
        tolerance = 1e-5 if name == "planes" else 0.01 * float(after[name].abs().max())
        assert torch.allclose(turned[name], after[name], atol=tolerance), name
        assert not torch.allclose(before[name], after[name], atol=0.05), name
