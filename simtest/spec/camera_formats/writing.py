"""Writes cameras, and poses where a format holds them, into the files of other programs."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import write_atomically
from simtest.spec.camera_formats.common import Poses
from simtest.spec.camera_tables import camera_toml

Format = Literal["toml", "opencv", "ros", "colmap", "transforms", "matlab"]

FORMATS: tuple[Format, ...] = get_args(Format)

SUFFIXES: dict[str, tuple[str, ...]] = {
    "toml": (".toml",),
    "opencv": (".yml", ".yaml", ".xml", ".json"),
    "ros": (".yml", ".yaml"),
    "colmap": (".txt",),
    "transforms": (".json",),
    "matlab": (".mat",),
}
"""Suffixes of the files of each format; the first format that has a suffix is its default."""

BESIDE = ("images.txt", "points3D.txt")
"""Files of COLMAP beside its cameras.txt."""

HEAD_BYTES = 10_000
"""Of a list of points, whose comments stand first."""

WITH_POSES = ("colmap", "transforms")
"""Formats that hold poses."""


def write_camera(camera: Camera, path: str | Path, format: str | None = None, poses: Poses | None = None) -> None:
    """Write a camera file, and the poses of a sequence's frames where they are given.

    Parameters
    ----------
    camera : Camera
        What to write.
    path : str or Path
        The file; replaced if it exists. COLMAP's images.txt and an empty points3D.txt are written beside cameras.txt.
    format : str, optional
        One of `FORMATS`; default the first that the suffix fits.
    poses : list of (str, ndarray), optional
        Names of frames and their world_from_camera, shape (4, 4), OpenCV axes, mm. Lengths are written as they are,
        and both formats state mm.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera")
    chosen = format or next((name for name in FORMATS if suffix in SUFFIXES[name]), "opencv")
    if chosen not in FORMATS:
        raise InputError(f"format = {chosen!r}: must be one of {', '.join(FORMATS)}{suggestion(chosen, FORMATS)}")
    if suffix not in SUFFIXES[chosen]:
        raise InputError(f"{path}: {chosen} needs a file name that ends in {', '.join(SUFFIXES[chosen])}")
    if chosen == "colmap" and path.name in BESIDE:
        raise InputError(f"{path}: COLMAP keeps no camera under this name; must be cameras.txt")
    if poses is not None and chosen not in WITH_POSES:
        raise InputError(f"{path}: {chosen} holds no poses; must be one of {', '.join(WITH_POSES)}")
    write_files(file_contents(camera, path, chosen, poses))


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files whole or not at all; raise `InputError` for one that cannot be written."""
    for file, data in files.items():
        write_atomically(file, partial(Path.write_bytes, data=data))


def file_contents(camera: Camera, path: Path, format: str, poses: Poses | None) -> dict[Path, bytes]:
    """Return what goes into each file; raise `InputError` if the format lacks the camera's lens."""
    # Imported on demand: OpenCV and SciPy are slow to load.
    if format == "toml":
        return {path: camera_toml(camera).encode()}
    if format == "colmap":
        from simtest.spec.camera_formats.colmap import POINTS_TEXT, cameras_text, images_text

        files = {path: cameras_text(camera).encode()}
        if poses is not None:
            images, points = (path.with_name(name) for name in BESIDE)
            files |= {images: images_text(poses).encode(), points: POINTS_TEXT.encode()}
            _check_no_points(points)
        return files
    if format == "transforms":
        from simtest.spec.camera_formats.transforms import transforms_text

        return {path: transforms_text(camera, poses).encode()}
    if format == "matlab":
        from simtest.spec.camera_formats.matlab import matlab_bytes

        return {path: matlab_bytes(camera)}
    from simtest.spec.camera_formats.opencv import opencv_text, ros_text

    return {path: (ros_text(camera) if format == "ros" else opencv_text(camera, path.suffix.lower())).encode()}


def _check_no_points(path: Path) -> None:
    """Raise `InputError` where a model's own points would give way to an empty list."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return
    if any(line.strip() and not line.startswith(b"#") for line in head.splitlines()):
        raise InputError(f"{path}: exists and holds points; poses must go to a folder without them")
