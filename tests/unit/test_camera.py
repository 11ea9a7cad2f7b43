"""The camera: K and half pixels, its field of view, and masks of what it sees."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon

from simtest import BrownConrady, Camera, InputError, KannalaBrandt, Scaramuzza, ViewMask, load_calibration, load_camera
from simtest.geometry.camera import field_of_view, focal_of_view
from simtest.rendering import Session
from simtest.spec import CameraSpec, load_scene, save_camera, scene_from_dict
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
    np.testing.assert_allclose(camera.project(7.3 * rays), pixels, atol=1e-8)
    np.testing.assert_allclose(camera.unproject(camera.project(3 * rays)), rays, atol=1e-12)


def test_projection_is_k_times_the_point():
    points = np.array([0, 0, 8]) + np.random.default_rng(0).normal(size=(50, 3))
    by_hand = points @ np.array([[500.0, 17, 331.2], [0, 430, 225.7], [0, 0, 1]]).T
    np.testing.assert_allclose(CAMERA.project(points), by_hand[:, :2] / by_hand[:, 2:], rtol=1e-14)
    assert Camera.from_matrix(CAMERA.K, 640, 480) == CAMERA


def test_agreement_with_opencv_after_half_a_pixel():
    """OpenCV counts a pixel's centre as an integer: c - 0.5 on export, + 0.5 on what it gives back."""
    points = np.random.default_rng(1).normal(size=(50, 3)) * [2, 2, 1] + [0, 0, 8]
    camera = Camera(640, 480, 500.0, 430.0, 331.2, 225.7)  # OpenCV knows no skew
    exported = camera.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    seen, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), exported, None)
    np.testing.assert_allclose(seen[:, 0] + 0.5, camera.project(points), atol=1e-9)


def test_pixel_centres():
    centres = Camera(4, 3, 1.0, 1.0, 2.0, 1.5).pixel_centres()
    assert centres.shape == (3, 4, 2)
    np.testing.assert_array_equal(centres[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(centres[2, 3], [3.5, 2.5])


def test_points_behind_the_camera_have_no_pixel():
    seen = CAMERA.project([[0.0, 0, -1], [1, 1, 0], [0, 0, 2]])
    assert np.isnan(seen[:2]).all()
    np.testing.assert_allclose(seen[2], [331.2, 225.7])


def test_inside_the_image():
    inside = CAMERA.contains([[0.0, 0], [640, 480], [640.1, 5], [5, -0.1], [320, 240], [np.nan, 3]])
    assert inside.tolist() == [True, True, False, False, True, False]


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (np.eye(2), "shape"),
        (CAMERA.K.T, "upper triangular"),
        (2 * CAMERA.K, "upper triangular"),
        (np.diag([-5.0, 5, 1]), "singular"),
        (np.diag([np.nan, 5, 1]), "fx"),
    ],
)
def test_matrices_that_are_no_calibration_are_refused(matrix, said):
    with pytest.raises(InputError, match=said):
        Camera.from_matrix(matrix, 640, 480)


@pytest.mark.parametrize(("width", "height", "focal"), [(0, 480, 1.0), (640, 4.5, 1.0), (640, 480, float("inf"))])
def test_cameras_that_are_none_are_refused(width, height, focal):
    with pytest.raises(InputError, match=r"camera\."):
        Camera(width, height, focal, 1.0, 0.0, 0.0)


# Field of view ---------------------------------------------------------------------------------------------------

LENSES = {
    "pinhole": (None, 70.0),
    "brown": ({"type": "brown_conrady", "k1": -0.2, "k2": 0.03}, 80.0),
    "fisheye": ({"type": "kannala_brandt", "k1": -0.03}, 150.0),
    "omni": ({"type": "scaramuzza", "k2": -0.4, "d": 0.01, "e": -0.02}, 140.0),
}


