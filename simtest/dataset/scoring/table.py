"""Reads a table of normals that were estimated elsewhere, CSV or Parquet; every row is checked before it is scored."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.dataset.scoring.answers import Answer
from simtest.dataset.scoring.record import Record
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.protocol import Target
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.files import require_plain
from simtest.runtime.resources import close_names, shown
from simtest.spec.camera_spec import CameraSpec
from simtest.spec.spec_model import validate
from simtest.validation.metrics import MISSED

NORMAL = ("normal_x", "normal_y", "normal_z")
SECOND = ("second_x", "second_y", "second_z")
COVARIANCE = ("cov_11", "cov_12", "cov_22")
PIXEL = ("x_px", "y_px")
NUMBERS = (*PIXEL, *NORMAL, *SECOND, *COVARIANCE, "cov_21", "axis_ratio", "choice_margin")
TEXTS = ("frame", "estimator", "target", "flags", "status", "reason")
COLUMNS = (*TEXTS, "specularity", *NUMBERS)

UNIT_TOLERANCE = 1e-3
"""A normal whose length differs from 1 by more is refused: it is no rounding."""

ROUNDING = 1e-9
"""A normal whose length differs from 1 by less stays as it is."""

LONGEST_NAME = 80
"""Characters of a method's name."""

LARGEST_VARIANCE = np.pi**2
"""rad^2; no direction is less certain."""

Answers = Mapping[str, Mapping[str, Sequence[Answer]]]
"""Answers by estimator and frame."""


@dataclass(frozen=True)
class _Table:
    """A table as it was read: columns by name, the number of rows, and the file for messages."""

    path: Path
    numbers: Mapping[str, Array]
    texts: Mapping[str, list[str]]
    rows: int

    def refuse(self, row: int, what: str) -> InputError:
        """Return the error of a row, counted from 1 without the header."""
        return InputError(f"{shown(self.path)}: row {row + 1}: {what}")

    def first(self, wrong: npt.ArrayLike) -> int | None:
        """Return the first row of which something is true, shape (rows,); None where it is true of none."""
        found = np.flatnonzero(wrong)
        return int(found[0]) if len(found) else None

    def stack(self, names: Sequence[str]) -> Array:
        """Return columns side by side, shape (rows, len(names))."""
        return np.stack([self.numbers[name] for name in names], axis=1)


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
        Answers by estimator and frame. Rows whose status is missed are left out, as highlights without a row are.

    Raises
    ------
    InputError
        If the table cannot be read, lacks a column, or a row is malformed: the message names it, counted from 1 without
        the header.
    """
    table = _read(path)
    is_answer = _answered(table)
    _check_frames(table, record)
    numbers = _specularities(table, record)
    points = _points(table, record, numbers)
    normals = _normals(table, is_answer)
    seconds = _seconds(table, is_answer)
    covariances = _covariances(table, is_answer)
    _check_facing(table, record, is_answer, points, normals)
    made: dict[str, dict[str, list[Answer]]] = {}
    seen: dict[tuple[object, ...], int] = {}
    for row in range(table.rows):
        if table.texts["status"][row] == MISSED:
            continue
        frame, estimator = table.texts["frame"][row], table.texts["estimator"][row] or name
        own = made.setdefault(estimator, {}).setdefault(frame, [])
        check_name(estimator, f"{shown(path)}: row {row + 1}: estimator")
        where = ("specularity", numbers[row]) if numbers[row] is not None else ("pixel", *points[row].tolist())
        if (before := seen.setdefault((estimator, frame, *where), row)) != row:
            raise table.refuse(row, f"frame {frame}: answers the same highlight as row {before + 1}; must be one row")
        stated = (points[row], normals[row], seconds[row], covariances[row])
        result = _estimate(table, row, *stated) if is_answer[row] else _failure(table, row)
        own.append(Answer(result, points[row], numbers[row]))
    if not made:
        raise InputError(f"{shown(path)}: holds no answer; must have a row for each normal")
    return made


def check_name(name: str, what: str) -> None:
    """Raise `InputError` where a method's name cannot stand in results, pages and names of folders."""
    if not 0 < len(name) <= LONGEST_NAME or not name.isprintable() or "/" in name or name.strip() in ("", ".", ".."):
        allowed = f"1 to {LONGEST_NAME} printable characters without /, and neither . nor .."
        raise InputError(f"{what} = {shown(name, 40)}: must be {allowed}")


