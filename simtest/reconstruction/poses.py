"""Poses of the camera over the frames of a sequence, from a file.

It is views.json, a list of matrices, a TUM trajectory, a file of COLMAP or NeRF, or that of a public data set of
colonoscopy. docs/howto/pictures.md describes the formats.

C3VD writes camera-to-world matrices, 16 numbers a line, mm. Its loader takes them for row vectors, with the translation
in the last row; its page calls them row-major, and that of its successor column-major. Where the translation stands
tells which they are: the last row, or the last column, is 0, 0, 0, 1.
SimCol3D writes tx ty tz, cm, into SavedPosition_NAME.txt and qx qy qz qw into SavedRotationQuaternion_NAME.txt, in the
left-handed frame of its game engine, whose y axis points up.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from simtest.errors import InputError
from simtest.estimators.motion_signs import PoseError
from simtest.geometry.vectors import rotation_of
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import close_names
from simtest.runtime.files import require_plain

UNITS_MM = {"mm": 1.0, "m": 1000.0}

UNTOLD_ERROR = PoseError(0.01, float(np.radians(0.2)))
"""Error of a motion from frame to frame where the file states none."""

MOST_MM = 1e6
"""Farthest position from the origin, mm."""

ROUNDED = 1e-3
"""How far a matrix may be from a rotation: files hold rounded numbers."""

LISTS = ("frames", "views", "accepted", "poses")
MATRICES = ("world_from_camera", "model_from_camera")
NERF = "transform_matrix"
"""Key of a pose in NeRF's files: with other axes, in an arbitrary unit."""
COLMAP_WORDS = 10
"""Words of an image's line in COLMAP's images.txt."""
SETTINGS = ("unit", "translation_error", "rotation_error_deg")
NAMES = ("frame", "picture", "image", "name")

POSITION, ROTATION = "SavedPosition_", "SavedRotationQuaternion_"
"""Begins of the names of SimCol3D's files."""

MM_PER_CM = 10.0

DOWN = np.diag([1.0, -1.0, 1.0])
"""From y up to y down, which makes the left-handed frame right-handed."""


@dataclass(frozen=True)
class Poses:
    """Where the camera was at each frame, mm, shape (N, 4, 4), and the error of the motion between two frames.

    `names` are those of the frames' files; where the file has none, poses go with frames by their order. An error that
    it does not state is that of `UNTOLD_ERROR`; `error_told` is whether it states both.
    """

    path: Path
    world_from_camera: Array
    names: tuple[str, ...]
    error: PoseError
    error_told: bool

    def of_frames(self, names: Sequence[str], indices: Sequence[int]) -> list[Array | None]:
        """Return the pose of each frame by its file's name, or by its number where the poses have no names."""
        if self.names:
            table = dict(zip(self.names, self.world_from_camera, strict=True))
            found = [table.get(name) for name in names]
            if all(pose is None for pose in found):
                wanted = f"must name frames of the folder, such as {names[0]!s:.60}"
                raise InputError(f"--poses {self.path}: names {self.names[0]!s:.60}; {wanted}")
            return found
        count, needed = len(self.world_from_camera), max(indices) + 1
        if needed > count:
            raise InputError(f"--poses {self.path}: {count} poses; must be one for each of the {needed} frames")
        return [self.world_from_camera[index] for index in indices]

    def of_files(self, names: Sequence[str]) -> list[Array | None]:
        """Return the pose of each file of a folder (`of_frames`); raise `InputError` where it is not clear which.

        Poses without names must be as many as the files, and a name must be that of one file.
        """
        where, count = f"--poses {self.path}", len(self.world_from_camera)
        check_names(where, self.names, names)
        found = self.of_frames(names, range(len(names)))
        if not self.names and count != len(names):
            needed = f"must be one for each of the {len(names)} frames"
            raise InputError(f"{where}: {count} poses of frames without names; {needed}")
        return found

    def of_film(self, least: int) -> "Poses":
        """Return the poses in the order of a film's frames; raise `InputError` where it is not known.

        Names must number the frames from 0 or 1 without a gap. There must be one for each of at least `least` frames.
        """
        where, count, poses = f"--poses {self.path}", len(self.world_from_camera), self
        if self.names:
            numbers = [int((re.findall(r"\d+", Path(name).stem) or ["-1"])[-1]) for name in self.names]
            order = np.argsort(numbers)
            first = numbers[order[0]]
            if first not in (0, 1) or sorted(numbers) != list(range(first, first + count)):
                raise InputError(
                    f"{where}: names {self.names[0]!s:.60}; of a film the names must number its frames from 0 or "
                    "1 without a gap; or give the folder of the pictures in its place"
                )
            poses = replace(self, world_from_camera=self.world_from_camera[order], names=())
        if count < least:
            raise InputError(f"{where}: {count} poses; must be one for each of the film's frames, at least {least}")
        return poses


