"""`camera.fov_deg`: the lens's field of view instead of a focal length, wherever a camera is described."""

import math

import numpy as np
import pytest

from simtest import BrownConrady, Camera, InputError, KannalaBrandt, Scaramuzza, load_calibration, load_camera
from simtest.geometry.camera import field_of_view, focal_of_view
from simtest.spec import CameraSpec, apply_settings, load_scene, scene_from_dict

LENSES = {
    "pinhole": (None, 70.0),
    "brown": ({"type": "brown_conrady", "k1": -0.2, "k2": 0.03}, 80.0),
    "equidistant": ({"type": "kannala_brandt"}, 170.0),
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
    assert CameraSpec(width=640, height=480, fov_deg=70.0).model() == Camera.from_fov(70.0, 640, 480)
    # Equidistant: r = f theta. A 140 deg lens over 640 px has f = 320 / 70 deg.
    assert CameraSpec(width=640, height=480, fov_deg=140.0, distortion={"type": "kannala_brandt"}).fx == pytest.approx(
        320 / math.radians(70)
    )
    # Not that of the pinhole with the same K.
    assert field_of_view(Camera(640, 480, 260.0, 260.0, 320.0, 240.0, 0.0, KannalaBrandt())) == pytest.approx(
        math.degrees(640 / 260)
    )
    # Off centre: the angles of both sides add up.
    focal = focal_of_view(90.0, (400, 300), (100.0, 150.0))
    assert math.atan(100 / focal) + math.atan(300 / focal) == pytest.approx(math.pi / 2, rel=1e-12)
    for lens in (None, BrownConrady(-0.1), Scaramuzza(-0.3)):
        assert focal_of_view(60.0, (400, 300), (210.0, 140.0), lens, "diagonal") > 0


def refused(table, fragment):
    with pytest.raises(InputError) as caught:
        scene_from_dict({"surface": {"type": "plane"}, "camera": table})
    assert "\n" not in str(caught.value)
    assert fragment in str(caught.value)


def test_what_is_refused():
    refused(
        {"fov_deg": 180.0}, "fov_deg = 180: this lens cannot span that angle across the width; must be below 180 deg"
    )
    refused({"fov_deg": 70.0, "fx": 300.0}, "fov_deg and fx exclude each other; give one of them")
    refused({"fov_deg": 70.0, "fx": 300.0, "fy": 300.0}, "fov_deg and fx and fy exclude each other")
    refused({"fov_of": "diagonal"}, "fov_of = 'diagonal': needs fov_deg")
    refused({"fov_deg": 70.0, "fov_of": "side"}, "camera.fov_of")
    refused({"fov_deg": 70.0, "skew": 1.0}, "skew = 1: must be 0 with fov_deg")
    refused({"fov_deg": 0.0}, "camera.fov_deg")
    refused({"fov_deg": "wide"}, "camera.fov_deg")
    # The barrel lens folds over at 42 deg.
    refused({"fov_deg": 120.0, "distortion": {"type": "brown_conrady", "k1": -0.4}}, "must be below 84.78 deg")


def test_files_and_settings(tmp_path):
    path = tmp_path / "scope.toml"
    path.write_text('[camera]\nwidth = 640\nheight = 480\nfov_deg = 140.0\nfov_of = "diagonal"\n'
                    'distortion = {type = "kannala_brandt"}\n[rig]\ndistance_mm = 30.0\n')  # fmt: skip
    camera = load_camera(path)
    assert camera.fx == pytest.approx(400 / math.radians(70))
    assert load_calibration(path).camera == camera
    path.write_text("width = 640\nheight = 480\n")
    with pytest.raises(InputError, match="fx: missing; a camera needs width, height, and fx and fy or fov_deg"):
        load_camera(path)
    # A setting replaces the focal length of the file, and the other way round.
    told = {"surface": {"type": "plane"}, "camera": {"width": 640, "height": 480, "fx": 300.0, "fy": 300.0}}
    path.write_text(
        '[surface]\ntype = "plane"\n[camera]\nwidth = 640\nheight = 480\nfx = 300.0\nfy = 300.0\n', encoding="utf-8"
    )
    scene = load_scene(path, {"camera.fov_deg": 70.0})
    assert scene.camera.model() == Camera.from_fov(70.0, 640, 480)
    back = load_scene(path, {"camera.fov_deg": 70.0, "camera.fov_of": "height"})
    assert field_of_view(back.camera.model(), "height") == pytest.approx(70.0)
    assert apply_settings(told, {"camera.fx": 5.0}, "x")["camera"]["fx"] == 5.0
    path.write_text('[surface]\ntype = "plane"\n[camera]\nwidth = 640\nheight = 480\nfov_deg = 50.0\n')
    assert load_scene(path, {"camera.fx": 321.0, "camera.fy": 322.0}).camera.fx == 321.0


def test_a_scene_that_is_written_reads_back():
    scene = scene_from_dict({"surface": {"type": "plane"}, "camera": {"fov_deg": 65.0, "width": 100, "height": 90}})
    dumped = scene.model_dump(mode="json")
    assert "fx" not in dumped["camera"]
    assert dumped["camera"]["fov_deg"] == 65.0
    assert scene_from_dict(dumped).camera.model() == scene.camera.model()
    # A camera without it is written as before.
    plain = scene_from_dict({"surface": {"type": "plane"}}).model_dump(mode="json")
    assert not {"fov_deg", "fov_of"} & set(plain["camera"])
    np.testing.assert_allclose([plain["camera"]["fx"], plain["camera"]["fy"]], 406.0)
