"""Reads and writes camera files of any known format; `FORMATS` is the list of them.

A file is recognised by what it holds. One of several cameras is named FILE#ID.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import as_path, write_atomically, written_together
from simtest.spec.camera_formats.common import LARGEST, Files, Poses, Table, chosen, within
from simtest.spec.camera_tables import camera_toml
from simtest.spec.toml_files import read_text


@dataclass(frozen=True)
class Format:
    """A format of camera files."""

    name: str  # as `recognise` returns it and `write_camera` takes it
    title: str  # how messages and pages call it
    # Of this package, with the functions below; loaded on demand, since OpenCV and SciPy are slow to load.
    module: str = ""
    # Pattern that a file holds, by its syntax: xml, json, yaml or text. Of several that fit the first row counts.
    looks_like: Mapping[str, str] | None = None
    cameras: str = ""  # function that reads the cameras of a file: tables of `CameraSpec` by id. Empty: it holds none.
    poses: str = ""  # function that reads names and world_from_camera of frames. Empty: it holds none.
    # Function of a camera, the file's path and poses or None that returns the `Files` to write. Empty: none is.
    write: str = ""
    suffixes: tuple[str, ...] = ()  # of the files that are written; the first format that has a suffix is its default
    writes_poses: bool = False  # whether poses are written too

    def function(self, name: str) -> Callable[..., Any]:
        """Return a function of the format's module."""
        found: Callable[..., Any] = getattr(import_module(f"simtest.spec.camera_formats.{self.module}"), name)
        return found


_ROWS = (
    Format("toml", "simtest's TOML", "files", write="toml_file", suffixes=(".toml",)),
    Format(
        "opencv", "OpenCV or ROS", "opencv", cameras="read_opencv", write="opencv_file",
        suffixes=(".yml", ".yaml", ".xml", ".json"),
    ),
    Format("ros", "ROS camera_info", "opencv", write="ros_file", suffixes=(".yml", ".yaml")),
    Format(
        "colmap", "COLMAP cameras.txt", "colmap", {"text": r"^[ \t]*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d"},
        "read_colmap", "read_images", "colmap_files", (".txt",), True,
    ),
    Format(
        "transforms", "transforms.json of NeRF", "colmap",
        {"json": r"\"(transform_matrix|camera_angle_x|fl_x)\"\s*:"},
        "read_transforms", "transforms_poses", "transforms_file", (".json",), True,
    ),
    Format("matlab", "MATLAB", "matlab", cameras="read_matlab", write="matlab_file", suffixes=(".mat",)),
    Format(
        "colmap images", "COLMAP images.txt", "colmap",
        {"text": r"^[ \t]*\d+([ \t]+[-+.\deE]+){7}[ \t]+\d+[ \t]+\S"}, poses="read_images",
    ),
    Format(
        "ocamcalib", "OCamCalib calib_results.txt", "omnidirectional",
        {"text": r"^[ \t]*#?[ \t]*polynomial coefficients|^[ \t]*\d+([ \t]+[-+.\deE]+){5,}[ \t]*$"}, "read_ocamcalib",
    ),
    Format(
        "c3vd", "parameters of C3VD", "omnidirectional", {"json": r"\"a0\"\s*:", "text": r"^[ \t]*a0[ \t]*[=:]"},
        "read_c3vd",
    ),
    Format(
        "kalibr", "Kalibr YAML", "opencv", {"yaml": r"^cam\d+\s*:", "text": r"^cam\d+\s*:"}, "read_kalibr",
        "kalibr_poses",
    ),
    Format(
        "photometric", "EndoMapper's photometric XML",
        looks_like={"xml": r"<light_model\b|<camera_model\b[^>]*type=[\"']gamma[\"']"},
    ),
    Format("vicalib", "Vicalib XML", "omnidirectional", {"xml": r"<camera_model\b"}, "read_vicalib"),
)  # fmt: skip

FORMATS = {each.name: each for each in _ROWS}
"""The formats by name."""

WRITTEN = tuple(each.name for each in _ROWS if each.write)

FOREIGN_SUFFIXES = (*FORMATS["opencv"].suffixes, *FORMATS["matlab"].suffixes)
"""Suffixes of other programs' files: no calibration is saved under such a name."""

HEAD = 20_000
"""Characters by which a format is recognised."""


def split_id(path: str | Path) -> tuple[Path, str | None]:
    """Return the file and the camera's id of "FILE#ID"; no id where there is none, or a file has that very name."""
    path = as_path(path)
    head, mark, wanted = path.name.rpartition("#")
    if not mark or not head or _holds(path, Path.exists):
        return path, None
    return path.with_name(head), wanted


def recognise(path: str | Path) -> str:
    """Return the name of a camera file's format, by its suffix and by what it holds; what is nothing else is TOML.

    A folder is a COLMAP model where it holds cameras.txt.
    """
    path, _ = split_id(path)
    suffix = path.suffix.lower()
    if _holds(path / "cameras.txt", Path.is_file):
        return "colmap"
    if suffix in (".mat", ".toml"):
        return "matlab" if suffix == ".mat" else "toml"
    if suffix == ".bin":
        how = "colmap model_converter --output_type TXT writes text files"
        raise InputError(f"{path}: binary models are not read; {how}")
    text = read_text(path, "camera", "record_bytes")
    head = text[:HEAD]
    if head.lstrip().startswith("<"):
        return _first("xml", head, "opencv")
    if head.lstrip().startswith("{"):
        # Keys have no order: what tells the format may stand last.
        return _first("json", text, "opencv")
    return _first("yaml", head, "opencv") if suffix in FORMATS["opencv"].suffixes else _first("text", head, "toml")


