"""H.264 among the stages of a camera."""

import numpy as np
import pytest
from test_camera_stages import picture

from simtest.simulation import sensor as camera_chain
from simtest.spec.sensor import (
    H264Coding,
)


@pytest.mark.parametrize("shape", [(48, 64, 3), (47, 63, 3), (33, 50)])
def test_h264_keeps_the_picture_and_loses_with_crf(shape):
    frame = (255 * picture(shape, smooth=1.5)).astype(np.uint8)
    errors = []
    for crf in (10, 30, 45):
        coded = camera_chain.code(frame, H264Coding(crf=crf, frames=3))
        assert coded.shape == frame.shape
        np.testing.assert_array_equal(coded, camera_chain.code(frame, H264Coding(crf=crf, frames=3)))
        luma = coded.astype(float) if frame.ndim == 2 else coded @ [0.299, 0.587, 0.114]
        expected = frame.astype(float) if frame.ndim == 2 else frame @ [0.299, 0.587, 0.114]
        errors.append(float(np.sqrt(np.square(luma - expected).mean())))
    assert errors == sorted(errors)
    assert errors[0] < 4 < errors[-1]
