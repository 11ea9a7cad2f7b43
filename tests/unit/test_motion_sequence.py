"""`simtest reconstruct --poses` on rendered sequences: convex from concave, and what wrong poses come to."""

import csv
import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from simtest.errors import InputError
from simtest.reconstruction.options import Options
from simtest.reconstruction.sequence import reconstruct_sequence
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import scene_from_dict
from tests.marked import marked

CALIBRATION = """
[camera]
width = 320
height = 320
fx = 320.0
fy = 320.0
[response]
type = "linear"
[vignetting]
type = "cosine"
power = 0.0
[emission]
type = "cosine"
power = 0.0
[rig]
lights_mm = [[0.0, 0.0, 0.0]]
distance_mm = 10.0
distance_sd_mm = 0.5
[surface]
phong_exponent = 50.0
# the frames are rendered
[uncertainty]
light_floor_mm = 0.0
light_floor_deg = 0.0
distance_floor = 0.0
feature_floor_deg = 0.0
response_floor = 0.0
near_miss_floor_deg = 0.0
off_peak = 0.0
"""
# d k, the camera's steps, mm, and what must be told; beyond its centre a highlight runs ahead of the camera.
SHAPES = {
    "convex": ((0.6, 0.2), 0.3, "convex"),
    "concave": ((-2.4, -3.5), 0.06, "concave"),
    "saddle": ((0.6, -0.5), 0.1, "saddle"),
}
PLACES = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.5)]


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Return a function from a shape to the options that reconstruct its rendered frames, and their folder."""
    made, held = {}, []

    def render(name):
        if name in made:
            return made[name]
        folder = tmp_path_factory.mktemp(name)
        frames = folder / "frames"
        frames.mkdir()
        (kd_1, kd_2), step, _ = SHAPES[name]
        surface = {"type": "quadric", "k1_per_mm": kd_1 / 10, "k2_per_mm": kd_2 / 10, "tilt_deg": 3.0, "spin_deg": 20.0}
        listed = []
        for i, place in enumerate(PLACES):
            moved = {"translation_mm": [step * place[0], step * place[1], 0.0], "rotation_deg": [0.2 * i, 0.0, 0.5 * i]}
            scene = scene_from_dict({
                "surface": surface,
                "camera": {"width": 320, "height": 320, "fx": 320.0, "fy": 320.0, "moved": moved},
                "sensor": {"noise_sigma": 0.02, "saturation": True, "exposure": {"gain": 0.9}},
            })  # fmt: skip
            if not held:
                held.append(Session(scene))
            frame = np.clip(render_view(held[0], scene).frame(9100 + i), 0, 1)
            cv2.imwrite(str(frames / f"{i}.png"), np.round(frame * 65535).astype(np.uint16))
            listed.append({"frame": f"{i}.png", "world_from_camera": held[0].surface.model_from_camera.tolist()})
        (folder / "camera.toml").write_text(CALIBRATION)
        table = {"frames": listed, "translation_error": 0.0, "rotation_error_deg": 0.01}
        (folder / "poses.json").write_text(json.dumps(table))
        made[name] = folder, Options(folder / "camera.toml", poses=folder / "poses.json")
        return made[name]

    return render


def with_poses(made, tmp_path, change):
    """Return options whose file of poses holds those of `film`, each changed."""
    folder, options = made
    told = json.loads((folder / "poses.json").read_text())
    for entry in told["frames"]:
        entry["world_from_camera"] = change(np.array(entry["world_from_camera"])).tolist()
    path = tmp_path / "poses.json"
    path.write_text(json.dumps(told))
    return folder / "frames", replace(options, poses=path)


def shapes_in(folder):
    with (folder / "timeline.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {(row["frame"], row["specularity"]): (row["bend_1"], row["bend_2"]) for row in rows}, rows


@pytest.mark.render
@pytest.mark.parametrize("name", marked(SHAPES, ci=["convex", "concave"]))
def test_a_sequence_with_poses_tells_the_shape(film, name, tmp_path):
    folder, options = film(name)
    made = reconstruct_sequence(folder / "frames", tmp_path / "out", options)
    expected = SHAPES[name][2]
    bends, rows = shapes_in(tmp_path / "out")
    assert len(bends) == len(PLACES)
    wanted = {"convex": {("convex", "convex")}, "concave": {("concave", "concave")},
              "saddle": {("concave", "convex"), ("convex", "concave")}}[name]  # fmt: skip
    assert set(bends.values()) <= wanted
    assert all(float(row["margin_1"]) > 9.2 for row in rows if row["motion"] == "ok")
    entry = json.loads((tmp_path / "out" / "frames" / "000000.json").read_text())["specularities"][0]["motion"]
    assert entry["shape"] == expected
    assert entry["fits"]
    (track,) = json.loads((tmp_path / "out" / "tracks.json").read_text())
    assert track["shapes"] == [expected] * len(PLACES)
    assert f"{expected}, 4 of 4" in (tmp_path / "out" / "index.html").read_text()
    assert made.motion.startswith(f"bends of 4 highlights: 4 {expected}; 0 fit no curvature")
    assert "\n" not in made.motion


@pytest.mark.render
def test_a_picture_that_the_poses_do_not_name_is_passed_over(film, tmp_path):
    """The folder of `simtest views` holds a contact sheet of another size, which comes before its frames."""
    folder, options = film("convex")
    named = json.loads((folder / "poses.json").read_text())
    (tmp_path / "frames").mkdir()
    for entry in named["frames"]:
        name = f"view_{entry['frame']}"
        shutil.copy(folder / "frames" / entry["frame"], tmp_path / "frames" / name)
        entry["frame"] = name
    cv2.imwrite(str(tmp_path / "frames" / "sheet.png"), np.zeros((40, 60), np.uint8))
    options = replace(options, poses=tmp_path / "poses.json")
    options.poses.write_text(json.dumps(named))
    with pytest.warns(UserWarning, match=r"frame 0: sheet\.png: frame is 60 x 40 px: must be 320 x 320"):
        made = reconstruct_sequence(tmp_path / "frames", tmp_path / "out", options)
    assert (made.failed, made.not_named) == (1, 1)
    assert made.motion.startswith("bends of 4 highlights: 4 convex")
    # One that the poses name is refused: the camera is not that of the frames.
    named["frames"].append({"frame": "sheet.png", "world_from_camera": np.eye(4).tolist()})
    options.poses.write_text(json.dumps(named))
    with pytest.raises(InputError, match=r"of another size: sheet\.png \(60 x 40\)"):
        reconstruct_sequence(tmp_path / "frames", tmp_path / "refused", options)


@pytest.mark.render
def test_wrong_poses_tell_nothing_wrong(film, tmp_path):
    """Negative control: poses of the mirrored motion fit no curvature, or leave the signs open."""
    folder, _ = film("saddle")
    first = np.array(json.loads((folder / "poses.json").read_text())["frames"][0]["world_from_camera"])

    def mirrored(T):
        T[:3, 3] = 2 * first[:3, 3] - T[:3, 3]
        return T

    frames, wrong = with_poses(film("saddle"), tmp_path, mirrored)
    made = reconstruct_sequence(frames, tmp_path / "out", wrong)
    bends, rows = shapes_in(tmp_path / "out")
    assert "4 fit no curvature" in made.motion
    assert made.motion.splitlines()[1:] == [
        "most fit no curvature: are the poses world_from_camera, in mm, of these frames?"
    ]
    assert all(row["sign_1"] == row["sign_2"] == "0" for row in rows)
    # What one picture tells without any motion stays: an abs(1 + d k) below 1 is concave.
    assert all("convex" not in each for each in bends.values())


@pytest.mark.render
@pytest.mark.parametrize(
    ("factor", "told"), [(1e-3, "motions are 3e-05 to"), (1e3, "of the distance, and 0.002 to 0.2")]
)
def test_poses_in_the_wrong_unit_are_told(film, tmp_path, factor, told):
    frames, wrong = with_poses(film("convex"), tmp_path, lambda T: np.block([[T[:3, :3], factor * T[:3, 3:]], [T[3:]]]))
    made = reconstruct_sequence(frames, tmp_path / "out", wrong)
    (line,) = made.motion.splitlines()[1:]
    assert told in line
    assert line.endswith("are needed: is the unit of the poses right?")


@pytest.mark.render
@pytest.mark.parametrize("name", list(SHAPES))
def test_poses_with_the_axes_of_opengl_are_told(film, tmp_path, name):
    """On right poses, `test_a_sequence_with_poses_tells_the_shape` asserts that nothing is said."""
    frames, wrong = with_poses(film(name), tmp_path, lambda T: T @ np.diag([1.0, -1, -1, 1]))
    made = reconstruct_sequence(frames, tmp_path / "out", wrong)
    assert "fit clearly better with y and z of the camera reversed" in made.motion.splitlines()[1]


@pytest.mark.render
def test_a_stopped_run_with_poses_goes_on_to_the_same_files(film, tmp_path):
    folder, options = film("convex")
    reconstruct_sequence(folder / "frames", tmp_path / "out", options)
    before = (tmp_path / "out" / "timeline.csv").read_bytes()
    (tmp_path / "out" / "frames" / "000002.json").unlink()
    reconstruct_sequence(folder / "frames", tmp_path / "out", options)
    assert (tmp_path / "out" / "timeline.csv").read_bytes() == before


@pytest.mark.render
def test_what_the_method_needs_is_asked_for_before_the_work(film, tmp_path):
    folder, options = film("convex")
    lines = {
        "distance": "distance_mm = 10.0\ndistance_sd_mm = 0.5\n", "lobe": "phong_exponent = 50.0\n",
        "lights at the camera": "lights_mm = [[0.0, 0.0, 0.0]]\n",
    }  # fmt: skip
    for words, line in lines.items():
        camera = tmp_path / "camera.toml"
        camera.write_text(CALIBRATION.replace(line, ""))
        with pytest.raises(InputError, match=words):
            reconstruct_sequence(folder / "frames", tmp_path / "out", replace(options, camera=camera))
    with pytest.raises(InputError, match="give --camera"):
        reconstruct_sequence(folder / "frames", tmp_path / "out", replace(options, camera=None, fov_deg=50.0))
    few = tmp_path / "few.json"
    few.write_text(json.dumps([np.eye(4).tolist()]))
    with pytest.raises(InputError, match="1 poses; must be one for each of the 4 frames"):
        reconstruct_sequence(folder / "frames", tmp_path / "out", replace(options, poses=few))
    # More poses than frames: nobody says which of them are meant.
    few.write_text(json.dumps([np.eye(4).tolist()] * 5))
    with pytest.raises(InputError, match="5 poses of frames without names; must be one for each of the 4 frames"):
        reconstruct_sequence(folder / "frames", tmp_path / "out", replace(options, poses=few))
    assert not (tmp_path / "out" / "run.json").exists()


@pytest.mark.render
def test_more_poses_than_frames_of_a_film_are_told(film, tmp_path):
    """The number of a film's frames is known when it has been read: the first poses are taken, with a warning."""
    folder, options = film("convex")
    pictures = [cv2.imread(str(file)) for file in sorted((folder / "frames").iterdir())]
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (320, 320))
    for picture in pictures:
        writer.write(picture)
    writer.release()
    table = json.loads((folder / "poses.json").read_text())
    poses = [entry["world_from_camera"] for entry in table["frames"]]
    (tmp_path / "poses.json").write_text(json.dumps({**table, "frames": [*poses, *poses[:2]]}))
    with pytest.warns(UserWarning, match="6 poses for 4 frames; the first ones are taken"):
        reconstruct_sequence(tmp_path / "film.avi", tmp_path / "out", replace(options, poses=tmp_path / "poses.json"))
