"""Camera files of OpenCV (FileStorage: YAML, XML, JSON) and ROS (camera_info), read and written; Kalibr's chains, read.

For all the centre of the first pixel is (0, 0), for simtest (0.5, 0.5): the principal point gains half a pixel on
import and loses it on export. A chain of Kalibr (camchain.yaml) is of several cameras, and says where each is beside
the one before; its lengths are metres.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt, Scaramuzza
from simtest.runtime.arrays import Array
from simtest.spec.camera_formats.common import (
    BROWN,
    FISHEYE,
    Files,
    Poses,
    Table,
    check_no_skew,
    coefficients,
    inverse,
    lens_table,
    number,
    numbers,
    of_text,
    once,
    parse_json,
    parse_xml,
    plain_table,
    rigid,
    syntax,
    within,
)
from simtest.spec.camera_formats.plain_yaml import parse_yaml
from simtest.spec.toml_files import read_text

MATRIX_NAMES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "mtx", "K", "k")

LENS_NAMES = ("distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "dist", "D", "d")

WIDTH_NAMES = ("image_width", "image_Width", "imageWidth", "width")

HEIGHT_NAMES = ("image_height", "image_Height", "imageHeight", "height")

SIZE_NAMES = ("image_size", "imageSize", "image_resolution")

MODELS = {
    "plumb_bob": False, "radtan": False, "brown_conrady": False, "rational_polynomial": False,
    "equidistant": True, "fisheye": True, "kannala_brandt": True,
}  # fmt: skip
"""Names of lens models, and whether each is a fisheye."""

NUMBER_TYPES = ("d", "f", "i")
"""Of a FileStorage matrix: double, float, integers of 32 bits."""

UNKNOWN_TERMS = ("s1", "s2", "s3", "s4", "tauX", "tauY")
"""Coefficients 9 to 14 of OpenCV: thin prism and tilted sensor, which simtest lacks."""

KALIBR_CAMERA = re.compile(r"cam\d+")

LENSES = ("none", "radtan", "equidistant", "equi")

MM = 1000.0


def read_opencv(path: Path) -> dict[str, Table]:
    """Read a calibration of OpenCV or ROS (.yml, .yaml, .xml, .json): its one camera, whose id is empty."""
    text = read_text(path, "camera")
    with within(str(path)):
        return {"": _table(_parse(text, path.suffix.lower()))}


def _table(data: Mapping[str, Any]) -> Table:
    """Return the camera of a file's keys."""
    size = _size(data)
    # K, upper triangular
    name, given = _one_of(data, MATRIX_NAMES)
    if name is None:
        raise InputError(f"camera_matrix: missing; allowed names: {', '.join(MATRIX_NAMES)}")
    matrix = np.array(_numbers(given, name, (9,), (3, 3))).reshape(3, 3)
    if not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(f"{name} = {matrix.tolist()}: must be upper triangular with 1 in its last corner")
    _check_whole(data)
    # lens and view mask
    skew, lens = float(matrix[0, 1]), _lens(data)
    table = plain_table(
        size, (matrix[0, 0], matrix[1, 1]), matrix[:2, 2].tolist(), PIXEL_CENTRE, skew=skew, distortion=lens
    )
    if "view_mask" in data:
        cx, cy, radius = _numbers(data["view_mask"], "view_mask", (3,))
        table["view_mask"] = {"cx": cx + PIXEL_CENTRE, "cy": cy + PIXEL_CENTRE, "radius": radius}
    return table


def _parse(text: str, suffix: str) -> Mapping[str, Any]:
    """Read a text into plain dicts, lists, numbers and text."""
    kind = {".json": "JSON", ".xml": "XML"}.get(suffix) or ("XML" if text.startswith("<") else "YAML")
    parsers = {"JSON": parse_json, "XML": lambda text: _plain_xml(parse_xml(text)), "YAML": parse_yaml}
    with syntax(kind):
        data = parsers[kind](text)
    if not isinstance(data, Mapping) or not data:
        raise InputError("holds no keys; must be a calibration of OpenCV or ROS")
    return data


def _plain_xml(element: ElementTree.Element) -> Any:
    children = list(element)
    if children:
        if all(child.tag == "_" for child in children):
            return [_plain_xml(child) for child in children]
        return once([(child.tag, _plain_xml(child)) for child in children])
    words = (element.text or "").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        return " ".join(words).strip('"')
    return values[0] if len(values) == 1 else values


