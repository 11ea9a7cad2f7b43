"""The struct of a camera in a .mat file, read in a process of its own.

SciPy crashes over some damaged files, and takes gigabytes over others.
"""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime.files import require_plain
from simtest.runtime.processes import call_apart

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
    # The variables themselves may be the fields of the struct.
    nested = {name: value["Intrinsics"] for name, value in data.items() if _holds_intrinsics(value)}
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


def _holds_intrinsics(value: Any) -> bool:
    """Return whether a variable is a struct of fisheyeParameters, which holds its intrinsics as a struct."""
    return isinstance(value, Mapping) and isinstance(value.get("Intrinsics"), Mapping)
