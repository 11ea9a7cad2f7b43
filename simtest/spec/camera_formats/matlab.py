"""Camera files of MATLAB: structs of cameraParameters or fisheyeIntrinsics, saved in a .mat file of version 7 or older.

For MATLAB the centre of the first pixel is (1, 1), for simtest (0.5, 0.5): the principal point loses half a pixel.
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
from simtest.geometry.distortion import BrownConrady, KannalaBrandt, Mei, Scaramuzza
from simtest.runtime.limits import check_file
from simtest.runtime.resources import shown
from simtest.spec.camera_formats.common import Table, mask_of_text, mask_text, number
from simtest.spec.camera_formats.omnidirectional import scaramuzza_table

HOW = "in MATLAB: s = toStruct(cameraParams); save('camera.mat', 's', '-v7')"


def read_cameras(path: Path) -> dict[str, Table]:
    """Return the file's one camera, whose id is empty; see `read_matlab`."""
    return {"": read_matlab(path)}


def read_matlab(path: Path) -> Table:
    """Read a calibration of MATLAB as the table of a `CameraSpec`.

    The .mat file holds one struct, under any name, with IntrinsicMatrix (transposed, as MATLAB has it) or K, ImageSize,
    RadialDistortion and TangentialDistortion; or, of a fisheye, with MappingCoefficients, StretchMatrix,
    DistortionCenter and ImageSize.

    Raises
    ------
    InputError
        If the file is missing, malformed, of version 7.3, or holds a cameraParameters object instead of a struct.
    """
    where, fields = shown(path), _struct(path)
    mask = mask_of_text(fields["ViewMask"], where) if "ViewMask" in fields else None
    if "MappingCoefficients" in fields:
        return _fisheye(fields, where) | {"view_mask": mask}
    matrix = _matrix(fields, "K", where) if "K" in fields else _matrix(fields, "IntrinsicMatrix", where).T
    # upper triangular
    if not np.array_equal(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
        raise InputError(f"{where}: IntrinsicMatrix or K = {matrix.tolist()}: must be triangular with 1 in its corner")
    height, width = _array(fields, "ImageSize", 2, where).tolist()
    # Two or three radial coefficients, in OpenCV's order k1 k2 p1 p2 k3 with the tangential ones
    radial = _array(fields, "RadialDistortion", (2, 3), where).tolist()
    tangential = _array(fields, "TangentialDistortion", 2, where).tolist()
    lens = dict(zip(("k1", "k2", "k3", "p1", "p2"), [*radial, 0.0][:3] + tangential, strict=True))
    return {
        "width": width, "height": height, "fx": float(matrix[0, 0]), "fy": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]) - PIXEL_CENTRE, "cy": float(matrix[1, 2]) - PIXEL_CENTRE,
        "skew": float(matrix[0, 1]),
        "distortion": {"type": "brown_conrady", **lens} if any(lens.values()) else None, "view_mask": mask,
    }  # fmt: skip


def _fisheye(fields: Mapping[str, Any], where: str) -> Table:
    """Return a fisheyeIntrinsics: Scaramuzza's model with x before y."""
    mapping = _array(fields, "MappingCoefficients", 4, where).tolist()
    height, width = (
        number(value, where, "ImageSize", whole=True) for value in _array(fields, "ImageSize", 2, where).tolist()
    )
    x, y = _array(fields, "DistortionCenter", 2, where).tolist()
    c, d, e, one = _array(fields, "StretchMatrix", 4, where).tolist() if "StretchMatrix" in fields else (1, 0, 0, 1)
    if one != 1:
        raise InputError(f"{where}: StretchMatrix = {[[c, d], [e, one]]}: must have 1 in its last corner")
    return scaramuzza_table((width, height), (x - PIXEL_CENTRE, y - PIXEL_CENTRE), mapping, (c, d, e), where)


def _struct(path: Path) -> Mapping[str, Any]:
    """Return the fields of the one struct in the file that is a calibration."""
    # Imported here: slow to load, and most cameras come from other files.
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    where = shown(path)
    try:
        check_file(path, "matlab_bytes", "a .mat file")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about variables that are no calibration
            data = loadmat(str(path), simplify_cells=True)
    except InputError:
        raise
    except NotImplementedError as error:
        raise InputError(f"{where}: MATLAB 7.3 files (HDF5) are not read; {HOW}") from error
    except OSError as error:
        raise InputError(f"{where}: cannot be read ({error.strerror or error})") from error
    except Exception as error:
        # SciPy raises whatever its parser runs into.
        told = shown(error, 80) if str(error).strip() else type(error).__name__
        head = _head(path)
        kind = (
            "a damaged MATLAB file" if head.startswith(b"MATLAB") else f"no MATLAB file (it begins with {head[:8]!r})"
        )
        raise InputError(f"{where}: {kind}: {told}; {HOW}") from error
    # The variables themselves may be the fields of the struct.
    nested = {name: value["Intrinsics"] for name, value in data.items() if _holds_intrinsics(value)}
    found = {name: value for name, value in {"": data, **data, **nested}.items() if _is_calibration(value)}
    if len(found) == 1:
        return next(iter(found.values()))
    if len(found) > 1:
        raise InputError(f"{where}: holds {len(found)} calibrations ({', '.join(found)}); must be one")
    if any(isinstance(value, MatlabOpaque | MatlabObject | MatlabFunction) for value in data.values()):
        raise InputError(f"{where}: holds an object, which only MATLAB can read; {HOW}")
    names = [name for name in data if not name.startswith("__")]
    raise InputError(f"{where}: holds no struct with IntrinsicMatrix or K (but {shown(names, 80)}); {HOW}")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(16)


def _is_calibration(value: Any) -> bool:
    return isinstance(value, Mapping) and bool({"IntrinsicMatrix", "K", "MappingCoefficients"} & set(value))


def _holds_intrinsics(value: Any) -> bool:
    """Return whether a variable is a struct of fisheyeParameters, which holds its intrinsics as a struct."""
    return isinstance(value, Mapping) and isinstance(value.get("Intrinsics"), Mapping)


def _matrix(fields: Mapping[str, Any], name: str, where: str) -> Any:
    """Return a field of 3 x 3 numbers."""
    values = _array(fields, name, 9, where)
    if np.shape(fields[name]) != (3, 3):
        raise InputError(f"{where}: {name}: has shape {np.shape(fields[name])}; must be (3, 3)")
    return values.reshape(3, 3)


def _array(fields: Mapping[str, Any], name: str, counts: int | tuple[int, ...], where: str) -> Any:
    """Return a field as numbers in row order."""
    allowed = (counts,) if isinstance(counts, int) else counts
    if name not in fields:
        raise InputError(f"{where}: {name}: missing; {HOW}")
    value = np.asarray(fields[name])
    if value.dtype.kind not in "iuf" or value.size not in allowed:
        said = " or ".join(str(count) for count in allowed)
        raise InputError(f"{where}: {name} = {shown(repr(fields[name]), 80)}: must be {said} numbers")
    return value.astype(float).ravel()


# Writing ---------------------------------------------------------------------------------------------------------


def matlab_bytes(camera: Camera) -> bytes:
    """Return a camera as a .mat file of version 5 that holds the struct `camera`.

    Its fields are the arguments of MATLAB's cameraParameters, or of fisheyeIntrinsics. Raises `InputError` if MATLAB
    has no such lens.
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
    elif isinstance(lens, KannalaBrandt | Mei):
        kind = "Mei" if isinstance(lens, Mei) else "Kannala-Brandt"
        raise InputError(f"camera.distortion: MATLAB has no {kind} lens; save as TOML instead")
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
    return buffer.getvalue()
