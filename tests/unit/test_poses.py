"""Files of camera poses: three formats give the same poses, and whatever is malformed is one line."""

import json

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.estimators.motion_signs import PoseError
from simtest.geometry.vectors import rotation
from simtest.reconstruction.poses import UNTOLD_ERROR, read_poses


def pose(turn=(0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(turn), at
    return T


def read(folder, text, name="poses.json"):
    """Write a text, or a table as JSON, as a file of poses, and read it."""
    path = folder / name
    path.write_text(text if isinstance(text, str) else json.dumps(text), encoding="utf-8")
    return read_poses(path)


TWO = [pose(), pose((0.0, 0.0, np.pi / 2), (1.0, -2.0, 0.5))]
HALF = "0.7071067811865476"


def test_three_formats_give_the_same_poses(tmp_path):
    texts = {
        "list.json": json.dumps([T.tolist() for T in TWO]),
        "named.json": json.dumps({
            "frames": [{"frame": f"{i}.png", "world_from_camera": T.tolist()} for i, T in enumerate(TWO)]}),
        "views.json": json.dumps({
            "accepted": [{"picture": f"{i}.png", "model_from_camera": T.tolist()} for i, T in enumerate(TWO)]}),
        "metres.json": json.dumps({"unit": "m", "poses": [pose().tolist(),
                                                           pose((0, 0, np.pi / 2), (0.001, -0.002, 0.0005)).tolist()]}),
        "tum.txt": f"# a comment\n0.0 0 0 0 0 0 0 1\n\n0.04 0.001 -0.002 0.0005 0 0 {HALF} {HALF}\n",
        "tum_mm.txt": f"# unit: mm\n0.0 0 0 0 0 0 0 1\n0.04 1 -2 0.5 0 0 {HALF} {HALF}\n",
    }  # fmt: skip
    for name, text in texts.items():
        found = read(tmp_path, text, name)
        np.testing.assert_allclose(found.world_from_camera, TWO, atol=1e-12, err_msg=name)
        assert found.error == UNTOLD_ERROR
        assert not found.error_told


def test_errors_of_the_poses_are_told_in_the_file(tmp_path):
    table = {"poses": [TWO[0].tolist()], "translation_error": 0.02, "rotation_error_deg": 0.5}
    text = "# translation_error: 0.02\n# rotation_error_deg: 0.5\n0 0 0 0 0 0 0 1\n"
    for found in (read(tmp_path, table), read(tmp_path, text, "poses.txt")):
        assert found.error_told
        assert found.error.translation == 0.02
        assert np.degrees(found.error.rotation) == pytest.approx(0.5)


def test_rounded_matrices_become_rotations(tmp_path):
    R = read(tmp_path, [np.round(pose((0.3, 0.2, -0.4)), 4).tolist()]).world_from_camera[0, :3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_poses_go_with_frames_by_name_or_by_order(tmp_path):
    named = [{"frame": f"dir/{i}.png", "world_from_camera": T.tolist()} for i, T in enumerate(TWO)]
    found = read(tmp_path, named)
    second, missing, first = found.of_frames(["1.png", "x.png", "0.png"], [0, 1, 2])
    assert missing is None
    np.testing.assert_allclose([first, second], TWO, atol=1e-15)
    np.testing.assert_allclose(found.of_film(2).of_frames(["film.avi#0", "film.avi#1"], [0, 1]), TWO, atol=1e-15)
    with pytest.raises(InputError, match="must name frames of the folder"):
        found.of_frames(["a.png"], [0])
    with pytest.raises(InputError, match="2 poses; must be one for each of the 3 frames"):
        found.of_film(2).of_frames(["a", "b", "c"], [0, 1, 2])
    assert len(found.of_files(["1.png", "x.png", "0.png"])) == 3
    unnamed = read(tmp_path, [T.tolist() for T in TWO])
    assert len(unnamed.of_files(["a", "b"])) == 2
    for names, words in ((["a"], "2 poses of frames without names; must be one for each of the 1"), ("abc", "2 poses")):
        with pytest.raises(InputError, match=words):
            unnamed.of_files(names)


@pytest.mark.parametrize("first", [0, 1])
def test_a_film_takes_poses_by_the_numbers_in_their_names(tmp_path, first):
    """COLMAP lists pictures by its own numbers, in any order."""
    moved = [pose(at=(i, 0.0, 0.0)) for i in range(3)]

    def numbered(*numbers):
        return read(tmp_path, [{"frame": f"film2_{n + first:04d}.png", "world_from_camera": moved[i].tolist()}
                               for i, n in enumerate(numbers)])  # fmt: skip

    given = numbered(2, 0, 1).of_film(3)
    assert [T[0, 3] for T in given.of_frames(["f#0", "f#1", "f#2"], [0, 1, 2])] == [1, 2, 0]
    # A frame without a pose shifts those behind it, and nobody knows which it is.
    with pytest.raises(InputError, match="must number its frames from 0 or 1 without"):
        numbered(0, 1, 3).of_film(3)
    with pytest.raises(InputError, match="3 poses; must be one for each of the film's frames, at least 4"):
        numbered(0, 1, 2).of_film(4)


MALFORMED = {
    "no JSON": ("a.json", "{"),
    "holds no pose": ("a.json", "[]"),
    "must be a 4 x 4 matrix": ("a.json", "[[1, 2, 3]]"),
    "no world_from_camera or model_from_camera": ("a.json", '[{"frame": "a.png"}]'),
    "but transform_matrix, whose camera has y up": (
        "a.json", json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()},
                                         {"world_from_camera": np.eye(4).tolist()}]})),
    'state it by a key "unit": "mm"': (
        "a.json", json.dumps({"frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()}]})),
    "state it by a line # unit: mm": ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n"),
    "unit = -3; must be one of mm, m, or the millimetres": ("images.txt", "# unit: -3\n1 1 0 0 0 0 0 0 1 a.png\n\n"),
    "images.txt: line 3": ("images.txt", "# unit: mm\n1 1 0 0 0 0 0 0 1 a.png\n0 0\n"),
    "quaternion of length 0": ("images.txt", "# unit: mm\n1 0 0 0 0 0 0 0 1 a.png\n\n"),
    "names a.png twice; must give": (
        "images.txt", "# unit: mm\n1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1 b/a.png\n\n"),
    "transform_matrix: missing": (
        "a.json", json.dumps({"unit": "mm", "frames": [{"file_path": "a", "transform_matrix": np.eye(4).tolist()},
                                                         {"file_path": "b"}]})),
    "determinant 1": ("a.json", json.dumps([np.diag([1.0, 1, -1, 1]).tolist()])),
    "must be rigid": ("a.json", json.dumps([np.diag([1.0, 1, 2, 1]).tolist()])),
    "NaN": ("a.json", "[[[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]"),
    "names a.png twice": (
        "a.json", json.dumps([{"frame": "a.png", "world_from_camera": np.eye(4).tolist()}] * 2)),
    "must be all or none": (
        "a.json", json.dumps([{"frame": "a.png", "world_from_camera": np.eye(4).tolist()}, np.eye(4).tolist()])),
    "must be one of mm, m": ("a.json", json.dumps({"unit": "inch", "poses": [np.eye(4).tolist()]})),
    "translation_error = -1": ("a.json", json.dumps({"translation_error": -1, "poses": [np.eye(4).tolist()]})),
    "line 2": ("a.txt", "0 0 0 0 0 0 0 1\n0 0 0\n"),
    "must be 8 numbers": ("a.txt", "zero 0 0 0 0 0 0 1\n"),
    "quaternion of length 2": ("a.txt", "0 0 0 0 0 0 0 2\n"),
    "holds no pose; must": ("a.txt", "# nothing\n"),
    "no text": ("a.txt", None),
    "units: unknown; did you mean unit?": ("a.json", json.dumps({"units": "m", "poses": [np.eye(4).tolist()]})),
    "translation_err: unknown; did you mean translation_error?": (
        "a.json", json.dumps({"translation_err": 0.1, "poses": [np.eye(4).tolist()]})),
    "line 1: units: unknown; did you mean unit?": ("a.txt", "# Units = mm\n0 0 0 0 0 0 0 1\n"),
    "names its frame 3; must be the name of a file": (
        "a.json", json.dumps([{"frame": 3, "world_from_camera": np.eye(4).tolist()}])),
    "holds frames and poses; must hold one list": ("a.json", json.dumps({"frames": [], "poses": []})),
    "[[true": ("a.json", json.dumps([[[True, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]).replace(" ", "")),
    "matrix of numbers": ("a.json", json.dumps([[["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]])),
    "a position of 1e+306 mm": ("a.json", "[[[1, 0, 0, 1e306], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]"),
}  # fmt: skip


@pytest.mark.parametrize("words", list(MALFORMED))
def test_malformed_files_are_one_line(words, tmp_path):
    name, text = MALFORMED[words]
    path = tmp_path / name
    path.write_bytes(b"\xff\xfe\x00" if text is None else text.encode())
    with pytest.raises(InputError) as raised:
        read_poses(path)
    message = str(raised.value)
    assert words.lower() in message.lower()
    assert message.startswith("--poses ")
    assert "\n" not in message


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(InputError, match="no such file; must be a file of poses"):
        read_poses(tmp_path / "none.json")


def test_an_error_that_is_not_stated_is_assumed_not_zero(tmp_path):
    found = read(tmp_path, "# Unit = mm\n# Translation_Error: 0.05\n# file: 'bag'\n1 2 3 4 0 0 0 1\n", "a.txt")
    assert found.error.translation == 0.05
    assert found.error.rotation == UNTOLD_ERROR.rotation
    assert not found.error_told
    np.testing.assert_array_equal(found.world_from_camera[0, :3, 3], [2, 3, 4])
    exact = read(tmp_path, "# translation_error: 0\n# rotation_error_deg: 0\n1 2 3 4 0 0 0 1\n", "a.txt")
    assert (exact.error, exact.error_told) == (PoseError(0.0, 0.0), True)


@pytest.mark.parametrize("in_row", [True, False])
def test_the_poses_of_c3vd_have_their_translation_in_the_last_row_or_column(tmp_path, in_row):
    """Its loader says the one, its page the other."""
    text = "\n".join(",".join(map(repr, (T.T if in_row else T).ravel().tolist())) for T in TWO) + "\n"
    np.testing.assert_allclose(read(tmp_path, text, "pose.txt").world_from_camera, TWO, atol=1e-12)


def test_poses_of_c3vd_that_are_all_the_same_either_way_need_no_translation(tmp_path):
    found = read(tmp_path, "1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n", "pose.txt")
    np.testing.assert_array_equal(found.world_from_camera[0], np.eye(4))


def test_the_left_handed_poses_of_simcol3d_carry_points_where_the_engine_does(tmp_path):
    # 30 deg about the engine's y axis, which points up: in its left-handed frame z turns towards x.
    half = np.radians(15.0)
    (tmp_path / "SavedPosition_S1.txt").write_text("1 2 3\n")
    (tmp_path / "SavedRotationQuaternion_S1.txt").write_text(f"0 {np.sin(half)} 0 {np.cos(half)}\n")
    T = read_poses(tmp_path / "SavedPosition_S1.txt").world_from_camera[0]
    # A point 10 mm in front of the camera and 2 mm above it; up is -y for us.
    x, y, z = 10.0 + 10 * np.sin(2 * half), 20.0 + 2.0, 30.0 + 10 * np.cos(2 * half)
    np.testing.assert_allclose(T @ [0.0, -2.0, 10.0, 1.0], [x, -y, z, 1.0], atol=1e-12)


DATASETS = {
    "15 numbers": ("pose.txt", ",".join("1" * 16) + "\n" + ",".join("1" * 15), None, "line 2: .*; must be 16 numbers"),
    "no rotation": ("pose.txt", ",".join(["2"] + ["0"] * 15), None, "pose 0: off a rotation"),
    "row and column": (
        "pose.txt",
        "1,0,0,5,0,1,0,0,0,0,1,0,0,0,0,1\n1,0,0,0,0,1,0,0,0,0,1,0,5,0,0,1",
        None,
        "pose 0: off a rotation and a translation",
    ),
    "no translation": ("pose.txt", "0,-1,0,0,1,0,0,0,0,0,1,0,0,0,0,1", None, "no pose has a translation, .*must hold"),
    "alone": ("SavedPosition_S1.txt", "1 2 3\n", None, "needs SavedRotationQuaternion_S1.txt beside it"),
    "fewer": ("SavedPosition_S1.txt", "1 2 3\n1 2 3\n", "0 0 0 1\n", "2 positions, but .* has 1 rotations"),
    "no unit": ("SavedPosition_S1.txt", "1 2 3\n", "0 0 0 2\n", "pose 0: quaternion of length 2; must be 1"),
    "words": ("SavedPosition_S1.txt", "1 two 3\n", "0 0 0 1\n", "line 1: 1 two 3; must be 3 numbers"),
}


@pytest.mark.parametrize("what", DATASETS)
def test_malformed_poses_of_data_sets_are_one_line(tmp_path, what):
    name, text, other, message = DATASETS[what]
    (tmp_path / name).write_text(text)
    if other is not None:
        (tmp_path / name.replace("SavedPosition_", "SavedRotationQuaternion_")).write_text(other)
    with pytest.raises(InputError, match=message) as error:
        read_poses(tmp_path / name)
    assert "\n" not in str(error.value)


def test_marks_of_encoding_and_numbers_of_opencv_are_read(tmp_path):
    lines = "# unit: mm\n1 1 0 0 0 0 0 0 1 a.png\n\n"
    rows = "[[1., 0, 0, 2.], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    nerf = f'{{"unit": "mm", "frames": [{{"file_path": "a.png", "transform_matrix": {rows}}}]}}'
    for name, text in {"images.txt": lines, "tum.txt": "0 0 0 0 0 0 0 1\n", "t.json": nerf}.items():
        assert len(read(tmp_path, "\ufeff" + text, name).world_from_camera) == 1
