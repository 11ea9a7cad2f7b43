"""What the readers of camera files share: numbers, rigid transforms, and the choice of one camera of several."""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np

from simtest.errors import InputError
from simtest.geometry.camera import Camera, ViewMask
from simtest.geometry.lenses import Distortion
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import suggestion
from simtest.spec.toml_files import read_text

Read = TypeVar("Read")

Table = dict[str, Any]
"""A camera as the table of a `CameraSpec`."""

Poses = Sequence[tuple[str, Array]]
"""Names of frames, and their world_from_camera, shape (4, 4): OpenCV axes, in the file's unit of length."""

FISHEYE = ("k1", "k2", "k3", "k4")
"""Coefficients of a fisheye, as all formats order them."""

BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of a perspective lens, as OpenCV orders them."""

Files = dict[Path, bytes]
"""What is written into each file."""

LARGEST = 1e9
"""Largest number of a transform, in the file's unit of length."""

ROUNDED = 1e-3
"""How far a matrix may be from a rotation: files hold rounded numbers."""

ALIKE = 1e-3
"""Share by which two statements of one quantity may differ: files hold rounded numbers."""

MOST_SHOWN = 12
"""Cameras of a file that a message lists."""


@contextmanager
def within(place: str) -> Iterator[None]:
    """Put a place, such as a file's name or a line, before the message of an `InputError` that is raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error}") from error


def of_text(
    kind: str = "camera", limit: str = "text_bytes"
) -> Callable[[Callable[[str], Read]], Callable[[Path], Read]]:
    """Make a reader of files of a reader of their text; messages begin with the file's name."""

    def of_file(read: Callable[[str], Read]) -> Callable[[Path], Read]:
        @wraps(read)
        def read_file(path: Path) -> Read:
            text = read_text(path, kind, limit)
            with within(str(path)):
                return read(text)

        return read_file

    return of_file


def read_json(path: Path, kind: str = "camera") -> dict[str, Any]:
    """Read a JSON object; raise `InputError` where the file holds none."""
    return of_text(kind, "record_bytes")(json_object)(path)


@contextmanager
def syntax(kind: str) -> Iterator[None]:
    """Raise `InputError` where a text that is parsed inside is not of a kind: JSON, XML or YAML."""
    try:
        yield
    except RecursionError:
        raise InputError(f"not valid {kind}: nested too deeply") from None
    except (ValueError, ElementTree.ParseError) as error:
        raise InputError(f"not valid {kind}: {error!s:.80}") from error


def json_object(text: str) -> dict[str, Any]:
    """Return the JSON object of a text."""
    with syntax("JSON"):
        data = parse_json(text)
    if not isinstance(data, dict):
        raise InputError(f"holds a {type(data).__name__}; must be an object of keys and values")
    return data


def parse_json(text: str) -> Any:
    """Parse JSON in which no key is given twice; raise `ValueError` or `RecursionError` where it is malformed."""
    try:
        return json.loads(text, object_pairs_hook=once)
    except json.JSONDecodeError:
        # OpenCV has long written 1. for 1.0, which is no JSON. Names of files may hold the same, so this comes second.
        return json.loads(re.sub(r"(\d)\.(?=[\s,\]}])", r"\1.0", text), object_pairs_hook=once)


def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object's keys and values."""
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)[:40]} is given twice")
    return made


def parse_xml(text: str) -> ElementTree.Element:
    """Return the root of an XML text without a document type; raise `ValueError` or `ParseError` for any other."""
    # Entities, which a document type declares, can grow without end; no calibration has any.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("document types and entities are not allowed")
    return ElementTree.fromstring(text)  # nosec B314: without entities nothing grows or is fetched


def number(value: Any, name: str, whole: bool = False) -> float:
    """Return a finite number, given as one or as text; raise `InputError` for anything else."""
    try:
        # Python alone reads 1_000 as a number.
        wrong = isinstance(value, bool) or (isinstance(value, str) and "_" in value)
        found = math.nan if wrong else float(value)
    except (TypeError, ValueError, OverflowError):
        found = math.nan
    if not math.isfinite(found) or (whole and found != round(found)):
        kind = "whole" if whole else "finite"
        raise InputError(f"{name} = {value!r:.60}: must be a {kind} number")
    return found


def numbers(values: Any, name: str, count: int) -> list[float]:
    """Return a list of so many finite numbers."""
    if not isinstance(values, list | tuple):
        raise InputError(f"{name} = {values!r:.60}: must be a list of numbers")
    if len(values) != count:
        raise InputError(f"{name}: {len(values)} values; must be {count}")
    return [number(value, name) for value in values]


