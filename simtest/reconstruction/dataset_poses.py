"""Trajectories in the files of public data sets of colonoscopy: C3VD's pose.txt and SimCol3D's pair of text files.

C3VD writes camera-to-world matrices, 16 numbers a line, mm. Its loader takes them for row vectors, with the translation
in the last row; its page calls them row-major, and that of its successor column-major. Where the translation stands
tells which they are: the last row, or the last column, is 0, 0, 0, 1.
SimCol3D writes tx ty tz, cm, into SavedPosition_NAME.txt and qx qy qz qw into SavedRotationQuaternion_NAME.txt, in the
left-handed frame of its game engine, whose y axis points up.
"""

from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.geometry.vectors import rotation_of
from simtest.runtime.arrays import Array
from simtest.runtime.files import require_plain

POSITION, ROTATION = "SavedPosition_", "SavedRotationQuaternion_"
"""Begins of the names of SimCol3D's files."""

MM_PER_CM = 10.0

DOWN = np.diag([1.0, -1.0, 1.0])
"""From y up to y down, which makes the left-handed frame right-handed."""


def dataset_poses(path: Path, text: str, where: str) -> list[Array] | None:
    """Return the poses of a data set's file, world_from_camera, shape (4, 4), mm; None where it is none of them."""
    if path.name.startswith(POSITION):
        return _simcol3d(path, text, where)
    first = next((line for line in text.splitlines() if line.strip()), "")
    return _c3vd(text, where) if len(first.split(",")) == 16 else None


def _c3vd(text: str, where: str) -> list[Array]:
    matrices = np.array(_numbers(text, 16, ",", where)).reshape(-1, 4, 4)
    transposed = matrices.transpose(0, 2, 1)
    in_row, in_column = matrices[:, 3, :3].any(), matrices[:, :3, 3].any()
    if not (in_row or in_column or np.array_equal(matrices, transposed)):
        raise InputError(f"{where}: no pose has a translation, which tells rows from columns; must hold one that has")
    return list(transposed if in_row else matrices)


def _simcol3d(path: Path, text: str, where: str) -> list[Array]:
    other = path.with_name(ROTATION + path.name.removeprefix(POSITION))
    try:
        turned = require_plain(other, "record_bytes").read_text(encoding="utf-8")
    except (OSError, ValueError):
        raise InputError(f"{where}: needs {other.name} beside it, which cannot be read") from None
    at, of = _numbers(text, 3, None, where), _numbers(turned, 4, None, f"--poses {other}")
    if len(at) != len(of):
        raise InputError(f"{where}: {len(at)} positions, but {other.name} has {len(of)} rotations")
    poses = []
    for number, (position, (x, y, z, w)) in enumerate(zip(at, of, strict=True)):
        T = np.eye(4)
        T[:3, :3] = DOWN @ rotation_of((w, x, y, z), f"--poses {other}: pose {number}") @ DOWN
        T[:3, 3] = DOWN @ position * MM_PER_CM
        poses.append(T)
    return poses


def _numbers(text: str, count: int, separator: str | None, where: str) -> list[list[float]]:
    """Return the numbers of each line that is not empty; raise `InputError` where there are not `count` of them."""
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(separator)]
        except ValueError:
            row = []
        if len(row) != count or not np.isfinite(row).all():
            raise InputError(f"{where}: line {number}: {line.strip()!s:.60}; must be {count} numbers")
        rows.append(row)
    return rows
