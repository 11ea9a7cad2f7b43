"""COLMAP's text files and transforms.json of NeRF programs: a camera, and the poses of its frames.

The centre of the first pixel is (0.5, 0.5), as in simtest. COLMAP's camera axes are OpenCV's; a line of images.txt
holds camera_from_world: a quaternion w x y z, then a translation. In transforms.json (Nerfstudio, instant-ngp)
`transform_matrix` is world_from_camera with OpenGL's camera axes: x right, y up, z backward. The unit of length of both
is arbitrary.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt
from simtest.geometry.vectors import quaternion_of, rotation_of
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import (
    BROWN,
    FISHEYE,
    Files,
    Poses,
    Table,
    check_alike,
    check_no_skew,
    coefficients,
    inverse,
    json_object,
    lens_table,
    mask_of_text,
    mask_table,
    mask_text,
    number,
    of_text,
    plain_table,
    rigid,
    within,
)

COLMAP_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f",),
    "PINHOLE": ("fx", "fy"),
    "SIMPLE_RADIAL": ("f", "k1"),
    "RADIAL": ("f", "k1", "k2"),
    "OPENCV": ("fx", "fy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "k1"),
    "RADIAL_FISHEYE": ("f", "k1", "k2"),
    "SIMPLE_FISHEYE": ("f",),
    "FISHEYE": ("fx", "fy"),
}
"""Parameters of each model; cx and cy come after the focal length."""

OTHER_MODELS = (
    "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
"""Models of COLMAP whose lenses simtest lacks."""

POINTS_TEXT = "# 3D point list with one line of data per point:\n"
"""An empty points3D.txt, without which COLMAP loads no model."""

HEAD_BYTES = 10_000
"""Of a list of points, whose comments stand first."""

MASK = "# simtest view_mask "
"""Comment that holds the view mask, which COLMAP does not know."""

NERF_MODELS = {
    "SIMPLE_PINHOLE": False, "PINHOLE": False, "SIMPLE_RADIAL": False, "RADIAL": False, "OPENCV": False,
    "OPENCV_FISHEYE": True,
}  # fmt: skip
"""Camera models, and whether each is a fisheye."""

FOCAL_KEYS = (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y"))
"""Two keys for one focal length, along x and y."""

INTRINSICS = ("w", "h", *FOCAL_KEYS[0], *FOCAL_KEYS[1], "cx", "cy", *FISHEYE, "p1", "p2")

GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes from OpenCV's; its own inverse."""


@of_text()
def read_colmap(text: str) -> dict[str, Table]:
    """Read cameras.txt as tables of `CameraSpec` by camera id; raise `InputError` where it is malformed."""
    cameras: dict[str, Table] = {}
    mask: Table | None = None
    for count, line in enumerate(text.splitlines(), 1):
        words = line.split()
        with within(f"line {count}"):
            if line.startswith(MASK):
                mask = mask_of_text(line.removeprefix(MASK))
            if not words or words[0].startswith("#"):
                continue
            name = words[0]
            if name in cameras:
                raise InputError(f"camera {name} is given twice")
            cameras[name] = _colmap_camera(words)
        if mask is not None:
            cameras[name]["view_mask"], mask = mask, None
    return cameras


