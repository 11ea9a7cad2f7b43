"""COLMAP's own reader takes the cameras and poses that are written."""

import numpy as np
import pycolmap
from test_camera_formats import CAMERAS, PX, RAYS, some_poses
from test_trajectories import CAMERA, files_of, random_trajectory

from simtest import save_camera


def test_pycolmap_reads_what_is_written(tmp_path):
    poses = some_poses()
    for which in ("pinhole", "brown", "rational", "fisheye"):
        save_camera(CAMERAS[which], tmp_path / "cameras.txt", "colmap", poses)
        model = pycolmap.Reconstruction(str(tmp_path))
        seen = np.array(model.cameras[1].img_from_cam(RAYS))
        np.testing.assert_allclose(CAMERAS[which].project(RAYS), seen, rtol=0, atol=PX)
        for image in model.images.values():
            matrix = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
            np.testing.assert_allclose(np.linalg.inv(matrix), dict(poses)[image.name], atol=1e-9)


def test_colmap_reads_the_export(tmp_path):
    trajectory = random_trajectory()
    files_of(tmp_path, trajectory)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    by_name = {image.name: image for image in model.images.values()}
    assert sorted(by_name) == sorted(trajectory.names)
    point = np.array([0.3, -0.2, 12.0])
    for name, T in trajectory.poses:
        image = by_name[name]
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        np.testing.assert_allclose(np.linalg.inv(T)[:3], pose.matrix(), atol=1e-9)
        world = T[:3, :3] @ point + T[:3, 3]
        np.testing.assert_allclose(
            model.cameras[image.camera_id].img_from_cam(pose * world),
            CAMERA.project(point),
            atol=1e-9,
        )