# Reading ------------------------------------------------------------------------------------------------------------


def _read(path: Path) -> _Table:
    """Read a table; numbers that are not given are NaN, texts that are not given empty."""
    try:
        require_plain(path)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror}); must be a CSV or Parquet table") from error
    is_parquet = path.suffix.lower() in (".parquet", ".pq")
    try:
        # As text: whether a value is a number is judged below, where the row is known.
        frame = pl.read_parquet(path, hive_partitioning=False) if is_parquet else pl.read_csv(path, infer_schema=False)
    except (pl.exceptions.PolarsError, OSError, UnicodeDecodeError) as error:
        kind = "Parquet" if is_parquet else "CSV"
        raise InputError(f"{shown(path)}: no {kind} table ({str(error).splitlines()[0][:120]})") from error
    # "frame, x_px" is a header that people write.
    names = [name.strip() for name in frame.columns]
    if len(set(names)) == len(names):
        frame.columns = names
    _check_columns(path, frame.columns)
    numbers = {name: np.full(frame.height, np.nan) for name in (*NUMBERS, "specularity")}
    texts = {name: [""] * frame.height for name in TEXTS}
    for name in frame.columns:
        try:
            if name in texts:
                texts[name] = frame[name].cast(pl.String).fill_null("").str.strip_chars().to_list()
            elif name in numbers:
                numbers[name] = _number_column(path, frame[name])
        except pl.exceptions.PolarsError as error:
            kind = "text" if name in texts else "numbers"
            raise InputError(f"{shown(path)}: column {name} is {frame[name].dtype}; must hold {kind}") from error
    return _Table(path, numbers, texts, frame.height)


def _check_columns(path: Path, columns: Sequence[str]) -> None:
    """Raise `InputError` for missing columns; warn of those that nobody reads."""
    needed = ["frame"] if {"status", "reason"} & set(columns) else ["frame", *NORMAL]
    missing = [name for name in needed if name not in columns]
    if not missing and not set(PIXEL) <= set(columns) and "specularity" not in columns:
        missing = [name for name in PIXEL if name not in columns]
    groups = (NORMAL, SECOND, COVARIANCE, PIXEL)
    missing += [n for g in groups if set(g) & set(columns) for n in g if n not in columns and n not in missing]
    if missing:
        raise InputError(
            f"{shown(path)}: column {missing[0]} is missing; must have frame, x_px and y_px or specularity, "
            f"{', '.join(NORMAL)}, and all of a group such as {', '.join(COVARIANCE)} or none; "
            f"has {shown(', '.join(columns), 120)}"
        )
    unknown = [name for name in columns if name not in COLUMNS]
    if unknown:
        near = close_names(unknown[0], COLUMNS)
        meant = f" (is {near[0]} meant?)" if near else ""
        listed = ", ".join(shown(name, 40) for name in unknown[:5]) + (", ..." if len(unknown) > 5 else "")
        warnings.warn(f"{shown(path)}: columns that are not read: {listed}{meant}", stacklevel=5)


def _number_column(path: Path, column: pl.Series) -> Array:
    """Return a column as numbers, NaN where it is empty; raise `InputError` where it holds text, NaN or infinity."""
    if column.dtype == pl.String:
        column = column.str.strip_chars()
        column = column.set(column == "", None)
    made = column.cast(pl.Float64, strict=False)
    bad = (made.is_null() & column.is_not_null()) | (made.is_not_null() & ~made.is_finite().fill_null(False))
    rows = bad.arg_true()
    if len(rows):
        row = int(rows[0])
        raise InputError(
            f"{shown(path)}: row {row + 1}: {column.name} = {shown(column[row], 40)}: must be a finite number or empty"
        )
    return made.fill_null(np.nan).to_numpy().astype(float)