def check_alike(names: tuple[str, str], told: float, other: float, unit: str = "px") -> None:
    """Raise `InputError` where two keys of a file, both as the first one's quantity, differ by more than rounding."""
    if not abs(told - other) <= ALIKE * max(abs(told), abs(other)):
        raise InputError(
            f"{names[0]} = {told:g} and {names[1]}, which says {other:g} {unit}: must agree within "
            f"{100 * ALIKE:g} %; give one of them"
        )


def rigid(rows: Any, name: str) -> Array:
    """Return a rigid transform, shape (4, 4), of 3 or 4 rows of 4 numbers; the rotation's rounding is taken out."""
    if not isinstance(rows, list) or len(rows) not in (3, 4):
        raise InputError(f"{name} = {rows!r:.60}: must be 4 rows of 4 numbers")
    T = np.eye(4)
    T[: len(rows)] = [numbers(row, f"{name}[{i}]", 4) for i, row in enumerate(rows)]
    R = T[:3, :3]
    if not np.abs(T).max() <= LARGEST:
        raise InputError(f"{name}: holds {np.abs(T).max():.3g}; must be at most {LARGEST:g}")
    if not np.allclose(R @ R.T, np.eye(3), atol=ROUNDED) or np.linalg.det(R) < 0:
        raise InputError(f"{name}: must begin with a rotation; R R^T is {(R @ R.T).round(3).tolist()}")
    if not np.allclose(T[3], [0, 0, 0, 1]):
        raise InputError(f"{name}: last row is {T[3].tolist()}; must be 0, 0, 0, 1")
    U, _, V = np.linalg.svd(R)
    T[:3, :3] = U @ V
    return T


def inverse(T: Array) -> Array:
    """Return the inverse of a rigid transform, shape (4, 4)."""
    made = np.eye(4)
    made[:3, :3] = T[:3, :3].T
    made[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return made


def chosen(cameras: Mapping[str, Table], wanted: str | None) -> Table:
    """Return the camera of an id, or the only one; raise `InputError`, which lists them, where that is unclear."""
    if not cameras:
        raise InputError("holds no camera; must hold one")
    listed = ", ".join(list(cameras)[:MOST_SHOWN]) + (", ..." if len(cameras) > MOST_SHOWN else "")
    if wanted is not None:
        if wanted not in cameras:
            raise InputError(f"no camera {wanted}; must be one of {listed}{suggestion(wanted, list(cameras))}")
        return cameras[wanted]
    tables = list(cameras.values())
    if any(table != tables[0] for table in tables):
        raise InputError(f"holds {len(cameras)} cameras ({listed}); name one as FILE#ID")
    return tables[0]


def plain_table(
    size: Sequence[Any], focal: Sequence[float], centre: Sequence[float], shift: float = 0.0, **others: Any
) -> Table:
    """Return the table of a camera whose principal point is moved by `shift`, px, along both axes."""
    fx, fy, cx, cy = map(float, (*focal, *centre))
    return {"width": size[0], "height": size[1], "fx": fx, "fy": fy, "cx": cx + shift, "cy": cy + shift, **others}


def coefficients(lens: Distortion, names: Sequence[str]) -> list[float]:
    """Return coefficients of a lens by their names."""
    return [float(getattr(lens, name)) for name in names]


def check_no_skew(camera: Camera, why: str) -> None:
    """Raise `InputError` for a camera with a skew, which a format cannot hold."""
    if camera.skew != 0:
        raise InputError(f"camera.skew = {camera.skew:g}: must be 0, since {why}; save as TOML instead")


def lens_table(is_fisheye: bool, told: Mapping[str, float]) -> Table | None:
    """Return a lens as the table of a `DistortionSpec`; None for a perspective lens whose coefficients are all 0."""
    if is_fisheye:
        return {"type": "kannala_brandt", **told}
    return {"type": "brown_conrady", **told} if any(told.values()) else None


def mask_text(mask: ViewMask) -> str:
    """Return a view mask as JSON, for formats that skip what they do not know."""
    return json.dumps(mask_table(mask))


def mask_of_text(text: Any) -> Table:
    """Return the table of a `ViewMaskSpec` that `mask_text` wrote."""
    try:
        made = json.loads(text)
    except (TypeError, ValueError):
        made = None
    if not isinstance(made, dict):
        raise InputError(f"view mask {text!r:.60}: must be a JSON object")
    return made


def mask_table(mask: ViewMask) -> dict[str, float]:
    """Return a view mask as the table of a `ViewMaskSpec`."""
    keys = ("radius", "corner", "half_height", "cx", "cy")
    return {key: float(value) for key in keys if (value := getattr(mask, key)) is not None}
