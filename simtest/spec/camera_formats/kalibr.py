"""Kalibr's camera chains (camchain.yaml): several cameras, and where each is beside the one before.

The centre of the first pixel is (0, 0), in simtest (0.5, 0.5): the principal point gains half a pixel. Camera axes are
OpenCV's, lengths metres.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.spec.camera_formats.common import Poses, Table, inverse, number, numbers, rigid
from simtest.spec.camera_formats.plain_yaml import parse_yaml
from simtest.spec.toml_files import read_text

CAMERA = re.compile(r"cam\d+")
LENSES = ("none", "radtan", "equidistant", "equi")
MM = 1000.0


def read_cameras(path: Path) -> dict[str, Table]:
    """Read the cameras of a chain by name (cam0, cam1, ...); raise `InputError` where it is malformed."""
    return {name: _camera(data, f"{path}: {name}") for name, data in _chain(path).items()}


def read_poses(path: Path) -> Poses:
    """Return where the cameras of a chain are: cam0_from_camera, shape (4, 4), lengths mm, named by camera."""
    made: list[tuple[str, Array]] = []
    first_from_camera = np.eye(4)
    for i, (name, data) in enumerate(_chain(path).items()):
        at = f"{path}: {name}"
        if i and "T_cn_cnm1" not in data:
            raise InputError(f"{at}: T_cn_cnm1: missing; must be 4 rows of 4 numbers")
        if i:
            step = rigid(data["T_cn_cnm1"], at, "T_cn_cnm1")
            step[:3, 3] *= MM
            first_from_camera = first_from_camera @ inverse(step)
        made.append((name, first_from_camera.copy()))
    return made


def _chain(path: Path) -> dict[str, Mapping[str, Any]]:
    where = str(path)
    try:
        data = parse_yaml(read_text(path, "camera"))
    except ValueError as error:
        raise InputError(f"{where}: not valid YAML: {error!s:.80}") from error
    found = {name: value for name, value in data.items() if CAMERA.fullmatch(name)} if isinstance(data, Mapping) else {}
    if not found:
        raise InputError(f"{where}: holds no camera; must have the keys cam0, cam1, ...")
    for name, value in found.items():
        if not isinstance(value, Mapping):
            raise InputError(f"{where}: {name} = {value!r:.60}: must be a table of keys")
    return dict(sorted(found.items(), key=lambda item: int(item[0][3:])))


def _camera(data: Mapping[str, Any], at: str) -> Table:
    model = data.get("camera_model")
    if model != "pinhole":
        raise InputError(f"{at}: camera_model = {model!r:.40}: simtest lacks it; must be pinhole")
    fx, fy, cx, cy = numbers(data.get("intrinsics"), at, "intrinsics", 4)
    width, height = numbers(data.get("resolution"), at, "resolution", 2)
    table = {
        "width": int(number(width, at, "resolution", whole=True)), "fx": fx, "cx": cx + PIXEL_CENTRE,
        "height": int(number(height, at, "resolution", whole=True)), "fy": fy, "cy": cy + PIXEL_CENTRE,
    }  # fmt: skip
    return table | _lens(data, at)


def _lens(data: Mapping[str, Any], at: str) -> Table:
    """Return the key `distortion`, or nothing for a pinhole."""
    name = data.get("distortion_model", "none")
    if name not in LENSES:
        raise InputError(f"{at}: distortion_model = {name!r:.40}: simtest lacks it; must be one of {', '.join(LENSES)}")
    told = [] if name == "none" else numbers(data.get("distortion_coeffs"), at, "distortion_coeffs", 4)
    if name in ("equidistant", "equi"):
        return {"distortion": {"type": "kannala_brandt", **dict(zip(("k1", "k2", "k3", "k4"), told, strict=True))}}
    if not any(told):
        return {}
    return {"distortion": {"type": "brown_conrady", **dict(zip(("k1", "k2", "p1", "p2"), told, strict=True))}}