def check_names(where: str, keys: Iterable[str], files: Sequence[str]) -> None:
    """Raise `InputError` where a key names several files of a list, which may stand in other folders."""
    counts = Counter(Path(name).name for name in files)
    for key in keys:
        if counts[key] > 1:
            raise InputError(f"{where}: {key} names {counts[key]} pictures; must be given other file names")


def read_poses(path: Path) -> Poses:
    """Read a file of poses; raise `InputError`, one line, where it is malformed."""
    where = f"--poses {path}"
    try:
        text = require_plain(path, "record_bytes", "a file of poses").read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: no text (byte {error.start}); must be JSON or a TUM trajectory") from error
    is_json = path.suffix.lower() == ".json"
    first = next((line for line in text.splitlines() if line.strip()), "")
    of_c3vd, of_simcol3d = len(first.split(",")) == 16, path.name.startswith(POSITION)
    foreign, names = False, list[str]()
    if not is_json and (of_simcol3d or of_c3vd):
        matrices = _simcol3d(path, text, where) if of_simcol3d else _c3vd(text, where)
        poses = [_matrix(T.tolist(), f"{where}: pose {number}") for number, T in enumerate(matrices)]
        settings = {"unit": "mm"}
    elif foreign := _is_foreign(text, is_json):
        poses, names, settings = _from_others(path, text, is_json, where)
    else:
        poses, names, settings = _from_json(text, where) if is_json else _from_tum(text, where)
    if not poses:
        raise InputError(f"{where}: holds no pose; must hold one for each frame")
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise InputError(f"{where}: names {twice} twice; must give each frame one pose")
    if foreign and "unit" not in settings:
        how = 'a key "unit": "mm"' if is_json else "a line # unit: mm"
        raise InputError(f"{where}: its unit of length is arbitrary; state it by {how}, or the millimetres of one unit")
    made = np.array(poses)
    made[:, :3, 3] *= _unit_mm(settings.pop("unit", "mm" if is_json else "m"), where)
    if (farthest := float(np.abs(made[:, :3, 3]).max())) > MOST_MM:
        raise InputError(f"{where}: a position of {farthest:.3g} mm; must be at most {MOST_MM:g} mm from the origin")
    translation = _share(settings, "translation_error", 1.0, where)
    rotation = _share(settings, "rotation_error_deg", 90.0, where)
    # What is not stated is assumed, never taken for exact.
    stated = PoseError(
        UNTOLD_ERROR.translation if translation is None else translation,
        UNTOLD_ERROR.rotation if rotation is None else float(np.radians(rotation)),
    )
    return Poses(path, made, tuple(names), stated, translation is not None and rotation is not None)


Read = tuple[list[Array], list[str], dict[str, Any]]


def _unit_mm(unit: object, where: str) -> float:
    """Return the millimetres of a unit: a name, or their number."""
    if isinstance(unit, str) and unit in UNITS_MM:
        return UNITS_MM[unit]
    number = _number(unit)
    if not 0 < number < np.inf:
        known = ", ".join(UNITS_MM)
        raise InputError(f"{where}: unit = {unit!s}; must be one of {known}, or the millimetres of one unit")
    return number