@pytest.mark.parametrize("across", ["width", "height", "diagonal"])
@pytest.mark.parametrize("lens", LENSES)
def test_the_angle_is_that_of_the_model(lens, across):
    """The two ends of the extent, through the lens, are as far apart as stated."""
    table, fov = LENSES[lens]
    spec = CameraSpec(width=640, height=480, fov_deg=fov, fov_of=across, distortion=table)
    camera = spec.model()
    ends = {"width": [[0, 240], [640, 240]], "height": [[320, 0], [320, 480]], "diagonal": [[0, 0], [640, 480]]}[across]
    first, second = camera.unproject(ends)
    apart = sum(math.degrees(math.atan2(math.hypot(*ray[:2]), ray[2])) for ray in (first, second))
    assert apart == pytest.approx(fov, abs=1e-9)
    assert field_of_view(camera, across) == pytest.approx(fov, abs=1e-9)
    assert camera.fx == camera.fy


def test_known_fields_of_view():
    assert Camera.from_fov(90.0, 400, 300).fx == Camera.from_fov(90.0, 400, 300).fy == pytest.approx(200)
    assert CameraSpec(width=640, height=480, fov_deg=70.0).model() == Camera.from_fov(70.0, 640, 480)
    # Equidistant: r = f theta. A 140 deg lens over 640 px has f = 320 / 70 deg.
    equidistant = CameraSpec(width=640, height=480, fov_deg=140.0, distortion={"type": "kannala_brandt"})
    assert equidistant.fx == pytest.approx(320 / math.radians(70))
    # Not that of the pinhole with the same K.
    same = Camera(640, 480, 260.0, 260.0, 320.0, 240.0, 0.0, KannalaBrandt())
    assert field_of_view(same) == pytest.approx(math.degrees(640 / 260))
    # Off centre: the angles of both sides add up.
    focal = focal_of_view(90.0, (400, 300), (100.0, 150.0))
    assert math.atan(100 / focal) + math.atan(300 / focal) == pytest.approx(math.pi / 2, rel=1e-12)
    for lens in (None, BrownConrady(-0.1), Scaramuzza(-0.3)):
        assert focal_of_view(60.0, (400, 300), (210.0, 140.0), lens, "diagonal") > 0
    with pytest.raises(InputError, match="fov"):
        Camera.from_fov(180.0, 640, 480)


def test_files_and_settings(tmp_path):
    path = tmp_path / "scope.toml"
    path.write_text('[camera]\nwidth = 640\nheight = 480\nfov_deg = 140.0\nfov_of = "diagonal"\n'
                    'distortion = {type = "kannala_brandt"}\n[rig]\ndistance_mm = 30.0\n')  # fmt: skip
    camera = load_camera(path)
    assert camera.fx == pytest.approx(400 / math.radians(70))
    assert load_calibration(path).camera == camera
    # A setting replaces the focal length of the file, and the other way round.
    plane = '[surface]\ntype = "plane"\n[camera]\nwidth = 640\nheight = 480\n'
    path.write_text(plane + "fx = 300.0\nfy = 300.0\n")
    assert load_scene(path, {"camera.fov_deg": 70.0}).camera.model() == Camera.from_fov(70.0, 640, 480)
    back = load_scene(path, {"camera.fov_deg": 70.0, "camera.fov_of": "height"})
    assert field_of_view(back.camera.model(), "height") == pytest.approx(70.0)
    path.write_text(plane + "fov_deg = 50.0\n")
    assert load_scene(path, {"camera.fx": 321.0, "camera.fy": 322.0}).camera.fx == 321.0


def test_a_scene_that_is_written_reads_back():
    scene = scene_from_dict({"surface": {"type": "plane"}, "camera": {"fov_deg": 65.0, "width": 100, "height": 90}})
    dumped = scene.model_dump(mode="json")
    assert "fx" not in dumped["camera"]
    assert dumped["camera"]["fov_deg"] == 65.0
    assert scene_from_dict(dumped).camera.model() == scene.camera.model()
    # A camera without it is written by its focal lengths.
    plain = scene_from_dict({"surface": {"type": "plane"}}).model_dump(mode="json")
    assert not {"fov_deg", "fov_of"} & set(plain["camera"])
    np.testing.assert_allclose([plain["camera"]["fx"], plain["camera"]["fy"]], 406.0)


