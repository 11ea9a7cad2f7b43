"""transforms.json of NeRF programs (Nerfstudio, instant-ngp): a camera, and the poses of its frames.

The centre of the first pixel is (0.5, 0.5), as in simtest. `transform_matrix` is world_from_camera with OpenGL's camera
axes: x right, y up, z backward. Its unit of length is arbitrary.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.distortion import BrownConrady, KannalaBrandt
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import Poses, Table, check_alike, mask_table, number, read_json, rigid

MODELS = {
    "SIMPLE_PINHOLE": False, "PINHOLE": False, "SIMPLE_RADIAL": False, "RADIAL": False, "OPENCV": False,
    "OPENCV_FISHEYE": True,
}  # fmt: skip
"""Camera models, and whether each is a fisheye."""

INTRINSICS = (
    "w",
    "h",
    "fl_x",
    "fl_y",
    "camera_angle_x",
    "camera_angle_y",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
)

FOCAL_KEYS = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
"""Two keys for one focal length, along x and y."""

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes from OpenCV's; its own inverse."""


def read_cameras(path: Path) -> dict[str, Table]:
    """Read the camera, or those of the frames where they have their own, by file_path."""
    data, where = read_json(path), str(path)
    frames = _frames(data, where)
    own = [frame for frame in frames if set(frame) & set(INTRINSICS)]
    if not own:
        return {"": _camera(data, where)}
    cameras: dict[str, Table] = {}
    for i, frame in enumerate(frames):
        name, camera = _name(frame, where, i), _camera(_of_frame(data, frame), f"{where}: frames[{i}]")
        if cameras.setdefault(name, camera) != camera:
            raise InputError(f"{where}: frames[{i}]: file_path {name} has two cameras; must have one")
    return cameras


def read_poses(path: Path) -> Poses:
    """Read world_from_camera of the frames, by file_path, with OpenCV's camera axes, in the file's unit of length."""
    data, where = read_json(path), str(path)
    made: list[tuple[str, Array]] = []
    for i, frame in enumerate(_frames(data, where)):
        at = f"{where}: frames[{i}]"
        if "transform_matrix" not in frame:
            raise InputError(f"{at}: transform_matrix: missing; must be 4 rows of 4 numbers")
        made.append((_name(frame, where, i), rigid(frame["transform_matrix"], at, "transform_matrix") @ GL_FROM_CV))
    return made


def _frames(data: Mapping[str, Any], where: str) -> list[Mapping[str, Any]]:
    frames = data.get("frames", [])
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        raise InputError(f"{where}: frames = {frames!r:.60}: must be a list of objects")
    return frames


