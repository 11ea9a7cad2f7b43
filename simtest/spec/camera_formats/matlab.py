"""Camera files of MATLAB: structs of cameraParameters or fisheyeIntrinsics, saved in a .mat file of version 7 or older.

For MATLAB the centre of the first pixel is (1, 1), for simtest (0.5, 0.5): the principal point loses half a pixel.
The struct is read in a process of its own: SciPy crashes over some damaged files, and takes gigabytes over others.
"""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt, Scaramuzza
from simtest.runtime.files import require_plain
from simtest.runtime.processes import call_apart
from simtest.spec.camera_formats.common import (
    Files,
    Poses,
    Table,
    check_alike,
    lens_table,
    mask_of_text,
    mask_text,
    number,
    plain_table,
    within,
)
from simtest.spec.camera_formats.omnidirectional import scaramuzza_table

HOW = "in MATLAB: s = toStruct(cameraParams); save('camera.mat', 's', '-v7')"

FIELDS = (
    "K", "IntrinsicMatrix", "ImageSize", "RadialDistortion", "TangentialDistortion", "MappingCoefficients",
    "DistortionCenter", "StretchMatrix", "ViewMask", "FocalLength", "PrincipalPoint",
)  # fmt: skip
"""What is read of a struct."""

MOST_NUMBERS = 100
"""Of a field; more are no part of a camera."""

MEMORY_BYTES = 1e9
"""A calibration takes kilobytes; the file may hold other variables beside it."""

PARAMETERS = ((1, 1), (1, 3), (2, 2), (2, 3))
"""Rows and columns of fx, cx, fy, cy in K, as MATLAB counts."""


def read_matlab(path: Path) -> dict[str, Table]:
    """Read a calibration of MATLAB: its one camera, whose id is empty.

    The .mat file holds one struct, under any name, with IntrinsicMatrix (transposed, as MATLAB has it) or K, ImageSize,
    RadialDistortion and TangentialDistortion; or, of a fisheye, with MappingCoefficients, StretchMatrix,
    DistortionCenter and ImageSize.
    """
    fields = read_struct(path)
    with within(str(path)):
        return {"": _table(fields)}


def _table(fields: Mapping[str, Any]) -> Table:
    """Return the camera of a struct's fields."""
    mask = mask_of_text(fields["ViewMask"]) if "ViewMask" in fields else None
    if "MappingCoefficients" in fields:
        return _fisheye(fields) | {"view_mask": mask}
    matrix = _matrix(fields, "K") if "K" in fields else _matrix(fields, "IntrinsicMatrix").T
    _check_repeated(fields, matrix)
    # upper triangular
    if not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(f"IntrinsicMatrix or K = {matrix.tolist()}: must be triangular with 1 in its corner")
    height, width = _array(fields, "ImageSize", 2).tolist()
    # Two or three radial coefficients, in OpenCV's order k1 k2 p1 p2 k3 with the tangential ones
    radial = _array(fields, "RadialDistortion", (2, 3)).tolist()
    tangential = _array(fields, "TangentialDistortion", 2).tolist()
    lens = dict(zip(("k1", "k2", "k3", "p1", "p2"), [*radial, 0.0][:3] + tangential, strict=True))
    (fx, skew, cx), (_, fy, cy), _ = matrix.tolist()
    told = {"skew": skew, "distortion": lens_table(False, lens), "view_mask": mask}
    return plain_table((width, height), (fx, fy), (cx, cy), -PIXEL_CENTRE, **told)


def _check_repeated(fields: Mapping[str, Any], matrix: Any) -> None:
    """Raise `InputError` where other fields do not repeat what the camera matrix says."""
    (fx, _, cx), (_, fy, cy), _ = matrix
    name = "K" if "K" in fields else "IntrinsicMatrix"
    said = [
        (f"{field}({index})", told, other)
        for field, own in (("FocalLength", (fx, fy)), ("PrincipalPoint", (cx, cy)))
        if field in fields
        for index, (told, other) in enumerate(zip(_array(fields, field, 2), own, strict=True), 1)
    ]
    if name == "K" and "IntrinsicMatrix" in fields:
        other = _matrix(fields, "IntrinsicMatrix")
        said += [(f"IntrinsicMatrix({c},{r})", other[c - 1, r - 1], matrix[r - 1, c - 1]) for r, c in PARAMETERS]
    for field, told, own in said:
        check_alike((field, name), float(told), float(own))


def _fisheye(fields: Mapping[str, Any]) -> Table:
    """Return a fisheyeIntrinsics: Scaramuzza's model with x before y."""
    mapping = _array(fields, "MappingCoefficients", 4).tolist()
    height, width = (number(value, "ImageSize", whole=True) for value in _array(fields, "ImageSize", 2).tolist())
    x, y = _array(fields, "DistortionCenter", 2).tolist()
    c, d, e, one = _array(fields, "StretchMatrix", 4).tolist() if "StretchMatrix" in fields else (1, 0, 0, 1)
    if one != 1:
        raise InputError(f"StretchMatrix = {[[c, d], [e, one]]}: must have 1 in its last corner")
    return scaramuzza_table((width, height), (x - PIXEL_CENTRE, y - PIXEL_CENTRE), mapping, (c, d, e))


def _matrix(fields: Mapping[str, Any], name: str) -> Any:
    """Return a field of 3 x 3 numbers."""
    values = _array(fields, name, 9)
    if np.shape(fields[name]) != (3, 3):
        raise InputError(f"{name}: has shape {np.shape(fields[name])}; must be (3, 3)")
    return values.reshape(3, 3)


