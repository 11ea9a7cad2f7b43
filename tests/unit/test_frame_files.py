"""Files of a rendered frame against closed forms: colours of the picture, curvatures and depth of the truth."""

import cv2
import numpy as np
import pytest

from simtest.simulation.frame_files import encoded_png, thumbnail
from simtest.spec.sensor import Sensor

RADIUS, SIZE, FOCAL = 15.0, 48, 60.0


@pytest.mark.parametrize("sensor", [{}, {"bits": 8, "response": {"type": "srgb"}}, {"bits": 12}])
def test_a_picture_is_red_where_the_frame_is(sensor):
    frame = np.zeros((4, 6, 3), np.float32)
    frame[0, :, 0], frame[1, :, 1], frame[2, :, 2] = 1.0, 1.0, 1.0
    data = np.frombuffer(encoded_png(frame, Sensor.model_validate(sensor)), np.uint8)
    # OpenCV gives blue first.
    blue, green, red = np.moveaxis(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), -1, 0)
    for row, channel in enumerate((red, green, blue)):
        assert (channel[row] == channel.max()).all()
        assert not np.delete(channel, row, axis=0).any()


@pytest.mark.render
def test_the_truths_curvatures_and_depth_are_those_of_the_tube(here, tmp_path):
    """The inside of a cylinder: concave across its axis, straight along it; the first of the two is the smaller."""
    camera = {"width": SIZE, "height": SIZE, "fx": FOCAL, "fy": FOCAL, "cx": SIZE / 2, "cy": SIZE / 2}
    settings = {"surface.radius_mm": RADIUS, "surface.side": "inside", "surface.tilt_deg": 0.0, "surface.spin_deg": 0.0}
    settings |= {f"camera.{key}": value for key, value in camera.items()}
    words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
    assert here("render", "cylinder", "--out", tmp_path, *words)[0] == 0
    with np.load(tmp_path / "truth.npz") as truth:
        curvature, depth, position = (truth[name].astype(float) for name in ("curvature", "depth_mm", "position_mm"))
    np.testing.assert_allclose(curvature[..., 0], -1 / RADIUS, rtol=1e-3)
    np.testing.assert_allclose(curvature[..., 1], 0.0, atol=1e-3 / RADIUS)
    np.testing.assert_allclose(depth, np.linalg.norm(position, axis=-1), rtol=1e-5)
    # The pixels' centres lie half a pixel inside.
    x = (np.arange(SIZE) + 0.5 - SIZE / 2) / FOCAL
    along = position / position[..., 2:]
    np.testing.assert_allclose(along[..., 0], np.broadcast_to(x, (SIZE, SIZE)), atol=1e-5)
    np.testing.assert_allclose(along[..., 1], np.broadcast_to(x[:, None], (SIZE, SIZE)), atol=1e-5)


def test_a_picture_of_one_row_has_a_thumbnail():
    assert thumbnail(np.full((1, 400, 3), 7, np.uint8)).tolist() == [[[7, 7, 7]] * 160]
