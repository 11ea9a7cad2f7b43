"""Reads a table of normals that were estimated elsewhere, CSV or Parquet; every row is checked before it is scored."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from simtest.dataset.scoring.answers import Answer
from simtest.dataset.scoring.record import Record
from simtest.dataset.scoring.table_file import COVARIANCE, NORMAL, PIXEL, SECOND, Table, read_table
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.protocol import Target, check
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array, Mask
from simtest.spec.camera import CameraSpec
from simtest.spec.spec_model import validate
from simtest.validation.scoring import MISSED

LONGEST_NAME = 80
"""Characters of a method's name."""

Answers = Mapping[str, Mapping[str, Sequence[Answer]]]
"""Answers by estimator and frame."""


def read_answers(path: Path, record: Record, name: str) -> Answers:
    """Read a table of answers to exported frames.

    Parameters
    ----------
    path : Path
        CSV, or Parquet where the name ends so.
    record : Record
        Of the export.
    name : str
        Of the method, where the table has no column `estimator`.

    Returns
    -------
    mapping
        Answers by estimator and frame. Rows whose status is missed are left out, as highlights without a row are; their
        estimator is there all the same.
    """
    table = read_table(path)
    is_answer = _answered(table)
    _check_frames(table, record)
    numbers = _specularities(table, record)
    points = _points(table, record, numbers)
    normals = table.stack(NORMAL)
    seconds = _whole(table, SECOND, np.ones(table.rows, dtype=bool))
    covariances = _whole(table, COVARIANCE, is_answer)
    cameras = {name: _camera(record, name) for name in record.cameras}
    made: dict[str, dict[str, list[Answer]]] = {}
    seen: dict[tuple[object, ...], int] = {}
    for row in range(table.rows):
        frame, estimator = table.texts["frame"][row], table.texts["estimator"][row] or name
        check_name(estimator, f"{path}: row {row + 1}: estimator")
        of_estimator = made.setdefault(estimator, {})
        if table.texts["status"][row] == MISSED:
            continue
        own = of_estimator.setdefault(frame, [])
        where = ("specularity", numbers[row]) if numbers[row] is not None else ("pixel", *points[row].tolist())
        if (before := seen.setdefault((estimator, frame, *where), row)) != row:
            raise table.refuse(row, f"frame {frame}: answers the same highlight as row {before + 1}; must be one row")
        stated = (points[row], normals[row], seconds[row], covariances[row])
        result = _estimate(table, row, *stated) if is_answer[row] else _failure(table, row)
        if is_answer[row] and isinstance(result := check(result, cameras[record.frames[frame].camera]), Failure):
            raise table.refuse(row, result.detail)
        own.append(Answer(result, points[row], numbers[row]))
    if not any(made.values()):
        raise InputError(f"{path}: holds no answer; must have a row for each normal")
    return made


def check_name(name: str, what: str) -> None:
    """Raise `InputError` where a method's name cannot stand in results, pages and names of folders."""
    if not 0 < len(name) <= LONGEST_NAME or not name.isprintable() or "/" in name or name.strip() in ("", ".", ".."):
        allowed = f"1 to {LONGEST_NAME} printable characters without /, and neither . nor .."
        raise InputError(f"{what} = {name}: must be {allowed}")


# Checks of all rows --------------------------------------------------------------------------------------------------


def _answered(table: Table) -> Mask:
    """Return which rows hold a normal: those whose status is empty or ok, shape (rows,)."""
    given = np.isfinite(table.stack(NORMAL))
    status, reason = np.array(table.texts["status"]), np.array(table.texts["reason"])
    ok = (status == "ok") | ((status == "") & ((reason == "") | given.any(axis=1)))
    is_known = np.isin(status, ["", MISSED, *map(str, Reason)])
    if (row := table.first(~ok & ~is_known & given.all(axis=1))) is not None:
        raise table.refuse(row, f"status = {status[row]!s:.40}: must be ok or empty where a normal is given")
    if (row := table.first(ok & ~given.all(axis=1))) is not None:
        name = NORMAL[int(np.flatnonzero(~given[row])[0])]
        raise table.refuse(row, f"{name} is empty; must be a number, or status must name why there is no normal")
    targets = np.array(table.texts["target"])
    if (row := table.first(~np.isin(targets, ("", "fine", "base")))) is not None:
        raise table.refuse(row, f"target = {targets[row]!s:.40}: must be fine, base or empty")
    return np.asarray(ok)