def _array(fields: Mapping[str, Any], name: str, counts: int | tuple[int, ...]) -> Any:
    """Return a field as numbers in row order."""
    allowed = (counts,) if isinstance(counts, int) else counts
    if name not in fields:
        raise InputError(f"{name}: missing; {HOW}")
    value = np.asarray(fields[name])
    if value.dtype.kind not in "iuf" or value.size not in allowed:
        said = " or ".join(str(count) for count in allowed)
        raise InputError(f"{name} = {fields[name]!r:.80}: must be {said} numbers")
    return value.astype(float).ravel()


def read_struct(path: Path) -> Mapping[str, Any]:
    """Read the fields of the one struct in a .mat file that is a calibration: numbers, text and nested lists."""
    require_plain(path, None, "a .mat file")
    breakdown = f"a damaged MATLAB file: SciPy breaks down over it; {HOW}"
    return call_apart(struct_of, path, MEMORY_BYTES, "MATLAB file", breakdown)


def struct_of(path: str) -> dict[str, Any]:
    """Return the fields of the struct, read in this process; raise `InputError`, without the file's name."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about variables that are no calibration
            data = loadmat(path, simplify_cells=True)
    except NotImplementedError as error:
        raise InputError(f"MATLAB 7.3 files (HDF5) are not read; {HOW}") from error
    except Exception as error:
        # SciPy raises whatever its parser runs into.
        told = f"{error!s:.80}" if str(error).strip() else type(error).__name__
        raise InputError(f"{_kind(path)}: {told}; {HOW}") from error
    # The variables themselves may be the fields of the struct; fisheyeParameters hold their intrinsics as a struct.
    structs = {name: value for name, value in data.items() if isinstance(value, Mapping)}
    inner = {name: struct.get("Intrinsics") for name, struct in structs.items()}
    nested = {name: value for name, value in inner.items() if isinstance(value, Mapping)}
    found = {name: value for name, value in {"": data, **data, **nested}.items() if _is_calibration(value)}
    if len(found) == 1:
        return {name: _plain(value) for name, value in next(iter(found.values())).items() if name in FIELDS}
    if len(found) > 1:
        raise InputError(f"holds {len(found)} calibrations ({', '.join(found)}); must be one")
    if any(isinstance(value, MatlabOpaque | MatlabObject | MatlabFunction) for value in data.values()):
        raise InputError(f"holds an object, which only MATLAB can read; {HOW}")
    names = [name for name in data if not name.startswith("__")]
    raise InputError(f"holds no struct with IntrinsicMatrix or K (but {names!s:.80}); {HOW}")


def _kind(path: str) -> str:
    with open(path, "rb") as file:
        head = file.read(16)
    return "a damaged MATLAB file" if head.startswith(b"MATLAB") else f"no MATLAB file (it begins with {head[:8]!r})"


def _plain(value: Any) -> Any:
    """Return a field as JSON holds it: numbers as they are, nested in lists, anything else as text."""
    kind = getattr(getattr(value, "dtype", None), "kind", None)
    if kind in ("b", "i", "u", "f") and value.size <= MOST_NUMBERS:
        return value.tolist()
    if isinstance(value, bool | int | float | str):
        return value
    return f"{value!r:.80}"


def _is_calibration(value: Any) -> bool:
    return isinstance(value, Mapping) and bool({"IntrinsicMatrix", "K", "MappingCoefficients"} & set(value))


# Writing ---------------------------------------------------------------------------------------------------------


def matlab_file(camera: Camera, path: Path, _: Poses | None) -> Files:
    """Return a camera as a .mat file of version 5 that holds the struct `camera`.

    Its fields are the arguments of MATLAB's cameraParameters, or of fisheyeIntrinsics.
    """
    from scipy.io import savemat

    lens = camera.distortion
    fields: dict[str, Any] = {"ImageSize": np.array([camera.height, camera.width], dtype=float)}
    if isinstance(lens, Scaramuzza):
        if camera.fx != camera.fy or camera.skew != 0:
            raise InputError("camera.fx, fy, skew: must be equal and 0, since MATLAB's fisheye has one scale")
        # In pixels of the image plane: a_n = k_n / fx^(n - 1)
        f = camera.fx
        fields |= {
            "MappingCoefficients": np.array([f, lens.k2 / f, lens.k3 / f**2, lens.k4 / f**3]),
            "DistortionCenter": np.array([camera.cx, camera.cy]) + PIXEL_CENTRE,
            "StretchMatrix": np.array([[lens.c, lens.d], [lens.e, 1.0]]),
        }
    elif isinstance(lens, KannalaBrandt):
        raise InputError("camera.distortion: MATLAB has no Kannala-Brandt lens; save as TOML instead")
    else:
        lens = lens or BrownConrady()
        if lens.k4 or lens.k5 or lens.k6:
            raise InputError("camera.distortion: k4, k5, k6 must be 0, since MATLAB lacks them; save as TOML instead")
        fields |= {
            "K": camera.K + np.array([[0, 0, PIXEL_CENTRE], [0, 0, PIXEL_CENTRE], [0, 0, 0]]),
            "RadialDistortion": np.array([lens.k1, lens.k2, lens.k3]),
            "TangentialDistortion": np.array([lens.p1, lens.p2]),
        }
    if camera.view_mask is not None:
        fields["ViewMask"] = mask_text(camera.view_mask)
    buffer = io.BytesIO()
    savemat(buffer, {"camera": fields})
    return {path: buffer.getvalue()}
