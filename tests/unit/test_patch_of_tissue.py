"""`simtest reconstruct --poses --patch` on a rendered film: base's normal and fine normals of a patch."""

import json
import sys

import cv2
import numpy as np
import pytest

from simtest.cli.main import main
from simtest.errors import Failure, InputError
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.accumulation import COLUMNS, accumulate, parse_patch, write_patch
from simtest.reconstruction.picture import Options
from simtest.rendering import Session
from simtest.simulation.rendered_view import render_picture
from simtest.spec import scene_from_dict

CALIBRATION = """
[camera]
width = 240
height = 240
fx = 220.0
fy = 220.0
[response]
type = "linear"
[rig]
lights_mm = [[0.0, 0.0, 0.0]]
distance_mm = 20.5
distance_sd_mm = 0.5
[surface]
phong_exponent = 1600.0
"""
PATCH = "120,120,7"
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Render twelve frames of a plane with relief of 4 deg, tilted by 12 deg; return the folder."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "frames").mkdir()
    session, poses = None, []
    for i in range(12):
        r, angle = 5 * np.sqrt(i / 11), 2.4 * i
        scene = scene_from_dict(
            {
                "surface": {"type": "plane", "distance_mm": 20.0, "tilt_deg": 12.0, "azimuth_deg": 40.0,
                            "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}], "seed": 77}},
                "reflectance": {"type": "phong", "exponent": 1600.0, "diffuse": 0.02},
                "camera": {"width": 240, "height": 240, "fx": 220.0, "fy": 220.0,
                           "moved": {"translation_mm": [float(r * np.cos(angle)), float(r * np.sin(angle)), 0.0]}},
                "sensor": {"noise_sigma": 0.01, "seed": i, "exposure": {"percentile": 99.5}},
            }
        )  # fmt: skip
        session = session or Session(scene)
        picture = np.clip(render_picture(session, scene), 0, 1)
        poses.append(
            {"frame": f"{i:03d}.png", "world_from_camera": np.array(session.surface.model_from_camera).tolist()}
        )
        assert cv2.imwrite(str(folder / "frames" / f"{i:03d}.png"), (picture * 65535).astype(np.uint16))
    (folder / "poses.json").write_text(
        json.dumps({"translation_error": 0.005, "rotation_error_deg": 0.1, "frames": poses})
    )
    (folder / "camera.toml").write_text(CALIBRATION)
    return folder


def options(folder, poses="poses.json", camera="camera.toml"):
    return Options(folder / camera, poses=folder / poses)


def test_base_and_fine_normals_of_a_patch(film, tmp_path):
    made = accumulate(film / "frames", options(film), parse_patch(PATCH))
    assert made.frames == 12
    base = made.base
    # One film: 99.9 % of chi-squared with two degrees of freedom.
    assert base.squared_mahalanobis(UP) < 13.8
    assert angle_deg(base.normal, UP) < 1.5
    assert np.degrees(base.slope) == pytest.approx(4.0, rel=0.3)
    assert set(base.budget) == {"relief", "poses", "distance"}
    # What the plane assumes, 12 deg off, is no evidence.
    assert angle_deg(made.plane.normal, UP) == pytest.approx(12.0, abs=0.1)
    files = write_patch(tmp_path / "made", made)
    told = json.loads(files[0].read_text())
    assert told["status"] == "ok"
    np.testing.assert_allclose(told["covariance_rad2"], base.covariance)
    rows = np.loadtxt(files[1], delimiter=",", skiprows=1)
    assert files[1].read_text().startswith(",".join(COLUMNS))
    np.testing.assert_allclose(rows[:, 4:], made.fine.normal, atol=1e-12)
    raster = np.load(files[2])
    assert raster.shape == (64, 64, 3)
    assert raster.dtype == np.float32
    known = np.isfinite(raster[..., 0])
    assert 50 < known.sum() <= len(rows)
    np.testing.assert_allclose(np.linalg.norm(raster[known], axis=1), 1, atol=1e-6)
    # Fine normals scatter about the base by the relief's slope, not by less than half of it.
    assert 2.0 < np.degrees(np.std(made.fine.normal[:, :2])) < 8.0


def test_wrong_poses_are_seen(film, tmp_path):
    """Negative control: with x and y of the camera reversed no base is found, or another one."""
    told = json.loads((film / "poses.json").read_text())
    for entry in told["frames"]:
        entry["world_from_camera"] = (np.array(entry["world_from_camera"]) @ np.diag([-1.0, -1, 1, 1])).tolist()
    (film / "turned.json").write_text(json.dumps(told))
    made = accumulate(film / "frames", options(film, "turned.json"), parse_patch(PATCH))
    assert isinstance(made.base, Failure) or angle_deg(made.base.normal, UP) > 5
    assert ("no normal" in made.summary) == isinstance(made.base, Failure)
    assert json.loads(write_patch(tmp_path, made)[0].read_text())["frames"] == 12


@pytest.mark.parametrize("text", ["", "1,2", "1,2,3,4", "a,b,c", "10,10,0", "10,10,-2", "10,nan,2", "10,10,1e9"])
def test_malformed_patches_are_told(text):
    with pytest.raises(InputError, match=r"--patch .*: must be x,y,radius"):
        parse_patch(text)


def test_what_is_missing_is_told(film):
    patch = parse_patch(PATCH)
    with pytest.raises(InputError, match="--patch: needs --camera and --poses"):
        accumulate(film / "frames", Options(film / "camera.toml"), patch)
    with pytest.raises(InputError, match="--patch 300,10: lies outside the view; must be in 240 x 240"):
        accumulate(film / "frames", options(film), parse_patch("300,10,5"))
    for key, name in (("distance", "rig.distance_mm"), ("lights", "rig.lights_mm")):
        lines = [line for line in CALIBRATION.splitlines() if not line.startswith(key)]
        (film / "less.toml").write_text("\n".join(lines))
        with pytest.raises(InputError, match=rf"less.toml: --patch needs {name}"):
            accumulate(film / "frames", options(film, camera="less.toml"), patch)
    (film / "other.toml").write_text(CALIBRATION.replace("240", "200"))
    with pytest.raises(
        InputError, match=r"no frame with a pose could be read \(a picture of 240 x 240; must be 200 x 200"
    ):
        accumulate(film / "frames", options(film, camera="other.toml"), patch)


def command(monkeypatch, film, *more):
    """Return the exit status of the command on the film."""
    told = ["reconstruct", film / "frames", "--camera", film / "camera.toml", "--patch", PATCH, "--out", film / "out"]
    monkeypatch.setattr(sys, "argv", ["simtest", *map(str, [*told, *more])])
    try:
        main()
    except SystemExit as ended:
        return ended.code or 0
    return 0


def test_a_patch_takes_poses(film, monkeypatch, capsys):
    assert command(monkeypatch, film) != 0
    assert "--patch: needs --poses" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_writes_the_patch(film, monkeypatch, capsys):
    assert command(monkeypatch, film, "--poses", film / "poses.json") == 0
    assert "patch: normal of the base" in capsys.readouterr().out
    assert {"patch.json", "fine_normals.csv", "fine_normals.npy"} <= {file.name for file in (film / "out").iterdir()}