def _one_of(data: Mapping[str, Any], names: Sequence[str]) -> tuple[str | None, Any]:
    found = [name for name in names if name in data]
    if len(found) > 1:
        raise InputError(f"{found[1]}: given beside {found[0]}; only one of them is allowed")
    return (found[0], data[found[0]]) if found else (None, None)


def _numbers(value: Any, name: str, counts: Sequence[int], shape: tuple[int, int] | None = None) -> list[float]:
    """Return a matrix or list as numbers in row order.

    `counts` are the allowed numbers of values; `shape` is that of a matrix, by default one row or one column.
    """
    if isinstance(value, Mapping):
        _check_matrix(value, name, shape)
        value = value.get("data")
    elif isinstance(value, list) and shape is not None and any(isinstance(row, list) for row in value):
        lengths = [len(row) if isinstance(row, list) else 1 for row in value]
        if lengths != [shape[1]] * shape[0]:
            raise InputError(f"{name}: rows of {lengths} values; must be {shape[0]} rows of {shape[1]}")
    # A FileStorage matrix holds its numbers flat, plain JSON and YAML row by row.
    flat: list[Any] = []
    for item in value if isinstance(value, list) else [value]:
        flat += item if isinstance(item, list) else [item]
    wrong = next((item for item in flat if isinstance(item, bool) or not isinstance(item, int | float)), None)
    if not isinstance(value, list) or wrong is not None:
        raise InputError(f"{name} = {value!r:.80}: must be a matrix or a list of numbers")
    if len(flat) not in counts:
        allowed = " or ".join(str(count) for count in counts)
        raise InputError(f"{name}: {len(flat)} values; must be {allowed}")
    return [float(item) for item in flat]