# Checks of all rows --------------------------------------------------------------------------------------------------


def _answered(table: _Table) -> Mask:
    """Return which rows hold a normal: those whose status is empty or ok, shape (rows,)."""
    given = np.isfinite(table.stack(NORMAL))
    status, reason = np.array(table.texts["status"]), np.array(table.texts["reason"])
    ok = (status == "ok") | ((status == "") & ((reason == "") | given.any(axis=1)))
    if (row := table.first(ok & ~given.all(axis=1))) is not None:
        name = NORMAL[int(np.flatnonzero(~given[row])[0])]
        raise table.refuse(row, f"{name} is empty; must be a number, or status must name why there is no normal")
    targets = np.array(table.texts["target"])
    if (row := table.first(~np.isin(targets, ("", "fine", "base")))) is not None:
        raise table.refuse(row, f"target = {shown(targets[row], 40)}: must be fine, base or empty")
    return np.asarray(ok)


def _check_frames(table: _Table, record: Record) -> None:
    """Raise `InputError` for a frame that was not exported; warn where frames have no row."""
    for row, frame in enumerate(table.texts["frame"]):
        if frame not in record.frames:
            what = f"among the {len(record.frames)} names of frames.csv"
            raise table.refuse(row, f"frame = {shown(frame, 60) if frame else 'empty'}: must be {what}")
    if left := len(record.frames) - len(set(table.texts["frame"])):
        what = "frame has no row; its" if left == 1 else "frames have no row; their"
        warnings.warn(f"{shown(table.path)}: {left} of {len(record.frames)} {what} highlights count as missed",
                      stacklevel=4)  # fmt: skip


def _specularities(table: _Table, record: Record) -> list[int | None]:
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


def _points(table: _Table, record: Record, numbers: Sequence[int | None]) -> Array:
    """Return the pixel of each row, shape (rows, 2): as given, or the peak of the detection."""
    points = table.stack(PIXEL)
    for row in np.flatnonzero(~np.isfinite(points).all(axis=1)).tolist():
        number = numbers[row]
        if number is None or np.isfinite(points[row]).any():
            if table.texts["status"][row] == MISSED:
                continue
            raise table.refuse(row, "x_px or y_px is empty; both must be given, or none and specularity")
        points[row] = record.frames[table.texts["frame"][row]].peaks[number]
    return points


def _normals(table: _Table, is_answer: Mask) -> Array:
    """Return the unit normals, shape (rows, 3); raise `InputError` where a length is not 1."""
    normals = table.stack(NORMAL)
    return _unit(table, normals, is_answer, "normal")


def _seconds(table: _Table, is_answer: Mask) -> Array:
    """Return the second candidates, shape (rows, 3), NaN where there is none."""
    seconds = table.stack(SECOND)
    given = np.isfinite(seconds)
    if (row := table.first(given.any(axis=1) & ~given.all(axis=1))) is not None:
        raise table.refuse(row, "second_x, second_y or second_z is empty; all three must be given, or none")
    return _unit(table, seconds, is_answer & given.all(axis=1), "second")


def _unit(table: _Table, vectors: Array, wanted: Mask, what: str) -> Array:
    lengths = np.sqrt((vectors**2).sum(axis=1))
    if (row := table.first(wanted & ~(np.abs(lengths - 1) <= UNIT_TOLERANCE))) is not None:
        raise table.refuse(row, f"{what} has length {lengths[row]:.6g}; must be a unit vector")
    # Rounded numbers are scaled; exact ones keep their last bits.
    rounded = wanted & (np.abs(lengths - 1) > ROUNDING)
    vectors[rounded] /= lengths[rounded, None]
    return vectors


