"""One rule for what a calibration does not know: values are linear light, and nothing counts as clipped."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, NoiseModel, Response
from simtest.geometry import Camera
from simtest.reconstruction.options import complete
from simtest.reconstruction.pipeline import reconstruct

CAMERA = Camera.from_fov(60.0, 160, 120)


def tissue():
    """Return a colour frame of linear light beyond 1, with two highlights."""
    y, x = np.mgrid[:120, :160] + 0.5
    lobes = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 60) for a, b in ((50, 40), (110, 80)))
    noise = np.random.default_rng(0).normal(0, 0.004, (120, 160, 3))
    return (0.35 * np.array([1.0, 0.55, 0.45]) + 1.2 * lobes[..., None] + noise).astype(np.float32)


@pytest.mark.parametrize("values", [tissue(), tissue()[..., 0]], ids=["colour", "grey"])
def test_a_frame_without_a_response_is_linear_light_for_every_step(values):
    frame = Frame(values, Calibration(CAMERA), 1.0)
    assert (frame.channels == values).all()
    assert not frame.clipped.any()
    same = Frame(values, Calibration(CAMERA, Response("linear")), 1.0)
    assert (frame.corrected.intensity == same.corrected.intensity).all()
    assert frame.noise == same.noise


def test_light_by_colour_is_that_of_a_stated_linear_response():
    found, stated = (reconstruct(tissue(), Calibration(CAMERA, r), detector="colour") for r in (None, Response()))
    assert len(found) == len(stated) == 2
    for first, second in zip(found, stated, strict=True):
        assert first.region == second.region
        for name, estimate in first.estimates.items():
            assert np.array_equal(estimate.normal, second.estimates[name].normal)


@pytest.mark.parametrize("encoding", [None, "srgb", "linear"])
def test_the_noise_of_a_picture_has_the_steps_of_its_encoding(encoding):
    known = complete(Calibration(CAMERA, noise=NoiseModel(bits=8)), encoding)
    assert known.noise.response == known.response == Response(encoding or "srgb")
