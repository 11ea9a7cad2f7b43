"""Reads camera files of any known format, which it recognises by what they hold.

A file of several cameras is named FILE#ID.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from simtest.errors import InputError
from simtest.spec.camera_formats.common import LARGEST, Poses, Table, chosen
from simtest.spec.toml_files import read_text

Kind = Literal[
    "toml", "opencv", "matlab", "colmap", "colmap images", "transforms", "kalibr", "vicalib", "ocamcalib", "c3vd",
    "photometric",
]  # fmt: skip

KINDS: tuple[Kind, ...] = get_args(Kind)

NAMES: dict[Kind, str] = {
    "toml": "simtest's TOML",
    "opencv": "OpenCV or ROS",
    "matlab": "MATLAB",
    "colmap": "COLMAP cameras.txt",
    "colmap images": "COLMAP images.txt",
    "transforms": "transforms.json of NeRF",
    "kalibr": "Kalibr YAML",
    "vicalib": "Vicalib XML",
    "ocamcalib": "OCamCalib calib_results.txt",
    "c3vd": "parameters of C3VD",
    "photometric": "EndoMapper's photometric XML",
}
"""How messages and pages call the formats."""

OPENCV_SUFFIXES = (".yml", ".yaml", ".xml", ".json")
MATLAB_SUFFIX = ".mat"
FOREIGN_SUFFIXES = (*OPENCV_SUFFIXES, MATLAB_SUFFIX)
"""Suffixes of other programs' files: no calibration is saved under such a name."""

HEAD = 20_000
"""Characters by which a format is recognised."""

_XML_KINDS: tuple[tuple[str, Kind], ...] = (
    (r"<light_model\b|<camera_model\b[^>]*type=[\"']gamma[\"']", "photometric"),
    (r"<camera_model\b", "vicalib"),
)
_JSON_KINDS: tuple[tuple[str, Kind], ...] = (
    (r"\"(transform_matrix|camera_angle_x|fl_x)\"\s*:", "transforms"),
    (r"\"a0\"\s*:", "c3vd"),
)
_YAML_KINDS: tuple[tuple[str, Kind], ...] = ((r"^cam\d+\s*:", "kalibr"),)
_TEXT_KINDS: tuple[tuple[str, Kind], ...] = (
    (r"^[ \t]*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d", "colmap"),
    (r"^[ \t]*\d+([ \t]+[-+.\deE]+){7}[ \t]+\d+[ \t]+\S", "colmap images"),
    (r"^[ \t]*#?[ \t]*polynomial coefficients|^[ \t]*\d+([ \t]+[-+.\deE]+){5,}[ \t]*$", "ocamcalib"),
    (r"^[ \t]*a0[ \t]*[=:]", "c3vd"),
)


def split_id(path: str | Path) -> tuple[Path, str | None]:
    """Return the file and the camera's id of "FILE#ID"; no id where there is none, or a file has that very name."""
    path = Path(path)
    head, mark, wanted = path.name.rpartition("#")
    if not mark or not head or _holds(path, Path.exists):
        return path, None
    return path.with_name(head), wanted


def recognise(path: str | Path) -> Kind:
    """Return the format of a camera file, by its suffix and by what it holds; files that are nothing else are TOML.

    A folder is a COLMAP model where it holds cameras.txt. Raises `InputError` if the file cannot be read, or is one of
    COLMAP's binary ones.
    """
    path, _ = split_id(path)
    suffix = path.suffix.lower()
    if _holds(path / "cameras.txt", Path.is_file):
        return "colmap"
    if suffix == MATLAB_SUFFIX:
        return "matlab"
    if suffix == ".toml":
        return "toml"
    if suffix == ".bin":
        how = "colmap model_converter --output_type TXT writes text files"
        raise InputError(f"{path}: binary models are not read; {how}")
    text = read_text(path, "camera", "record_bytes")
    head = text[:HEAD]
    if head.lstrip().startswith("<"):
        return _first(_XML_KINDS, head, "opencv")
    if head.lstrip().startswith("{"):
        # Keys have no order: what tells the format may stand last.
        return _first(_JSON_KINDS, text, "opencv")
    if suffix in OPENCV_SUFFIXES:
        return _first(_YAML_KINDS, head, "opencv")
    return _first((*_TEXT_KINDS, *_YAML_KINDS), head, "toml")


def _holds(path: Path, test: Callable[[Path], bool]) -> bool:
    """Return whether a test of a path holds; a name that no file can have is refused where the file is read."""
    try:
        return test(path)
    except (OSError, ValueError):
        return False


def _first(kinds: tuple[tuple[str, Kind], ...], head: str, otherwise: Kind) -> Kind:
    """Return the kind of the first pattern that is found."""
    return next((kind for pattern, kind in kinds if re.search(pattern, head, re.MULTILINE)), otherwise)


def read_cameras(path: str | Path) -> dict[str, Table]:
    """Read all cameras of a file of another program, as tables of `CameraSpec` by id; TOML is read elsewhere."""
    path, _ = split_id(path)
    kind = recognise(path)
    if path.is_dir():
        path = path / "cameras.txt"
    if kind == "photometric":
        raise InputError(f"{path}: {NAMES[kind]} holds no lens; give it as --photometric beside a camera file")
    if kind in ("colmap images", "toml"):
        raise InputError(f"{path}: {NAMES[kind]} holds no camera; must be a camera file of another program")
    return _readers()[kind](path)


def _readers() -> dict[str, Callable[[Path], dict[str, Table]]]:
    """Return the reader of each format, imported on demand: OpenCV and SciPy are slow to load."""
    from importlib import import_module

    def late(module: str, name: str) -> Callable[[Path], dict[str, Table]]:
        def read(path: Path) -> dict[str, Table]:
            found: dict[str, Table] = getattr(import_module(f"simtest.spec.camera_formats.{module}"), name)(path)
            return found

        return read

    return {
        "opencv": late("opencv", "read_cameras"),
        "matlab": late("matlab", "read_cameras"),
        "colmap": late("colmap", "read_cameras"),
        "transforms": late("transforms", "read_cameras"),
        "kalibr": late("kalibr", "read_cameras"),
        "vicalib": late("vicalib", "read_cameras"),
        "ocamcalib": late("omnidirectional", "read_ocamcalib"),
        "c3vd": late("omnidirectional", "read_c3vd"),
    }


def read_table(path: str | Path) -> Table:
    """Read a camera of a file of another program as the table of a `CameraSpec`; "FILE#ID" names one of several."""
    file, wanted = split_id(path)
    return chosen(read_cameras(file), wanted, str(file))


def read_poses(path: str | Path) -> Poses:
    """Read the poses that a file of another program holds: names of frames, and world_from_camera, shape (4, 4).

    Axes are OpenCV's: x right, y down, z forward. The unit of length is the file's: COLMAP's and NeRF's is arbitrary,
    Kalibr's is made mm.
    """
    path, _ = split_id(path)
    kind = recognise(path)
    if path.is_dir():
        path = path / "images.txt"
    elif kind == "colmap":
        path = path.with_name("images.txt")
    if kind in ("colmap", "colmap images"):
        from simtest.spec.camera_formats.colmap import read_images

        poses = read_images(path)
    elif kind == "transforms":
        from simtest.spec.camera_formats import transforms

        poses = transforms.read_poses(path)
    elif kind == "kalibr":
        from simtest.spec.camera_formats import kalibr

        poses = kalibr.read_poses(path)
    else:
        must = "COLMAP's images.txt, transforms.json or a Kalibr chain"
        raise InputError(f"{path}: {NAMES[kind]} holds no poses; must be {must}")
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