def _colmap_camera(words: Sequence[str]) -> Table:
    """Return the camera of a line: id, model, width, height, parameters."""
    if len(words) < 4:
        raise InputError(f"{len(words)} words; must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    number(words[0], "CAMERA_ID", whole=True)
    model = words[1]
    if model not in COLMAP_MODELS:
        reason = "simtest lacks this lens" if model in OTHER_MODELS else "unknown camera model"
        allowed = f"{', '.join(COLMAP_MODELS)}{suggestion(model, COLMAP_MODELS)}"
        raise InputError(f"{model}: {reason}; must be one of {allowed}")
    width, height = int(number(words[2], "WIDTH", whole=True)), int(number(words[3], "HEIGHT", whole=True))
    # the principal point comes after the focal lengths
    names = list(COLMAP_MODELS[model])
    first = 1 if names[0] == "f" else 2
    names[first:first] = ["cx", "cy"]
    if len(words) - 4 != len(names):
        raise InputError(f"{model}: {len(words) - 4} parameters; must be {len(names)}: {', '.join(names)}")
    told = {name: number(word, name) for name, word in zip(names, words[4:], strict=True)}
    if "f" in told:
        told["fx"] = told["fy"] = told.pop("f")
    fx, fy, cx, cy = (told.pop(name) for name in ("fx", "fy", "cx", "cy"))
    return plain_table((width, height), (fx, fy), (cx, cy), distortion=lens_table("FISHEYE" in model, told))


@of_text("pose", "record_bytes")
def read_images(text: str) -> Poses:
    """Read world_from_camera of each image of images.txt, in its unit; raise `InputError` where it is malformed."""
    poses: list[tuple[str, Array]] = []
    # Each image has two lines, of which the second, its points, may be empty.
    points_follow = False
    for count, line in enumerate(text.splitlines(), 1):
        words, at = line.split(), f"line {count}"
        if points_follow:
            points_follow = False
            if len(words) % 3:
                raise InputError(f"{at}: must hold an image's points, three words each, or be empty")
        elif words and not words[0].startswith("#"):
            poses.append((words[-1], _pose(words, at)))
            points_follow = True
    return poses


def _pose(words: Sequence[str], at: str) -> Array:
    """Return world_from_camera of an image's line."""
    if len(words) != 10:
        raise InputError(f"{at}: {len(words)} words; must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
    names = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID")
    with within(at):
        told = [number(word, name) for name, word in zip(names, words, strict=False)]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(np.array(told[1:5]), at), told[5:8]
    return inverse(T)


def colmap_files(camera: Camera, path: Path, poses: Poses | None) -> Files:
    """Return a camera as cameras.txt, and poses, lengths in mm, as images.txt beside an empty points3D.txt."""
    files = {path: _cameras_text(camera).encode()}
    if poses is not None:
        points = path.with_name("points3D.txt")
        files |= {path.with_name("images.txt"): _images_text(poses).encode(), points: POINTS_TEXT.encode()}
        _check_no_points(points)
    return files


def _check_no_points(path: Path) -> None:
    """Raise `InputError` where a model's own points would give way to an empty list."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return
    if any(line.strip() and not line.startswith(b"#") for line in head.splitlines()):
        raise InputError(f"{path}: exists and holds points; poses must go to a folder without them")


def _cameras_text(camera: Camera) -> str:
    """Return a camera as the text of cameras.txt, under the id 1."""
    lens, mask = camera.distortion, camera.view_mask
    check_no_skew(camera, "COLMAP has none")
    model = "PINHOLE"
    if isinstance(lens, KannalaBrandt):
        model = "OPENCV_FISHEYE"
    elif isinstance(lens, BrownConrady):
        model = "FULL_OPENCV" if lens.k3 or lens.k4 or lens.k5 or lens.k6 else "OPENCV"
    elif lens is not None:
        raise InputError(f"camera.distortion: COLMAP has no {type(lens).__name__} lens; save as TOML instead")
    told = [camera.fx, camera.fy, camera.cx, camera.cy]
    told += coefficients(lens, COLMAP_MODELS[model][2:]) if lens is not None else []
    words = ["1", model, str(camera.width), str(camera.height), *(repr(float(value)) for value in told)]
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    if mask is not None:
        lines.append(MASK + mask_text(mask))
    return "\n".join([*lines, " ".join(words), ""])


def _images_text(poses: Poses) -> str:
    """Return poses, whose lengths must be mm, as the text of images.txt, all of camera 1, without points."""
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
        "# unit: mm",
    ]
    for index, (name, world_from_camera) in enumerate(poses, 1):
        if not name or name.split() != [name]:
            raise InputError(f"frame {name!r}: must be a name without spaces, since COLMAP reads one word")
        T = inverse(np.asarray(world_from_camera, dtype=float))
        told = [*quaternion_of(T[:3, :3]), *T[:3, 3]]
        lines += [f"{index} {' '.join(repr(float(value)) for value in told)} 1 {name}", ""]
    return "\n".join([*lines, ""])


@of_text(limit="record_bytes")
def read_transforms(text: str) -> dict[str, Table]:
    """Read the camera, or those of the frames where they have their own, by file_path."""
    data = json_object(text)
    frames = _frames(data)
    if not any(set(frame) & set(INTRINSICS) for frame in frames):
        return {"": _nerf_camera(data)}
    cameras: dict[str, Table] = {}
    for i, frame in enumerate(frames):
        with within(f"frames[{i}]"):
            name, camera = _name(frame), _nerf_camera(_of_frame(data, frame))
            if cameras.setdefault(name, camera) != camera:
                raise InputError(f"file_path {name} has two cameras; must have one")
    return cameras


@of_text(limit="record_bytes")
def transforms_poses(text: str) -> Poses:
    """Read world_from_camera of the frames, by file_path, with OpenCV's camera axes, in the file's unit of length."""
    made: list[tuple[str, Array]] = []
    for i, frame in enumerate(_frames(json_object(text))):
        with within(f"frames[{i}]"):
            if "transform_matrix" not in frame:
                raise InputError("transform_matrix: missing; must be 4 rows of 4 numbers")
            made.append((_name(frame), rigid(frame["transform_matrix"], "transform_matrix") @ GL_FROM_CV))
    return made


def _frames(data: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    frames = data.get("frames", [])
    if not isinstance(frames, list) or not all(isinstance(frame, Mapping) for frame in frames):
        raise InputError(f"frames = {frames!r:.60}: must be a list of objects")
    return frames


def _of_frame(data: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return the file's keys with those of a frame in their place: a focal length also replaces the file's angle."""
    told = {key for key in frame if frame[key] is not None}
    replaced = {key for pair in FOCAL_KEYS for key in pair if told & set(pair)}
    return {key: value for key, value in data.items() if key not in replaced} | dict(frame)


def _name(frame: Mapping[str, Any]) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise InputError(f"file_path = {name!r:.60}: must name a picture")
    return name


def _nerf_camera(data: Mapping[str, Any]) -> Table:
    """Return the camera that keys describe."""
    told = {key: number(data[key], key) for key in INTRINSICS if data.get(key) is not None}
    for key in ("w", "h"):
        if key not in told:
            raise InputError(f"{key}: missing; a camera needs the size of its pictures, px")
        number(told[key], key, whole=True)
    width, height = int(told["w"]), int(told["h"])
    lens = _nerf_lens(data, told)
    # The angle that a fisheye spans does not follow from its focal length alone.
    both = lens is None or lens["type"] != "kannala_brandt"
    fx = _nerf_focal(told, FOCAL_KEYS[0], width, both)
    fy = fx if not set(FOCAL_KEYS[1]) & set(told) else _nerf_focal(told, FOCAL_KEYS[1], height, both)
    centre = told.get("cx", width / 2), told.get("cy", height / 2)
    return plain_table((width, height), (fx, fy), centre, distortion=lens, view_mask=data.get("view_mask"))


def _nerf_focal(told: Mapping[str, float], keys: tuple[str, str], extent: int, both: bool) -> float:
    """Return a focal length, px, given itself or by the angle, rad, that the picture spans; compare these if `both`."""
    focal, angle = keys
    if angle not in told:
        if focal not in told:
            raise InputError(f"{focal}: missing; must be given, or {angle}")
        return told[focal]
    if not 0 < told[angle] < math.pi:
        raise InputError(f"{angle} = {told[angle]:g}: must be 0 to pi, rad")
    spanned = extent / 2 / math.tan(told[angle] / 2)
    if focal in told and both:
        check_alike(keys, told[focal], spanned)
    return told.get(focal, spanned)


def _nerf_lens(data: Mapping[str, Any], told: Mapping[str, float]) -> Table | None:
    """Return the lens as a table; None for a pinhole."""
    model = data.get("camera_model")
    if model is None and str(data.get("model")) in NERF_MODELS:
        raise InputError(f"model = {data['model']!r}: transforms.json names its lens camera_model")
    if model is not None and (not isinstance(model, str) or model not in NERF_MODELS):
        hint = suggestion(model, NERF_MODELS) if isinstance(model, str) else ""
        raise InputError(
            f"camera_model = {model!r:.40}: simtest lacks it; must be one of {', '.join(NERF_MODELS)}{hint}"
        )
    told_fisheye = data.get("is_fisheye", False)
    if told_fisheye not in (False, True, None):
        raise InputError(f"is_fisheye = {told_fisheye!r:.40}: must be true or false")
    fisheye = bool(told_fisheye) if model is None else NERF_MODELS[model]
    if told_fisheye is not None and "is_fisheye" in data and bool(told_fisheye) != fisheye:
        raise InputError(f"is_fisheye = {told_fisheye}: does not fit camera_model = {model!r}")
    if not fisheye and told.get("k4"):
        raise InputError(f"k4 = {told['k4']:g}: must be 0; simtest's perspective lens has no term r^8")
    names = FISHEYE if fisheye else BROWN[:5]
    return lens_table(fisheye, {key: told.get(key, 0.0) for key in names})


def transforms_file(camera: Camera, path: Path, poses: Poses | None) -> Files:
    """Return a camera, and poses of its frames, whose lengths must be mm, as transforms.json."""
    lens, name = camera.distortion, "transforms.json"
    check_no_skew(camera, f"{name} has none")
    data: dict[str, Any] = {"camera_model": "PINHOLE"}
    if isinstance(lens, KannalaBrandt):
        data = {"camera_model": "OPENCV_FISHEYE", **{key: getattr(lens, key) for key in FISHEYE}}
    elif isinstance(lens, BrownConrady):
        if lens.k4 or lens.k5 or lens.k6:
            raise InputError(f"camera.distortion: k4, k5, k6 must be 0, since {name} lacks them; save as TOML instead")
        data = {"camera_model": "OPENCV", **{key: getattr(lens, key) for key in BROWN[:5]}}
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
    return {path: (json.dumps(data, indent=2) + "\n").encode()}
