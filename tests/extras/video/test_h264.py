"""H.264 among the stages of a camera."""

import os

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


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processors cannot be chosen here")
def test_the_number_of_processors_changes_no_byte():
    frame, cores = (255 * picture((480, 640, 3), smooth=1.5)).astype(np.uint8), os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        alone = camera_chain.code(frame, H264Coding(crf=28, frames=3))
    finally:
        os.sched_setaffinity(0, cores)
    np.testing.assert_array_equal(camera_chain.code(frame, H264Coding(crf=28, frames=3)), alone)
