"""COLMAP's text files: cameras.txt, and images.txt beside it.

The centre of the first pixel is (0.5, 0.5), as in simtest. Camera axes are OpenCV's. A line of images.txt holds
camera_from_world: a quaternion w x y z, then a translation in the reconstruction's unit.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.distortion import BrownConrady, KannalaBrandt
from simtest.geometry.quaternions import quaternion_of, rotation_of
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import suggestion
from simtest.spec.camera_formats.common import Poses, Table, inverse, mask_of_text, mask_text, number
from simtest.spec.toml_files import read_text

MODELS: dict[str, tuple[str, ...]] = {
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

UNKNOWN_MODELS = (
    "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "EUCM", "EQUIRECTANGULAR",
)  # fmt: skip
"""Models of COLMAP whose lenses simtest lacks."""

MASK = "# simtest view_mask "
"""Comment that holds the view mask, which COLMAP does not know."""


def read_cameras(path: Path) -> dict[str, Table]:
    """Read cameras.txt as tables of `CameraSpec` by camera id; raise `InputError` where it is malformed."""
    where = str(path)
    cameras: dict[str, Table] = {}
    mask: Table | None = None
    for count, line in enumerate(read_text(path, "camera").splitlines(), 1):
        at, words = f"{where}: line {count}", line.split()
        if line.startswith(MASK):
            mask = mask_of_text(line.removeprefix(MASK), at)
        if not words or words[0].startswith("#"):
            continue
        name = words[0]
        if name in cameras:
            raise InputError(f"{at}: camera {name} is given twice")
        cameras[name] = _camera(words, at)
        if mask is not None:
            cameras[name]["view_mask"], mask = mask, None
    return cameras


def _camera(words: Sequence[str], at: str) -> Table:
    """Return the camera of a line: id, model, width, height, parameters."""
    if len(words) < 4:
        raise InputError(f"{at}: {len(words)} words; must be CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    number(words[0], at, "CAMERA_ID", whole=True)
    model = words[1]
    if model not in MODELS:
        reason = "simtest lacks this lens" if model in UNKNOWN_MODELS else "unknown camera model"
        raise InputError(f"{at}: {model}: {reason}; must be one of {', '.join(MODELS)}{suggestion(model, MODELS)}")
    width, height = int(number(words[2], at, "WIDTH", whole=True)), int(number(words[3], at, "HEIGHT", whole=True))
    # the principal point comes after the focal lengths
    names = list(MODELS[model])
    first = 1 if names[0] == "f" else 2
    names[first:first] = ["cx", "cy"]
    if len(words) - 4 != len(names):
        raise InputError(f"{at}: {model}: {len(words) - 4} parameters; must be {len(names)}: {', '.join(names)}")
    told = {name: number(word, at, name) for name, word in zip(names, words[4:], strict=True)}
    if "f" in told:
        told["fx"] = told["fy"] = told.pop("f")
    table: Table = {"width": width, "height": height}
    table |= {name: told.pop(name) for name in ("fx", "fy", "cx", "cy")}
    if "FISHEYE" in model:
        table["distortion"] = {"type": "kannala_brandt", **told}
    elif any(told.values()):
        table["distortion"] = {"type": "brown_conrady", **told}
    return table


def read_images(path: Path) -> Poses:
    """Read world_from_camera of each image of images.txt, in its unit; raise `InputError` where it is malformed."""
    where = str(path)
    poses: list[tuple[str, Array]] = []
    # Each image has two lines, of which the second, its points, may be empty.
    points_follow = False
    for count, line in enumerate(read_text(path, "pose", "record_bytes").splitlines(), 1):
        if points_follow:
            points_follow = False
            if len(line.split()) % 3:
                raise InputError(f"{where}: line {count}: must hold an image's points, three words each, or be empty")
            continue
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        at = f"{where}: line {count}"
        if len(words) != 10:
            raise InputError(f"{at}: {len(words)} words; must be IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")
        names = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID")
        told = [number(word, at, name) for name, word in zip(names, words, strict=False)]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation_of(np.array(told[1:5]), at), told[5:8]
        poses.append((words[9], inverse(T)))
        points_follow = True
    return poses


# Writing ---------------------------------------------------------------------------------------------------------


def cameras_text(camera: Camera) -> str:
    """Return a camera as the text of cameras.txt, under the id 1; raise `InputError` where COLMAP has no such lens."""
    lens, mask = camera.distortion, camera.view_mask
    if camera.skew != 0:
        raise InputError(f"camera.skew = {camera.skew:g}: must be 0, since COLMAP has none; save as TOML instead")
    model = "PINHOLE"
    if isinstance(lens, KannalaBrandt):
        model = "OPENCV_FISHEYE"
    elif isinstance(lens, BrownConrady):
        model = "FULL_OPENCV" if lens.k3 or lens.k4 or lens.k5 or lens.k6 else "OPENCV"
    elif lens is not None:
        raise InputError(f"camera.distortion: COLMAP has no {type(lens).__name__} lens; save as TOML instead")
    told = [camera.fx, camera.fy, camera.cx, camera.cy]
    told += [getattr(lens, name) for name in MODELS[model][2:]]
    words = ["1", model, str(camera.width), str(camera.height), *(repr(float(value)) for value in told)]
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    if mask is not None:
        lines.append(MASK + mask_text(mask))
    return "\n".join([*lines, " ".join(words), ""])


def images_text(poses: Poses) -> str:
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


POINTS_TEXT = "# 3D point list with one line of data per point:\n"
"""An empty points3D.txt, without which COLMAP loads no model."""