def _check_frames(table: Table, record: Record) -> None:
    """Raise `InputError` for a frame that was not exported; warn where frames have no row."""
    for row, frame in enumerate(table.texts["frame"]):
        if frame not in record.frames:
            what = f"among the {len(record.frames)} names of frames.csv"
            raise table.refuse(row, f"frame = {str(frame) if frame else 'empty'}: must be {what}")
    if left := len(record.frames) - len(set(table.texts["frame"])):
        what = "frame has no row; its" if left == 1 else "frames have no row; their"
        warnings.warn(f"{table.path}: {left} of {len(record.frames)} {what} highlights count as missed",
                      stacklevel=4)  # fmt: skip


def _specularities(table: Table, record: Record) -> list[int | None]:
    """Return the numbers of the detections, None where none is given; raise `InputError` for one that is not there."""
    made: list[int | None] = []
    for row, value in enumerate(table.numbers["specularity"].tolist()):
        if value != value:
            made.append(None)
            continue
        count = len(record.frames[table.texts["frame"][row]].peaks)
        if value != int(value) or not 0 <= value < count:
            allowed = f"a whole number from 0 to {count - 1}" if count else "empty, since nothing was detected there"
            raise table.refuse(row, f"specularity = {value:g}: must be {allowed} (highlights.csv)")
        made.append(int(value))
    return made


def _points(table: Table, record: Record, numbers: Sequence[int | None]) -> Array:
    """Return the pixel of each row, shape (rows, 2): as given, or the peak of the detection."""
    points = table.stack(PIXEL)
    for row in np.flatnonzero(~np.isfinite(points).all(axis=1)).tolist():
        number = numbers[row]
        if number is None or np.isfinite(points[row]).any():
            if table.texts["status"][row] == MISSED:
                continue
            raise table.refuse(row, "x_px or y_px is empty; both must be given, or none and specularity")
        points[row] = record.frames[table.texts["frame"][row]].peaks[number]
    _check_at_detections(table, record, numbers, points)
    return points


def _check_at_detections(table: Table, record: Record, numbers: Sequence[int | None], points: Array) -> None:
    """Raise `InputError` for a pixel that is farther from the detection which its row names than the box is wide."""
    for row, (number, point) in enumerate(zip(numbers, points.tolist(), strict=True)):
        if number is None:
            continue
        *corner, width, height = record.frames[table.texts["frame"][row]].boxes[number]
        gaps = [max(low - at, at - low - size) for low, at, size in zip(corner, point, (width, height), strict=True)]
        if max(gaps) > max(width, height):
            where = f"detection {number}, whose box is {width} x {height} px at ({corner[0]}, {corner[1]})"
            raise table.refuse(row, f"x_px = {point[0]:g}, y_px = {point[1]:g}: must lie at {where} (highlights.csv)")


def _whole(table: Table, columns: Sequence[str], wanted: Mask) -> Array:
    """Return columns that are given together, shape (rows, 3), NaN where they are not."""
    values = table.stack(columns)
    given = np.isfinite(values)
    if (row := table.first(wanted & given.any(axis=1) & ~given.all(axis=1))) is not None:
        raise table.refuse(row, f"{', '.join(columns)}: some are empty; all three must be given, or none")
    return values


def _camera(record: Record, name: str) -> Camera:
    return validate(CameraSpec, dict(record.cameras[name]), f"export.json: {name}").model()


# Answers -------------------------------------------------------------------------------------------------------------


def _estimate(table: Table, row: int, point: Array, normal: Array, second: Array, covariance: Array) -> Estimate:
    """Return the estimate of a row."""
    candidates = np.stack([normal, second]) if np.isfinite(second).all() else normal[None]
    stated = None
    if np.isfinite(covariance).all():
        first, mixed, last = covariance
        other = table.numbers["cov_21"][row]
        stated = np.array([[first, mixed], [other if np.isfinite(other) else mixed, last]])
    target: Target = "base" if table.texts["target"][row] == "base" else "fine"
    return Estimate(
        normal=normal,
        candidates=candidates,
        look_px=point,
        axis_ratio=_optional(table, "axis_ratio", row),
        choice_margin=_optional(table, "choice_margin", row),
        covariance=stated,
        flags=_flags(table, row),
        target=target,
    )


def _optional(table: Table, name: str, row: int) -> float | None:
    value = float(table.numbers[name][row])
    return value if np.isfinite(value) else None


def _flags(table: Table, row: int) -> tuple[str, ...]:
    return tuple(flag for part in table.texts["flags"][row].split(",") if (flag := part.strip()))


def _failure(table: Table, row: int) -> Failure:
    """Return the refusal of a row: with the reason that it names, or as text."""
    status = table.texts["status"][row]
    detail = table.texts["reason"][row] or table.texts["flags"][row]
    try:
        return Failure(Reason(status), detail)
    except ValueError:
        return Failure(Reason.NO_ESTIMATE, ": ".join(part for part in (status, detail) if part))