def _share(settings: dict[str, Any], key: str, most: float, where: str) -> float | None:
    """Return a setting in [0, most]; None where the file has none."""
    value = settings.get(key)
    if value is None:
        return None
    number = _number(value)
    if not 0 <= number <= most:
        raise InputError(f"{where}: {key} = {value!s:.40}; must be a number in [0, {most:g}]")
    return number


def _number(value: object) -> float:
    """Return the number that a setting states; NaN where it is none."""
    try:
        return np.nan if isinstance(value, bool) or not isinstance(value, str | int | float) else float(value)
    except (ValueError, OverflowError):
        return np.nan


def _from_json(text: str, where: str) -> Read:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: no JSON ({str(error)[:80]})") from error
    table = data if isinstance(data, dict) else {}
    settings = _settings_in(table, where)
    lists = [key for key in LISTS if key in table]
    if len(lists) > 1:
        raise InputError(f"{where}: holds {' and '.join(lists)}; must hold one list of poses")
    entries = table[lists[0]] if lists else data
    if not isinstance(entries, list):
        raise InputError(f"{where}: no list of poses; must be a list, or hold one under {', '.join(LISTS)}")
    poses, names = [], []
    for number, entry in enumerate(entries):
        at = f"{where}: pose {number}"
        matrix = entry
        if isinstance(entry, dict):
            matrix = next((entry[key] for key in MATRICES if key in entry), None)
            if matrix is None and NERF in entry:
                raise InputError(
                    f"{at}: no {' or '.join(MATRICES)} but {NERF}, whose camera has y up and z backward; "
                    "docs/howto/pictures.md shows how to convert it"
                )
            named = next((entry[key] for key in NAMES if entry.get(key) is not None), None)
            if named is not None and not isinstance(named, str):
                raise InputError(f"{at}: names its frame {named!s}; must be the name of a file")
            names += [] if named is None else [Path(named).name]
        poses.append(_matrix(matrix, at))
    if names and len(names) < len(poses):
        raise InputError(f"{where}: {len(names)} of {len(poses)} poses name their frame; must be all or none")
    return poses, names, settings