def _check_matrix(matrix: Mapping[str, Any], name: str, shape: tuple[int, int] | None) -> None:
    """Check what a matrix says of itself: its rows and columns, and the type of its numbers."""
    said = [matrix.get(key) for key in ("rows", "cols")]
    if said != [None, None]:
        sizes = [int(n) for n in said if isinstance(n, int | float) and not isinstance(n, bool) and n == n // 1]
        if len(sizes) < 2 or not (sizes == list(shape) if shape is not None else min(sizes) in (0, 1)):
            wanted = "one row or one column" if shape is None else f"{shape[0]} x {shape[1]}"
            raise InputError(f"{name}: {said[0]!r} rows and {said[1]!r} cols; must be {wanted}")
        held = matrix.get("data")
        if isinstance(held, list) and len(held) != sizes[0] * sizes[1]:
            raise InputError(f"{name}: {len(held)} values; must be {sizes[0]} x {sizes[1]}")
    # Integers of 8 bits hold no focal length, and several channels no matrix.
    if (kind := matrix.get("dt")) not in (None, *NUMBER_TYPES):
        raise InputError(f"{name}: dt = {kind}: must be one of {', '.join(NUMBER_TYPES)}")


def _size(data: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the image's width and height; the schema checks their ranges."""
    name, both = _one_of(data, SIZE_NAMES)
    if name is not None:
        width, height = _numbers(both, name, (2,))
        for names, told in ((WIDTH_NAMES, width), (HEIGHT_NAMES, height)):
            other, value = _one_of(data, names)
            if other is not None and value != told:
                raise InputError(f"{other} = {value!r:.40}: does not fit {name}, which says {told:g}")
        return width, height
    found = []
    for names in (WIDTH_NAMES, HEIGHT_NAMES):
        name, value = _one_of(data, names)
        if name is None:
            raise InputError(f"{names[0]}: missing; a camera needs the size of its images, px")
        found.append(value)
    return found[0], found[1]


def _check_whole(data: Mapping[str, Any]) -> None:
    """Refuse a camera_info of cropped or binned images: K does not belong to them."""
    for key in ("binning_x", "binning_y"):
        if data.get(key, 0) not in (0, 1):
            raise InputError(f"{key} = {data[key]!r}: must be 0 or 1; calibrate at the size that is used")
    roi = data.get("roi")
    roi = roi if isinstance(roi, Mapping) else {}
    for key in ("x_offset", "y_offset", "width", "height"):
        if roi.get(key, 0) != 0:
            raise InputError(f"roi.{key} = {roi[key]!r}: must be 0; calibrate at the size that is used")


def _lens(data: Mapping[str, Any]) -> dict[str, str | float] | None:
    """Return the lens as the table of a `DistortionSpec`; None for a pinhole."""
    name, value = _one_of(data, LENS_NAMES)
    fisheye, model = _is_fisheye(data), (data.get("distortion_model") or "").lower()
    if "xi" in data:
        # Without it the other numbers mean another lens.
        raise InputError("xi: simtest lacks the lens of OpenCV's omnidir module; calibrate as a fisheye")
    if name is None:
        _check_no_other_lens(data)
    # no coefficients
    if name is None or value in (None, []) or (isinstance(value, Mapping) and not value.get("data")):
        if fisheye:
            raise InputError(f"{LENS_NAMES[0]}: missing; a fisheye has 4 coefficients")
        return None
    # Kannala-Brandt
    if fisheye:
        return lens_table(fisheye, dict(zip(FISHEYE, _numbers(value, name, (4,)), strict=True)))
    # Brown-Conrady: which counts are possible depends on the model, if one is named.
    counts = {"plumb_bob": (4, 5), "radtan": (4, 5), "rational_polynomial": (8, 12, 14)}.get(model, (4, 5, 8, 12, 14))
    values = _numbers(value, name, counts)
    # Terms that simtest lacks must vanish.
    for term, amount in zip(UNKNOWN_TERMS, values[8:], strict=False):
        if amount != 0:
            kind = "tilted sensor" if term.startswith("tau") else "thin prism"
            raise InputError(f"{name}: {term} = {amount:g} ({kind}): must be 0; simtest does not know that term")
    return lens_table(fisheye, dict(zip(BROWN, values, strict=False)))


def _check_no_other_lens(data: Mapping[str, Any]) -> None:
    """Refuse a file that mentions a lens but has no coefficients under a known name."""
    key = next((k for k in data if k.lower().startswith("dist") and (k != "distortion_model" or data[k])), None)
    if key is not None:
        raise InputError(
            f"{key} = {data[key]!r:.60}: speaks of a lens whose coefficients are missing; "
            f"allowed names: {', '.join(LENS_NAMES)}"
        )


def _is_fisheye(data: Mapping[str, Any]) -> bool:
    model, flag = data.get("distortion_model"), data.get("fisheye_model")
    if flag not in (None, 0, 1):
        raise InputError(f"fisheye_model = {flag!r:.40}: must be 0 or 1")
    if model in (None, ""):
        return bool(flag)
    if not isinstance(model, str) or model.lower() not in MODELS:
        raise InputError(f"distortion_model = {model!r:.60}: must be one of {', '.join(MODELS)}")
    fisheye = MODELS[model.lower()]
    if flag is not None and bool(flag) != fisheye:
        raise InputError(f"fisheye_model = {flag!r}: does not fit distortion_model = {model!r}")
    return fisheye


def opencv_file(camera: Camera, path: Path, _: Poses | None) -> Files:
    """Return a camera as an OpenCV FileStorage; the file's suffix selects YAML, XML or JSON."""
    matrix, coefficients = _shifted(camera, "OpenCV")
    kinds = {".xml": cv2.FILE_STORAGE_FORMAT_XML, ".json": cv2.FILE_STORAGE_FORMAT_JSON}
    flags = (
        cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | kinds.get(path.suffix.lower(), cv2.FILE_STORAGE_FORMAT_YAML)
    )
    storage = cv2.FileStorage()
    storage.open("", flags)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    if isinstance(camera.distortion, KannalaBrandt):
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", np.array([coefficients]))
    if (mask := _shifted_mask(camera)) is not None:
        storage.write("view_mask", np.array([mask]))
    return {path: str(storage.releaseAndGetString()).encode()}


def ros_file(camera: Camera, path: Path, _: Poses | None) -> Files:
    """Return a camera as a ROS camera_info file (YAML); see `opencv_file`."""
    matrix, coefficients = _shifted(camera, "ROS")
    model = "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
    model = "equidistant" if isinstance(camera.distortion, KannalaBrandt) else model

    def block(name: str, values: Any) -> list[str]:
        rows = np.atleast_2d(values)
        data = ", ".join(repr(float(v)) for v in rows.ravel())
        return [f"{name}:", f"  rows: {rows.shape[0]}", f"  cols: {rows.shape[1]}", f"  data: [{data}]"]

    lines = [
        f"image_width: {camera.width}", f"image_height: {camera.height}", "camera_name: simtest",
        *block("camera_matrix", matrix), f"distortion_model: {model}", *block("distortion_coefficients", coefficients),
        *block("rectification_matrix", np.eye(3)), *block("projection_matrix", np.pad(matrix, ((0, 0), (0, 1)))),
    ]  # fmt: skip
    if (mask := _shifted_mask(camera)) is not None:
        lines.append(f"view_mask: [{', '.join(repr(v) for v in mask)}]")
    return {path: ("\n".join(lines) + "\n").encode()}


def _shifted(camera: Camera, whose: str) -> tuple[Any, list[float]]:
    """Return K and the coefficients in the other convention; raise `InputError` for a skew."""
    check_no_skew(camera, f"{whose} ignores it")
    matrix = camera.K - np.array([[0, 0, PIXEL_CENTRE], [0, 0, PIXEL_CENTRE], [0, 0, 0]])
    lens = camera.distortion
    if isinstance(lens, Scaramuzza):
        raise InputError(f"camera.distortion: {whose} has no Scaramuzza lens; save as TOML or for MATLAB instead")
    if isinstance(lens, KannalaBrandt):
        return matrix, coefficients(lens, FISHEYE)
    values = coefficients(lens or BrownConrady(), BROWN)
    return matrix, values if any(values[5:]) else values[:5]


def _shifted_mask(camera: Camera) -> list[float] | None:
    """Return the view mask's centre and radius in the other convention; OpenCV and ROS skip a key that they lack."""
    mask = camera.view_mask
    if mask is None:
        return None
    if mask.corner is not None:
        corner = f"camera.view_mask.corner = {mask.corner:g}"
        raise InputError(f"{corner}: OpenCV and ROS know round views alone; must be left out, or saved as TOML")
    return [float(mask.cx) - PIXEL_CENTRE, float(mask.cy) - PIXEL_CENTRE, float(mask.radius)]


@of_text()
def read_kalibr(text: str) -> dict[str, Table]:
    """Read the cameras of a chain by name (cam0, cam1, ...); raise `InputError` where it is malformed."""
    cameras: dict[str, Table] = {}
    for name, data in _chain(text).items():
        with within(name):
            cameras[name] = _kalibr_camera(data)
    return cameras


@of_text()
def kalibr_poses(text: str) -> Poses:
    """Return where the cameras of a chain are: cam0_from_camera, shape (4, 4), lengths mm, named by camera."""
    made: list[tuple[str, Array]] = []
    first_from_camera = np.eye(4)
    for i, (name, data) in enumerate(_chain(text).items()):
        with within(name):
            if i and "T_cn_cnm1" not in data:
                raise InputError("T_cn_cnm1: missing; must be 4 rows of 4 numbers")
            if i:
                step = rigid(data["T_cn_cnm1"], "T_cn_cnm1")
                step[:3, 3] *= MM
                first_from_camera = first_from_camera @ inverse(step)
        made.append((name, first_from_camera.copy()))
    return made


def _chain(text: str) -> dict[str, Mapping[str, Any]]:
    with syntax("YAML"):
        data = parse_yaml(text)
    items = data.items() if isinstance(data, Mapping) else ()
    found = {name: value for name, value in items if KALIBR_CAMERA.fullmatch(name)}
    if not found:
        raise InputError("holds no camera; must have the keys cam0, cam1, ...")
    for name, value in found.items():
        if not isinstance(value, Mapping):
            raise InputError(f"{name} = {value!r:.60}: must be a table of keys")
    return dict(sorted(found.items(), key=lambda item: int(item[0][3:])))


def _kalibr_camera(data: Mapping[str, Any]) -> Table:
    model = data.get("camera_model")
    if model != "pinhole":
        raise InputError(f"camera_model = {model!r:.40}: simtest lacks it; must be pinhole")
    fx, fy, cx, cy = numbers(data.get("intrinsics"), "intrinsics", 4)
    width, height = numbers(data.get("resolution"), "resolution", 2)
    size = [int(number(side, "resolution", whole=True)) for side in (width, height)]
    return plain_table(size, (fx, fy), (cx, cy), PIXEL_CENTRE, distortion=_kalibr_lens(data))


def _kalibr_lens(data: Mapping[str, Any]) -> Table | None:
    """Return the lens as the table of a `DistortionSpec`; None for a pinhole."""
    name = data.get("distortion_model", "none")
    if name not in LENSES:
        raise InputError(f"distortion_model = {name!r:.40}: simtest lacks it; must be one of {', '.join(LENSES)}")
    if name == "none":
        return None
    fisheye, told = name != "radtan", numbers(data.get("distortion_coeffs"), "distortion_coeffs", 4)
    return lens_table(fisheye, dict(zip(FISHEYE if fisheye else BROWN, told, strict=False)))