def _of_frame(data: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return the file's keys with those of a frame in their place: a focal length also replaces the file's angle."""
    told = {key for key in frame if frame[key] is not None}
    replaced = {key for pair in FOCAL_KEYS for key in pair if told & set(pair)}
    return {key: value for key, value in data.items() if key not in replaced} | dict(frame)


def _name(frame: Mapping[str, Any], where: str, index: int) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: frames[{index}]: file_path = {name!r:.60}: must name a picture")
    return name


def _camera(data: Mapping[str, Any], where: str) -> Table:
    """Return the camera that keys describe."""
    told = {key: number(data[key], where, key) for key in INTRINSICS if data.get(key) is not None}
    for key in ("w", "h"):
        if key not in told:
            raise InputError(f"{where}: {key}: missing; a camera needs the size of its pictures, px")
        number(told[key], where, key, whole=True)
    width, height = int(told["w"]), int(told["h"])
    lens = _lens(data, told, where)
    # The angle that a fisheye spans does not follow from its focal length alone.
    both = lens is None or lens["type"] != "kannala_brandt"
    fx = _focal(told, FOCAL_KEYS[0], width, where, both)
    fy = fx if not set(FOCAL_KEYS[1]) & set(told) else _focal(told, FOCAL_KEYS[1], height, where, both)
    return {
        "width": width, "height": height, "fx": fx, "fy": fy, "cx": told.get("cx", width / 2),
        "cy": told.get("cy", height / 2), "distortion": lens, "view_mask": data.get("view_mask"),
    }  # fmt: skip


def _focal(told: Mapping[str, float], keys: tuple[str, str], extent: int, where: str, both: bool) -> float:
    """Return a focal length, px, given itself or by the angle, rad, that the picture spans; compare these if `both`."""
    focal, angle = keys
    if angle not in told:
        if focal not in told:
            raise InputError(f"{where}: {focal}: missing; must be given, or {angle}")
        return told[focal]
    if not 0 < told[angle] < math.pi:
        raise InputError(f"{where}: {angle} = {told[angle]:g}: must be 0 to pi, rad")
    spanned = extent / 2 / math.tan(told[angle] / 2)
    if focal in told and both:
        check_alike(where, keys, told[focal], spanned)
    return told.get(focal, spanned)


def _lens(data: Mapping[str, Any], told: Mapping[str, float], where: str) -> Table | None:
    """Return the lens as a table; None for a pinhole."""
    model = data.get("camera_model")
    if model is not None and (not isinstance(model, str) or model not in MODELS):
        hint = suggestion(model, MODELS) if isinstance(model, str) else ""
        raise InputError(
            f"{where}: camera_model = {model!r:.40}: simtest lacks it; must be one of {', '.join(MODELS)}{hint}"
        )
    told_fisheye = data.get("is_fisheye", False)
    if told_fisheye not in (False, True, None):
        raise InputError(f"{where}: is_fisheye = {told_fisheye!r:.40}: must be true or false")
    fisheye = bool(told_fisheye) if model is None else MODELS[model]
    if told_fisheye is not None and "is_fisheye" in data and bool(told_fisheye) != fisheye:
        raise InputError(f"{where}: is_fisheye = {told_fisheye}: does not fit camera_model = {model!r}")
    if fisheye:
        return {"type": "kannala_brandt", **{key: told.get(key, 0.0) for key in ("k1", "k2", "k3", "k4")}}
    if told.get("k4"):
        raise InputError(f"{where}: k4 = {told['k4']:g}: must be 0; simtest's perspective lens has no term r^8")
    lens = {key: told[key] for key in ("k1", "k2", "p1", "p2", "k3") if told.get(key)}
    return {"type": "brown_conrady", **lens} if lens else None


def transforms_text(camera: Camera, poses: Poses | None = None) -> str:
    """Return a camera, and poses of its frames, whose lengths must be mm, as the text of transforms.json.

    Raises `InputError` if the camera has a skew, or a lens that the format lacks.
    """
    lens, name = camera.distortion, "transforms.json"
    if camera.skew != 0:
        raise InputError(f"camera.skew = {camera.skew:g}: must be 0, since {name} has none; save as TOML instead")
    data: dict[str, Any] = {"camera_model": "PINHOLE"}
    if isinstance(lens, KannalaBrandt):
        data = {"camera_model": "OPENCV_FISHEYE", **{key: getattr(lens, key) for key in ("k1", "k2", "k3", "k4")}}
    elif isinstance(lens, BrownConrady):
        if lens.k4 or lens.k5 or lens.k6:
            raise InputError(f"camera.distortion: k4, k5, k6 must be 0, since {name} lacks them; save as TOML instead")
        data = {"camera_model": "OPENCV", **{key: getattr(lens, key) for key in ("k1", "k2", "p1", "p2", "k3")}}
    elif lens is not None:
        raise InputError(f"camera.distortion: {name} has no {type(lens).__name__} lens; save as TOML instead")
    data |= {
        "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
    }  # fmt: skip
    if camera.view_mask is not None:
        data["view_mask"] = mask_table(camera.view_mask)
    if poses is not None:
        # Others pass over it; `simtest reconstruct --poses` needs it.
        data["unit"] = "mm"
    data["frames"] = [
        {"file_path": frame, "transform_matrix": (np.asarray(pose, dtype=float) @ GL_FROM_CV).tolist()}
        for frame, pose in poses or ()
    ]
    return json.dumps(data, indent=2) + "\n"
