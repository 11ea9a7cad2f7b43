"""Where the camera was at each frame of a sequence, and the files in which other programs read it.

`world_from_camera` turns points of the camera frame (x right, y down, z forward) into points of the world, mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.vectors import quaternion_of
from simtest.runtime.arrays import Array
from simtest.runtime.files import make_folder, write_atomically
from simtest.spec.camera_formats.files import file_contents, write_files

TUM, TRANSFORMS, COLMAP = "trajectory.txt", "transforms.json", "colmap"
"""Files of a trajectory: TUM's, NeRF's, and the folder of COLMAP's."""

MM_PER_M = 1000.0


@dataclass(frozen=True)
class Trajectory:
    """Poses of a sequence's frames."""

    names: Sequence[str]  # of the frames' files
    world_from_camera: Array  # (N, 4, 4): poses, mm
    times_s: Sequence[float] | None = None  # when the frames were taken, s; None where they are no sequence in time

    def __post_init__(self) -> None:
        times = len(self.names) if self.times_s is None else len(self.times_s)
        if not len(self.names) == len(self.world_from_camera) == times:
            raise InputError(
                f"trajectory: {len(self.names)} names, {len(self.world_from_camera)} poses and {times} times; must be "
                "as many of each"
            )

    @property
    def poses(self) -> list[tuple[str, Array]]:
        """Name and world_from_camera of each frame."""
        return list(zip(self.names, self.world_from_camera, strict=True))


def tum_text(trajectory: Trajectory) -> str:
    """Return a trajectory as the text of a TUM file: lines of time, tx ty tz (m), qx qy qz qw; world from camera."""
    if trajectory.times_s is None:
        raise InputError("trajectory: has no times; a TUM file needs one for each frame")
    lines = ["# unit: m", "# world from camera: time tx ty tz qx qy qz qw; x right, y down, z forward"]
    for time, T in zip(trajectory.times_s, trajectory.world_from_camera, strict=True):
        w, x, y, z = quaternion_of(T[:3, :3])
        # As many digits as a number has.
        lines.append(" ".join(repr(float(value)) for value in (time, *(T[:3, 3] / MM_PER_M), x, y, z, w)))
    return "\n".join([*lines, ""])


def write_trajectory(trajectory: Trajectory, camera: Camera, folder: Path) -> tuple[list[Path], list[str]]:
    """Write a trajectory of one camera in every format that can hold it, into an existing folder.

    It gets `TRANSFORMS`, the folder `COLMAP` and, for frames with times, `TUM`. Returns the files that were written,
    and why a format was left out: it lacks the camera's lens.
    """
    files: list[Path] = []
    left_out: list[str] = []
    if trajectory.times_s is not None:
        files.append(folder / TUM)
        write_atomically(files[-1], partial(Path.write_text, data=tum_text(trajectory), encoding="utf-8"))
    for path, format in ((folder / TRANSFORMS, "transforms"), (folder / COLMAP / "cameras.txt", "colmap")):
        make_folder(path.parent)
        try:
            contents = file_contents(camera, path, format, trajectory.poses)
        except InputError as error:
            left_out.append(f"{path.relative_to(folder)}: {error}")
            continue
        write_files(contents)
        files.append(path)
    return files, left_out


def stack(poses: Sequence[Array]) -> Array:
    """Return poses, shape (4, 4) each, as one array, shape (N, 4, 4), also where there are none."""
    return np.array(poses, dtype=float).reshape(-1, 4, 4)