def _covariances(table: _Table, is_answer: Mask) -> Array:
    """Return cov_11, cov_12 and cov_22, shape (rows, 3), NaN where there is none."""
    made = table.stack(COVARIANCE)
    given = np.isfinite(made)
    if (row := table.first(is_answer & given.any(axis=1) & ~given.all(axis=1))) is not None:
        raise table.refuse(row, f"{', '.join(COVARIANCE)}: some are empty; all three must be given, or none")
    first, mixed, second = made.T
    for name, value in (("cov_11", first), ("cov_22", second)):
        if (row := table.first(is_answer & ((value < 0) | (value > LARGEST_VARIANCE)))) is not None:
            raise table.refuse(
                row, f"{name} = {value[row]:g}: must be a variance in rad^2, 0 to {LARGEST_VARIANCE:.4g}"
            )
    largest = np.sqrt(np.maximum(first * second, 0))
    if (row := table.first(is_answer & (np.abs(mixed) > largest * (1 + 1e-6) + 1e-15))) is not None:
        bound = f"at most sqrt(cov_11 cov_22) = {largest[row]:g} in size"
        raise table.refuse(row, f"cov_12 = {mixed[row]:g}: must be {bound}")
    other = table.numbers["cov_21"]
    if (row := table.first(is_answer & (np.abs(other - mixed) > 1e-6 * largest + 1e-15))) is not None:
        raise table.refuse(
            row, f"cov_21 = {other[row]:g}: must equal cov_12 = {mixed[row]:g}; a covariance is symmetric"
        )
    return made


def _check_facing(table: _Table, record: Record, is_answer: Mask, points: Array, normals: Array) -> None:
    """Raise `InputError` for a normal that faces away from the camera at its pixel."""
    cameras = [record.frames[frame].camera for frame in table.texts["frame"]]
    for name, rows in _rows_by(cameras):
        sightlines = _camera(record, name).unproject(points[rows])
        towards = np.sum(sightlines * normals[rows], axis=1)
        away = np.zeros(table.rows, dtype=bool)
        away[rows] = is_answer[rows] & (towards >= 0)
        if (row := table.first(away)) is not None:
            normal = " ".join(f"{value:.4g}" for value in normals[row])
            raise table.refuse(
                row, f"normal ({normal}) faces away from the camera; z points forward, so it must be below 0 in front"
            )


def _rows_by(keys: Sequence[str]) -> Iterator[tuple[str, Array]]:
    """Yield each key with the indices of its rows."""
    order: dict[str, list[int]] = {}
    for row, key in enumerate(keys):
        order.setdefault(key, []).append(row)
    yield from ((key, np.array(rows)) for key, rows in order.items())


def _camera(record: Record, name: str) -> Camera:
    return validate(CameraSpec, dict(record.cameras[name]), f"export.json: {name}").model()


# Answers -------------------------------------------------------------------------------------------------------------


def _estimate(table: _Table, row: int, point: Array, normal: Array, second: Array, covariance: Array) -> Estimate:
    """Return the estimate of a row."""
    candidates = np.stack([normal, second]) if np.isfinite(second).all() else normal[None]
    stated = None
    if np.isfinite(covariance).all():
        stated = np.array([[covariance[0], covariance[1]], [covariance[1], covariance[2]]])
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


def _optional(table: _Table, name: str, row: int) -> float | None:
    value = float(table.numbers[name][row])
    return value if np.isfinite(value) else None


def _flags(table: _Table, row: int) -> tuple[str, ...]:
    return tuple(flag for part in table.texts["flags"][row].split(",") if (flag := part.strip()))


def _failure(table: _Table, row: int) -> Failure:
    """Return the refusal of a row: with the reason that it names, or as text."""
    status = table.texts["status"][row]
    detail = table.texts["reason"][row] or table.texts["flags"][row]
    try:
        return Failure(Reason(status), detail)
    except ValueError:
        return Failure(Reason.NO_ESTIMATE, ": ".join(part for part in (status, detail) if part))