def _is_foreign(text: str, is_json: bool) -> bool:
    """Return whether a file is one of COLMAP's, a line of which has ten words, or of NeRF's, which has its own key."""
    if is_json:
        return f'"{NERF}"' in text and not any(f'"{key}"' in text for key in MATRICES)
    lines = (line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#"))
    return len(next(lines, ())) == COLMAP_WORDS


def _from_others(path: Path, text: str, is_json: bool, where: str) -> Read:
    """Read the poses of another program's file, and the settings that it states."""
    from simtest.spec.camera_formats.common import parse_json
    from simtest.spec.camera_formats.files import read_poses as read_foreign

    try:
        found = read_foreign(path)
    except InputError as error:
        raise InputError(f"--poses {error}") from None
    settings = _settings_in(parse_json(text), where) if is_json else _settings_of_lines(text, where)
    poses = [_matrix(T.tolist(), f"{where}: pose {number}") for number, (_, T) in enumerate(found)]
    return poses, [Path(name).name for name, _ in found], settings


def _settings_of_lines(text: str, where: str) -> dict[str, Any]:
    """Return the settings that comments state as key: value."""
    settings: dict[str, Any] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if stated := re.match(r"#\s*([A-Za-z_]+)\s*[:=]\s*(\S+)\s*$", line):
            settings |= _settings_in({stated[1].lower(): stated[2]}, f"{where}: line {number}")
    return settings


def _settings_in(table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return the settings of a table; raise `InputError` for a key that is nearly one, and would be passed over."""
    for key in table:
        if key not in SETTINGS and (meant := close_names(key.lower(), SETTINGS)):
            raise InputError(f"{where}: {key}: unknown; did you mean {meant[0]}?")
    return {key: table[key] for key in SETTINGS if key in table}


def _matrix(value: object, at: str) -> Array:
    """Return a rigid 4 x 4 matrix whose rotation is made exact."""
    if value is None:
        raise InputError(f"{at}: no {' or '.join(MATRICES)}; must hold one, 4 x 4")
    try:
        # Text and truth values are no numbers, though they can be made into some.
        rows = value if isinstance(value, list) else []
        sound = all(type(each) in (int, float) for row in rows for each in (row if isinstance(row, list) else [None]))
        T = np.array(value, dtype=float) if sound else np.empty(0)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{at}: {value!s:.40}; must be a 4 x 4 matrix of numbers")
    R = T[:3, :3]
    off = max(float(np.abs(R @ R.T - np.eye(3)).max()), float(np.abs(T[3] - [0, 0, 0, 1]).max()))
    if off > ROUNDED or np.linalg.det(R) < 0:
        raise InputError(f"{at}: off a rotation and a translation by {off:.3g}; must be rigid, determinant 1")
    U, _, Vt = np.linalg.svd(R)
    T[:3, :3], T[3] = U @ Vt, [0, 0, 0, 1]
    return T


def _from_tum(text: str, where: str) -> Read:
    """Read lines of timestamp tx ty tz qx qy qz qw; comments begin with # and may state a setting as key: value."""
    poses, settings = list[Array](), _settings_of_lines(text, where)
    for number, line in enumerate(text.splitlines(), 1):
        at = f"{where}: line {number}"
        if words := line.partition("#")[0].replace(",", " ").split():
            values = _numbers(words, 8, at, f"{line.strip()!s:.60}", ": time tx ty tz qx qy qz qw")
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation_of(np.roll(values[4:], 1), at), values[1:4]
            poses.append(T)
    return poses, [], settings


def _c3vd(text: str, where: str) -> Array:
    matrices = np.array(_rows(text, 16, ",", where)).reshape(-1, 4, 4)
    transposed = matrices.transpose(0, 2, 1)
    in_row, in_column = matrices[:, 3, :3].any(), matrices[:, :3, 3].any()
    if not (in_row or in_column or np.array_equal(matrices, transposed)):
        raise InputError(f"{where}: no pose has a translation, which tells rows from columns; must hold one that has")
    return transposed if in_row else matrices


def _simcol3d(path: Path, text: str, where: str) -> list[Array]:
    other = path.with_name(ROTATION + path.name.removeprefix(POSITION))
    try:
        turned = require_plain(other, "record_bytes").read_text(encoding="utf-8")
    except (OSError, ValueError):
        raise InputError(f"{where}: needs {other.name} beside it, which cannot be read") from None
    at, of = _rows(text, 3, None, where), _rows(turned, 4, None, f"--poses {other}")
    if len(at) != len(of):
        raise InputError(f"{where}: {len(at)} positions, but {other.name} has {len(of)} rotations")
    poses = []
    for number, (position, (x, y, z, w)) in enumerate(zip(at, of, strict=True)):
        T = np.eye(4)
        T[:3, :3] = DOWN @ rotation_of((w, x, y, z), f"--poses {other}: pose {number}") @ DOWN
        T[:3, 3] = DOWN @ position * MM_PER_CM
        poses.append(T)
    return poses


def _rows(text: str, count: int, separator: str | None, where: str) -> list[list[float]]:
    """Return the numbers of each line that is not empty."""
    lines = ((f"{where}: line {number}", line) for number, line in enumerate(text.splitlines(), 1) if line.strip())
    return [_numbers(line.split(separator), count, at, f"{line.strip()!s:.60}") for at, line in lines]


def _numbers(words: Sequence[str], count: int, at: str, shown: str, named: str = "") -> list[float]:
    """Return finite numbers; raise `InputError` where there are not `count` of them."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{at}: {shown}; must be {count} numbers{named}")
    return values
