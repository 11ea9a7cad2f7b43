"""Trajectories in the files of other programs: read back exactly, and as SciPy reads them."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.lenses import KannalaBrandt
from simtest.geometry.vectors import rotation
from simtest.reconstruction.poses import read_poses
from simtest.spec.camera_formats.trajectories import Trajectory, stack, tum_text, write_trajectory

CAMERA = Camera(640, 480, 320.0, 322.0, 318.0, 243.0)


def random_trajectory(count=7, seed=23):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for T in poses:
        T[:3, :3], T[:3, 3] = rotation(rng.normal(size=3)), rng.normal(size=3) * 30
    # a half turn, whose quaternion has no real part
    poses[0, :3, :3] = rotation([0, np.pi, 0])
    return Trajectory([f"view_{i:04d}.png" for i in range(count)], poses, [0.04 * i for i in range(count)])


def files_of(tmp_path, trajectory, camera=CAMERA):
    files, left_out = write_trajectory(trajectory, camera, tmp_path)
    assert not left_out
    assert [str(file.relative_to(tmp_path)) for file in files] == [
        "trajectory.txt", "transforms.json", "colmap/cameras.txt",
    ]  # fmt: skip
    return {"tum": files[0], "transforms": files[1], "colmap": tmp_path / "colmap" / "images.txt"}


@pytest.mark.parametrize("camera", [CAMERA, Camera(64, 64, 30.0, 30.0, 32.0, 32.0, distortion=KannalaBrandt(0.01))])
def test_each_format_gives_back_the_poses(tmp_path, camera):
    trajectory = random_trajectory()
    for format, path in files_of(tmp_path, trajectory, camera).items():
        read = read_poses(path)
        np.testing.assert_allclose(read.world_from_camera, trajectory.world_from_camera, atol=1e-11, err_msg=format)
        assert list(read.names) == ([] if format == "tum" else list(trajectory.names))


def test_lines_of_tum_are_times_places_and_scipys_quaternions():
    trajectory = random_trajectory()
    lines = [line for line in tum_text(trajectory).splitlines() if not line.startswith("#")]
    numbers = np.array([[float(word) for word in line.split()] for line in lines])
    np.testing.assert_allclose(numbers[:, 0], 0.04 * np.arange(7))
    poses = trajectory.world_from_camera
    # in metres
    np.testing.assert_allclose(1000 * numbers[:, 1:4], poses[:, :3, 3], atol=1e-11)
    # x y z w
    np.testing.assert_allclose(Rotation.from_quat(numbers[:, 4:]).as_matrix(), poses[:, :3, :3], atol=1e-11)


def test_views_without_times_get_no_tum_file(tmp_path):
    timed = random_trajectory()
    files, _ = write_trajectory(Trajectory(timed.names, timed.world_from_camera), CAMERA, tmp_path)
    assert "trajectory.txt" not in [file.name for file in files]
    with pytest.raises(InputError, match="no times"):
        tum_text(Trajectory(timed.names, timed.world_from_camera))


def test_a_lens_that_a_format_lacks_is_one_line(tmp_path):
    skewed = Camera(640, 480, 320.0, 320.0, 320.0, 240.0, skew=2.0)
    files, left_out = write_trajectory(random_trajectory(), skewed, tmp_path)
    assert [file.name for file in files] == ["trajectory.txt"]
    assert len(left_out) == 2
    assert all("camera.skew = 2: must be 0" in line and "\n" not in line for line in left_out)


def test_as_many_names_as_poses():
    with pytest.raises(InputError, match="1 names, 2 poses and 1 times"):
        Trajectory(["a"], np.tile(np.eye(4), (2, 1, 1)))
    assert stack([]).shape == (0, 4, 4)


def test_the_unit_may_be_a_number_of_millimetres(tmp_path):
    trajectory = random_trajectory()
    paths = files_of(tmp_path, trajectory)
    table = json.loads(paths["transforms"].read_text())
    paths["transforms"].write_text(json.dumps({**table, "unit": 2.5}))
    paths["colmap"].write_text(paths["colmap"].read_text().replace("# unit: mm", "# unit: 2.5"))
    for format in ("transforms", "colmap"):
        read = read_poses(paths[format]).world_from_camera
        np.testing.assert_allclose(read[:, :3, 3], 2.5 * trajectory.world_from_camera[:, :3, 3], atol=1e-10)
        np.testing.assert_allclose(read[:, :3, :3], trajectory.world_from_camera[:, :3, :3], atol=1e-12)


def test_a_file_that_cannot_be_written_is_no_lens_that_a_format_lacks(tmp_path):
    (tmp_path / "colmap" / "cameras.txt").mkdir(parents=True)
    held = Trajectory(["0.png"], np.eye(4)[None])
    with pytest.raises(OSError, match=r"cameras.txt"):
        write_trajectory(held, Camera(64, 48, 50.0, 50.0, 32.0, 24.0), tmp_path)