def _holds(path: Path, test: Callable[[Path], bool]) -> bool:
    """Return whether a test of a path holds; a name that no file can have is refused where the file is read."""
    try:
        return test(path)
    except (OSError, ValueError):
        return False


def _first(syntax: str, text: str, otherwise: str) -> str:
    """Return the name of the first format whose pattern for a syntax is found."""
    patterns = ((each.name, (each.looks_like or {}).get(syntax)) for each in _ROWS)
    return next((name for name, pattern in patterns if pattern and re.search(pattern, text, re.MULTILINE)), otherwise)


# Reading ---------------------------------------------------------------------------------------------------------


def read_table(path: str | Path) -> Table:
    """Read a camera of a file of another program as the table of a `CameraSpec`; "FILE#ID" names one of several.

    TOML is read elsewhere.
    """
    path, wanted = split_id(path)
    where, form = str(path), FORMATS[recognise(path)]
    if form.name == "photometric":
        raise InputError(f"{where}: {form.title} holds no lens; give it as --photometric beside a camera file")
    if not form.cameras:
        raise InputError(f"{where}: {form.title} holds no camera; must be a camera file of another program")
    cameras: dict[str, Table] = form.function(form.cameras)(path / "cameras.txt" if path.is_dir() else path)
    with within(where):
        return chosen(cameras, wanted)


def read_poses(path: str | Path) -> Poses:
    """Read the poses that a file of another program holds: names of frames, and world_from_camera, shape (4, 4).

    Axes are OpenCV's: x right, y down, z forward. The unit of length is the file's: COLMAP's and NeRF's is arbitrary,
    Kalibr's is made mm.
    """
    path, _ = split_id(path)
    form = FORMATS[recognise(path)]
    if path.is_dir() or form.name == "colmap":
        path = path / "images.txt" if path.is_dir() else path.with_name("images.txt")
    if not form.poses:
        must = "COLMAP's images.txt, transforms.json or a Kalibr chain"
        raise InputError(f"{path}: {form.title} holds no poses; must be {must}")
    poses: Poses = form.function(form.poses)(path)
    if not poses:
        raise InputError(f"{path}: holds no pose; must hold one for each frame")
    seen: set[str] = set()
    for name, pose in poses:
        if name in seen:
            raise InputError(f"{path}: names {name} twice; must give each frame one pose")
        if not np.abs(pose).max() <= LARGEST:
            raise InputError(f"{path}: {name}: a position beyond {LARGEST:g}; must be within it")
        seen.add(name)
    return poses


# Writing ---------------------------------------------------------------------------------------------------------


def write_camera(camera: Camera, path: str | Path, format: str | None = None, poses: Poses | None = None) -> None:
    """Write a camera file, and the poses of a sequence's frames where they are given (see `simtest.save_camera`).

    COLMAP's images.txt and an empty points3D.txt are written beside cameras.txt. Poses are world_from_camera, shape (4,
    4), OpenCV axes, mm: lengths are written as they are, and both formats state mm.
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    if not isinstance(camera, Camera):
        raise InputError(f"camera is a {type(camera).__name__}: must be a simtest.Camera")
    name = format or next((name for name in WRITTEN if suffix in FORMATS[name].suffixes), "opencv")
    if name not in WRITTEN:
        raise InputError(f"format = {name!r}: must be one of {', '.join(WRITTEN)}{suggestion(name, WRITTEN)}")
    form = FORMATS[name]
    if suffix not in form.suffixes:
        raise InputError(f"{path}: {name} needs a file name that ends in {', '.join(form.suffixes)}")
    if name == "colmap" and path.name in ("images.txt", "points3D.txt"):
        raise InputError(f"{path}: COLMAP keeps no camera under this name; must be cameras.txt")
    if poses is not None and not form.writes_poses:
        must = ", ".join(name for name in WRITTEN if FORMATS[name].writes_poses)
        raise InputError(f"{path}: {name} holds no poses; must be one of {must}")
    write_files(file_contents(camera, path, name, poses))


def write_files(files: Files) -> None:
    """Write files of one folder, all or none of them; raise `InputError` for one that cannot be written."""
    with written_together(next(iter(files)).parent, [file.name for file in files]) as new:
        for file, data in files.items():
            write_atomically(new / file.name, partial(Path.write_bytes, data=data))


def file_contents(camera: Camera, path: Path, format: str, poses: Poses | None) -> Files:
    """Return what goes into each file; raise `InputError` if the format lacks the camera's lens."""
    form = FORMATS[format]
    files: Files = form.function(form.write)(camera, path, poses)
    return files


def toml_file(camera: Camera, path: Path, _: Poses | None) -> Files:
    """Return a camera as simtest's own TOML file."""
    return {path: camera_toml(camera).encode()}