# Masks -----------------------------------------------------------------------------------------------------------

SHAPES = {"corner": 30.0, "half_height": 40.0}


def test_a_round_mask():
    camera = Camera(8, 6, 9.0, 9.0, 4.0, 3.0, view_mask=ViewMask(4.0, 3.0, 2.0))
    assert camera.seen.sum() == 12  # 4 x 4 centres less the corners
    assert camera.contains([[4.0, 3.0], [4.0, 5.1], [6.0, 3.0]]).tolist() == [True, False, True]
    # The lens goes on outside.
    assert np.isfinite(camera.unproject([0.0, 0.0])).all()
    assert Camera(8, 6, 9.0, 9.0, 4.0, 3.0).seen is None
    with pytest.raises(InputError, match="must cover a pixel"):
        Camera(8, 6, 9.0, 9.0, 4.0, 3.0, view_mask=ViewMask(40.0, 3.0, 2.0))


@given(
    st.floats(5, 100),
    st.floats(5, 100),
    st.floats(0, 1),
    st.lists(st.tuples(st.floats(-120, 120), st.floats(-120, 120)), min_size=1, max_size=50),
)
@settings(max_examples=examples(100), deadline=None)
def test_cut_corners_are_the_polygon_of_the_outline(half_width, half_height, cut, points):
    mask = ViewMask(3.0, -2.0, half_width, cut * min(half_width, half_height), half_height)
    polygon, points = Polygon(mask.outline(2)), np.array(points)
    clear = polygon.contains_points(points, radius=1e-6) == polygon.contains_points(points, radius=-1e-6)
    np.testing.assert_array_equal(mask.contains(points)[clear], polygon.contains_points(points)[clear])


def test_a_regular_octagon_has_sides_of_one_length():
    mask = ViewMask(0.0, 0.0, 10.0, (2 - np.sqrt(2)) * 10.0)
    corners = mask.outline(2)[::2]
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    np.testing.assert_allclose(lengths, lengths[0])


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"radius": 0.0}, "view_mask.radius = 0.0: must be > 0"),
        ({"corner": -1.0}, "view_mask.corner = -1.0: must lie between 0 and 10"),
        ({"corner": 11.0}, "view_mask.corner = 11.0"),
        ({"half_height": 5.0}, "view_mask.half_height = 5.0: needs corner"),
        ({"corner": 1.0, "half_height": 0.0}, "view_mask.half_height = 0.0: must be > 0"),
        ({"corner": float("nan")}, "view_mask.corner"),
        ({"cy": "3"}, r"view_mask\.cy = .*: must be a finite number"),
    ],
)
def test_malformed_masks_are_named(keys, words):
    with pytest.raises(InputError, match=words):
        ViewMask(**{"cx": 0.0, "cy": 0.0, "radius": 10.0, **keys})


def test_cut_corners_in_camera_files(tmp_path):
    camera = Camera(120, 100, 90.0, 90.0, 60.0, 50.0, view_mask=ViewMask(60.0, 50.0, 55.0, **SHAPES))
    save_camera(camera, tmp_path / "c.toml")
    assert load_camera(tmp_path / "c.toml") == camera


@pytest.mark.render
@pytest.mark.parametrize(("samples", "k1"), [(1, 0.0), (4, 0.0), (1, -0.1), (4, -0.1)])
def test_the_renderer_sees_what_the_camera_says(samples, k1):
    mask = {"radius": 55.0, **SHAPES}
    camera = {"width": 120, "height": 100, "fx": 400.0, "fy": 400.0, "view_mask": mask}
    if k1:
        camera["distortion"] = {"type": "brown_conrady", "k1": k1}
    session = Session(load_scene("plane", {"camera": camera, "render.samples_per_pixel": samples}))
    frame = session.frame()
    np.testing.assert_array_equal(frame.radiance.total > 0, session.camera.seen)
    np.testing.assert_array_equal(np.isfinite(frame.labels.depth), session.camera.seen)
    np.testing.assert_array_equal(session.truth().mask, session.camera.seen)
