"""`simtest camera show` and `simtest camera convert`: what they print and write, and what they refuse."""

import json
import sys

import numpy as np
import pytest
from camera_texts import PHOTOMETRIC

from simtest import Camera, KannalaBrandt, Scaramuzza, ViewMask, load_calibration, load_camera, save_camera
from simtest.cli.main import main
from simtest.spec.camera_formats.files import read_poses
from simtest.spec.camera_tables import camera_summary

FISHEYE = Camera(640, 480, 200.0, 200.0, 320.0, 240.0, 0.0, KannalaBrandt(0.01))


@pytest.fixture
def here(tmp_path, monkeypatch, capsys):
    """Run commands in a folder; return exit code, output and lines of the error stream."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["simtest", "camera", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        out, err = capsys.readouterr()
        return end.value.code, out, err.splitlines()

    return run


def test_show(here, tmp_path):
    save_camera(FISHEYE, tmp_path / "cameras.txt")
    code, out, _ = here("show", "cameras.txt")
    assert code == 0
    assert "cameras.txt: COLMAP cameras.txt, 640 x 480 px" in out
    assert "fx 200, fy 200, cx 320, cy 240 px" in out
    assert "lens: kannala_brandt, k1 0.01" in out
    code, out, _ = here("show", "cameras.txt", "--json")
    told = json.loads(out)
    assert (told["format"], told["lens"], told["K"]) == ("COLMAP cameras.txt", "kannala_brandt", FISHEYE.K.tolist())
    left = told["border"][0]
    ray = FISHEYE.unproject([0.0, 240.0])
    assert left["angle_deg"] == pytest.approx(np.degrees(np.arccos(ray[2])))
    assert left["moved_px"] == pytest.approx(abs(320 - 200 * abs(ray[0]) / ray[2]))
    assert told["fov_deg"]["width"] == pytest.approx(2 * left["angle_deg"])


def test_show_what_a_lens_does_not_see():
    lens = Scaramuzza(-0.5)
    told = camera_summary(Camera(640, 480, 200.0, 200.0, 320.0, 240.0, 0.0, lens))
    corner = told["border"][-1]
    assert corner["angle_deg"] > 90
    assert corner["moved_px"] is None
    masked = camera_summary(Camera(640, 480, 200.0, 200.0, 320.0, 240.0, 0.0, None, ViewMask(320.0, 240.0, 240.0)))
    assert [each["in_view"] for each in masked["border"]] == [False, False, True, True] + [False] * 4
    assert masked["fov_deg"]["height"] == pytest.approx(2 * masked["border"][2]["angle_deg"])


def test_convert(here, tmp_path):
    save_camera(FISHEYE, tmp_path / "a.toml")
    poses = [(f"{i}.png", np.diag([1.0, -1.0, -1.0, 1.0])) for i in range(3)]
    save_camera(FISHEYE, tmp_path / "poses.json", "transforms", poses)
    for name, options in (
        ("b.yml", ()),
        ("b.xml", ("--to", "opencv")),
        ("info.yaml", ("--to", "ros")),
        ("cameras.txt", ("--poses", "poses.json")),
        ("t.json", ("--to", "transforms", "--poses", "poses.json")),
    ):
        code, out, _ = here("convert", "a.toml", "--out", name, *options)
        assert (code, out.strip()) == (0, name)
        np.testing.assert_allclose(load_camera(tmp_path / name).K, FISHEYE.K, atol=1e-12)
    for name in ("images.txt", "t.json"):
        assert [frame for frame, _ in read_poses(tmp_path / name)] == ["0.png", "1.png", "2.png"]
        np.testing.assert_allclose(read_poses(tmp_path / name)[1][1], poses[1][1], atol=1e-15)
    code, out, _ = here("convert", "cameras.txt#1", "--out", "c.toml", "--view-radius", "200", "--json")
    assert json.loads(out) == {"files": ["c.toml"]}
    assert load_camera(tmp_path / "c.toml").view_mask.radius == 200


def test_converted_poses_are_in_the_unit_that_the_new_file_states(here, tmp_path):
    save_camera(FISHEYE, tmp_path / "a.toml")
    images = "1 1 0 0 0 -0.01 0.02 -0.03 1 0.png\n\n"
    (tmp_path / "images.txt").write_text(f"# unit: m\n{images}")
    assert here("convert", "a.toml", "--out", "t.json", "--to", "transforms", "--poses", "images.txt")[0] == 0
    assert json.loads((tmp_path / "t.json").read_text())["unit"] == "mm"
    np.testing.assert_allclose(read_poses(tmp_path / "t.json")[0][1][:3, 3], [10.0, -20.0, 30.0], atol=1e-12)
    # A unit that nobody states is not made up, and neither are names of frames.
    (tmp_path / "images.txt").write_text(images)
    refused = here("convert", "a.toml", "--out", "t.json", "--to", "transforms", "--poses", "images.txt")
    assert "its unit of length is arbitrary; state it" in refused[2][0]
    (tmp_path / "tum.txt").write_text("0 0 0 0 0 0 0 1\n")
    refused = here("convert", "a.toml", "--out", "t.json", "--to", "transforms", "--poses", "tum.txt")
    assert "--poses tum.txt: names no frames" in refused[2][0]


def test_convert_with_photometry(here, tmp_path):
    save_camera(FISHEYE, tmp_path / "a.yml")
    (tmp_path / "p.xml").write_text(PHOTOMETRIC)
    assert here("convert", "a.yml", "--photometric", "p.xml", "--out", "scope.toml")[0] == 0
    made = load_calibration(tmp_path / "scope.toml")
    assert (made.response.gamma, made.priors.lights_mm) == (2.2, ((0.0, -1.0, -3.0),))
    assert made.camera.distortion == FISHEYE.distortion


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("show", "no.toml"), "no.toml: no such file"),
        (("convert", "a.toml", "--out", "b.mat"), "MATLAB has no Kannala-Brandt lens; save as TOML instead"),
        (("convert", "a.toml", "--out", "b.json", "--to", "toml"), "b.json: toml needs a file name that ends in .toml"),
        (
            ("convert", "a.toml", "--out", "b.yml", "--photometric", "p.xml"),
            "needs --to toml; no other format holds it",
        ),
        (("convert", "a.toml", "--out", "b.yml", "--poses", "p.xml"), "--poses p.xml: "),
        (
            ("convert", "a.toml", "--out", "c.toml", "--photometric", "p.xml", "--poses", "images.txt"),
            "--photometric and --poses exclude each other",
        ),
        (("convert", "a.toml#3", "--out", "b.yml"), "a.toml#3: "),
        (("convert", "a.toml", "--out", "b.toml", "--view-radius", "-1"), "view_mask.radius = -1"),
    ],
)
def test_what_is_refused_in_one_line(here, tmp_path, arguments, said):
    save_camera(FISHEYE, tmp_path / "a.toml")
    (tmp_path / "p.xml").write_text(PHOTOMETRIC)
    code, out, lines = here(*arguments)
    assert (code, out, len(lines)) == (2, "", 1)
    assert said in lines[0]
    assert {path.name for path in tmp_path.iterdir()} == {"a.toml", "p.xml"}


def test_convert_never_replaces_the_points_of_a_model(here, tmp_path):
    save_camera(FISHEYE, tmp_path / "cameras.txt", poses=[("a.png", np.eye(4))])
    save_camera(FISHEYE, tmp_path / "cameras.txt", poses=[("a.png", np.eye(4))])
    held = "# mine\n1 0 0 1 0 0 0 1 1 0\n"
    (tmp_path / "points3D.txt").write_text(held)
    images = (tmp_path / "images.txt").read_text()
    code, _, err = here("convert", "cameras.txt", "--out", "cameras.txt", "--poses", "images.txt")
    assert (code, len(err)) == (2, 1)
    assert "points3D.txt: exists and holds points" in err[0]
    assert (tmp_path / "points3D.txt").read_text() == held
    assert (tmp_path / "images.txt").read_text() == images


@pytest.mark.parametrize("name", ["images.txt", "points3D.txt"])
def test_no_camera_is_written_under_the_name_of_poses(here, tmp_path, name):
    save_camera(FISHEYE, tmp_path / "cameras.txt", poses=[("a.png", np.eye(4))])
    (tmp_path / "to").mkdir()
    code, _, err = here("convert", "cameras.txt", "--out", f"to/{name}", "--poses", "images.txt")
    assert (code, len(err)) == (2, 1)
    assert "must be cameras.txt" in err[0]
    assert not (tmp_path / "to" / name).exists()
