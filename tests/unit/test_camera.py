"""The pinhole camera against its formula and against OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.errors import InputError
from simtest.geometry import Camera
from tests.example_counts import examples

CAMERA = Camera(640, 480, 500.0, 430.0, 331.2, 225.7, 17.0)


@settings(max_examples=examples(200), deadline=None, derandomize=True)
@given(
    st.floats(50, 2000), st.floats(50, 2000), st.floats(-500, 1500), st.floats(-500, 1500), st.floats(-50, 50),
    st.lists(st.tuples(st.floats(-2000, 3000), st.floats(-2000, 3000)), min_size=1, max_size=5),
)  # fmt: skip
def test_round_trips(fx, fy, cx, cy, skew, pixels):
    camera = Camera(640, 480, fx, fy, cx, cy, skew)
    pixels = np.array(pixels)
    rays = camera.unproject(pixels)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-14)
    assert (rays[:, 2] > 0).all()
    np.testing.assert_allclose(camera.project(rays), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.project(7.3 * rays), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.unproject(camera.project(3 * rays)), rays, atol=1e-12)


def test_projection_is_k_times_the_point():
    points = np.array([0, 0, 8]) + np.random.default_rng(0).normal(size=(50, 3))
    by_hand = points @ np.array([[500.0, 17, 331.2], [0, 430, 225.7], [0, 0, 1]]).T
    np.testing.assert_allclose(CAMERA.project(points), by_hand[:, :2] / by_hand[:, 2:], rtol=1e-14)
    np.testing.assert_array_equal(CAMERA.K, [[500, 17, 331.2], [0, 430, 225.7], [0, 0, 1]])


def test_agreement_with_opencv_after_half_a_pixel():
    """OpenCV counts a pixel's centre as an integer: c - 0.5 on export, + 0.5 on what it gives back."""
    points = np.random.default_rng(1).normal(size=(50, 3)) * [2, 2, 1] + [0, 0, 8]
    camera = Camera(640, 480, 500.0, 430.0, 331.2, 225.7)  # OpenCV knows no skew
    exported = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), exported, None)
    np.testing.assert_allclose(seen[:, 0] + 0.5, camera.project(points), atol=1e-9)
    # A picture of one bright pixel: its sightline is that of its centre.
    image = np.zeros((480, 640), np.uint8)
    image[100, 300] = 255
    x, y = cv2.minMaxLoc(image)[3]
    np.testing.assert_allclose(camera.unproject(camera.pixel_centres()[100, 300]), camera.unproject([x + 0.5, y + 0.5]))


def test_pixel_centres():
    centres = Camera(4, 3, 1.0, 1.0, 2.0, 1.5).pixel_centres()
    assert centres.shape == (3, 4, 2)
    np.testing.assert_array_equal(centres[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(centres[2, 3], [3.5, 2.5])
    # The principal point of an even image lies on a corner, of an odd one on a centre.
    np.testing.assert_allclose(Camera(5, 5, 9.0, 9.0, 2.5, 2.5).unproject([2.5, 2.5]), [0, 0, 1])
    np.testing.assert_array_equal(centres.mean(axis=(0, 1)), [2.0, 1.5])


def test_frame_is_x_right_y_down_z_forward():
    x, y, z = CAMERA.unproject([600.0, 450.0])
    assert x > 0
    assert y > 0
    assert z > 0


def test_points_behind_the_camera_have_no_pixel():
    seen = CAMERA.project([[0.0, 0, -1], [1, 1, 0], [0, 0, 2]])
    assert np.isnan(seen[:2]).all()
    np.testing.assert_allclose(seen[2], [331.2, 225.7])


def test_field_of_view():
    camera = Camera.from_fov(90.0, 400, 300)
    assert camera.fx == pytest.approx(200)
    assert camera.fy == pytest.approx(200)
    left, right = camera.unproject([[0.0, 150.0], [400.0, 150.0]])
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(90)


def test_a_matrix_round_trips():
    assert Camera.from_matrix(CAMERA.K, 640, 480) == CAMERA


def test_inside_the_image():
    inside = CAMERA.contains([[0.0, 0], [640, 480], [640.1, 5], [5, -0.1], [320, 240], [np.nan, 3]])
    assert inside.tolist() == [True, True, False, False, True, False]


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.eye(2), "shape"),
        (CAMERA.K.T, "upper triangular"),
        (2 * CAMERA.K, "upper triangular"),
        (np.diag([0.0, 1, 1]), "singular"),
        (np.diag([-5.0, 5, 1]), "singular"),
        (np.diag([np.nan, 5, 1]), "fx"),
    ],
)
def test_matrices_that_are_no_calibration_are_refused(matrix, said):
    with pytest.raises(InputError, match=said):
        Camera.from_matrix(matrix, 640, 480)


@pytest.mark.parametrize("arguments", [(0, 480, 1.0), (640, 4.5, 1.0), (640, 480, float("inf"))])
def test_cameras_that_are_none_are_refused(arguments):
    width, height, focal = arguments
    with pytest.raises(InputError, match=r"camera\."):
        Camera(width, height, focal, 1.0, 0.0, 0.0)
    with pytest.raises(InputError, match="fov"):
        Camera.from_fov(180.0, 640, 480)
