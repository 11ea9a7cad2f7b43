"""View masks with cut corners: geometry, camera files and the renderer agree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon

from simtest.errors import InputError
from simtest.geometry import Camera, ViewMask
from simtest.rendering import Session
from simtest.spec import load_camera, load_scene, save_camera
from tests.example_counts import examples

SIZE = {"width": 120, "height": 100, "fx": 400.0, "fy": 400.0}
SHAPES = {"corner": 30.0, "half_height": 40.0}


@given(
    st.floats(5, 100),
    st.floats(5, 100),
    st.floats(0, 1),
    st.lists(st.tuples(st.floats(-120, 120), st.floats(-120, 120)), min_size=1, max_size=50),
)
@settings(max_examples=examples(100), deadline=None)
def test_contains_is_the_polygon_of_the_outline(half_width, half_height, cut, points):
    mask = ViewMask(3.0, -2.0, half_width, cut * min(half_width, half_height), half_height)
    points = np.array(points)
    polygon = mask.outline(2)
    clear = Polygon(polygon).contains_points(points, radius=1e-6) == Polygon(polygon).contains_points(
        points, radius=-1e-6
    )
    expected = Polygon(polygon).contains_points(points)
    np.testing.assert_array_equal(mask.contains(points)[clear], expected[clear])


def test_a_regular_octagon_has_sides_of_one_length():
    mask = ViewMask(0.0, 0.0, 10.0, (2 - np.sqrt(2)) * 10.0)
    corners = mask.outline(2)[::2]
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    np.testing.assert_allclose(lengths, lengths[0])


def test_cuts_of_no_length_leave_a_rectangle():
    mask = ViewMask(0.0, 0.0, 10.0, 0.0, 5.0)
    assert mask.contains([[10, 5], [-10, -5], [9.9, -4.9]]).all()
    assert not mask.contains([[10.1, 0], [0, 5.1]]).any()


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"corner": -1.0}, "view_mask.corner = -1.0: must lie between 0 and 10"),
        ({"corner": 11.0}, "view_mask.corner = 11.0"),
        ({"half_height": 5.0}, "view_mask.half_height = 5.0: needs corner"),
        ({"corner": 1.0, "half_height": 0.0}, "view_mask.half_height = 0.0: must be > 0"),
        ({"corner": float("nan")}, "view_mask.corner"),
    ],
)
def test_malformed_masks_are_named(keys, words):
    with pytest.raises(InputError, match=words):
        ViewMask(0.0, 0.0, 10.0, **keys)


def test_camera_files(tmp_path):
    camera = Camera(120, 100, 90.0, 90.0, 60.0, 50.0, view_mask=ViewMask(60.0, 50.0, 55.0, **SHAPES))
    save_camera(camera, tmp_path / "c.toml")
    assert load_camera(tmp_path / "c.toml") == camera
    with pytest.raises(InputError, match="OpenCV and ROS know round views alone; must be left out, or saved as TOML"):
        save_camera(camera, tmp_path / "c.yml")


@pytest.mark.parametrize("samples", [1, 4])
@pytest.mark.parametrize("distortion", [None, {"type": "brown_conrady", "k1": -0.1}])
def test_the_renderer_sees_what_the_camera_says(samples, distortion):
    mask = {"radius": 55.0, **SHAPES}
    scene = load_scene(
        "plane",
        {
            "camera": {
                **SIZE,
                "view_mask": mask,
                "distortion": distortion,
            },
            "render.samples_per_pixel": samples,
        },
    )
    session = Session(scene)
    frame = session.frame()
    np.testing.assert_array_equal(frame.radiance.total > 0, session.camera.seen)
    np.testing.assert_array_equal(np.isfinite(frame.labels.depth), session.camera.seen)
    np.testing.assert_array_equal(session.truth().mask, session.camera.seen)
