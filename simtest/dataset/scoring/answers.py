"""Normals that were estimated elsewhere: a table of them, CSV or Parquet, read and checked, given as an estimator's.

A whole table may also give mistakes away: pixels, axes or units other than simtest's.
"""

import codecs
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.calibration import Frame
from simtest.dataset.scoring.frames import Record
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.dispatch import assign
from simtest.estimators.protocol import Target, check
from simtest.geometry import Patch
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.boundary import close_names
from simtest.runtime.files import require_plain
from simtest.spec.camera import CameraSpec
from simtest.spec.spec_model import validate
from simtest.validation.scoring import MISSED

_TAKEN = Failure(Reason.NO_ESTIMATE, "a row names this detection")


@dataclass(frozen=True)
class Answer:
    """One row of a table of answers."""

    result: Estimate | Failure  # the normal, or why there is none
    point_px: Array  # pixel that is answered for, shape (2,)
    specularity: int | None = None  # number of the detection in highlights.csv; without it the pixel decides


@dataclass(frozen=True)
class TableEstimator:
    """Answers made elsewhere, of one frame. It sees nothing of the frame: what it returns was in the table."""

    answers: Sequence[Answer]

    def estimate_regions(
        self, _frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return the answer for each patch, None where the table has no row, and normals that belong to no patch."""
        # Rows that name a detection.
        of_patches: list[Estimate | Failure | None] = [None] * len(patches)
        located = []
        for answer in self.answers:
            if answer.specularity is None:
                located.append(answer)
            else:
                of_patches[answer.specularity] = answer.result
        # The others by their pixel, to patches that none has named.
        free = [patch if own is None else _TAKEN for patch, own in zip(patches, of_patches, strict=True)]
        taken = assign([answer.point_px for answer in located], free)
        for patch, index in taken.items():
            of_patches[patch] = located[index].result
        used = set(taken.values())
        rest = [answer.result for index, answer in enumerate(located) if index not in used]
        return of_patches, [result for result in rest if not isinstance(result, Failure)]


Answers = Mapping[str, Mapping[str, Sequence[Answer]]]
"""Answers by estimator and frame."""


# The file -------------------------------------------------------------------------------------------------------------

NORMAL = ("normal_x", "normal_y", "normal_z")
SECOND = ("second_x", "second_y", "second_z")
COVARIANCE = ("cov_11", "cov_12", "cov_22")
PIXEL = ("x_px", "y_px")
NUMBERS = (*PIXEL, *NORMAL, *SECOND, *COVARIANCE, "cov_21", "axis_ratio", "choice_margin")
TEXTS = ("frame", "estimator", "target", "flags", "status", "reason")
COLUMNS = (*TEXTS, "specularity", *NUMBERS)

DOUBLED = re.compile(r"_duplicated_\d+$")
"""What polars appends to a column's name that is there already."""


@dataclass(frozen=True)
class Table:
    """A table as it was read: columns by name, the number of rows, and the file for messages."""

    path: Path
    numbers: Mapping[str, Array]
    texts: Mapping[str, list[str]]
    rows: int

    def refuse(self, row: int, what: str) -> InputError:
        """Return the error of a row, counted from 1 without the header."""
        return InputError(f"{self.path}: row {row + 1}: {what}")

    def first(self, wrong: npt.ArrayLike) -> int | None:
        """Return the first row of which something is true, shape (rows,); None where it is true of none."""
        found = np.flatnonzero(wrong)
        return int(found[0]) if len(found) else None

    def stack(self, names: Sequence[str]) -> Array:
        """Return columns side by side, shape (rows, len(names))."""
        return np.stack([self.numbers[name] for name in names], axis=1)


def read_table(path: Path) -> Table:
    """Read a table; numbers that are not given are NaN, texts that are not given empty."""
    require_plain(path, wanted="a CSV or Parquet table")
    is_parquet = path.suffix.lower() in (".parquet", ".pq")
    with path.open("rb") as file:
        # Spreadsheets save "Unicode text" so.
        if not is_parquet and file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            raise InputError(f"{path}: is UTF-16; must be a CSV table in UTF-8")
    try:
        # As text: whether a value is a number is judged below, where the row is known.
        frame = pl.read_parquet(path, hive_partitioning=False) if is_parquet else pl.read_csv(path, infer_schema=False)
    except (pl.exceptions.PolarsError, OSError, UnicodeDecodeError) as error:
        kind = "Parquet" if is_parquet else "CSV"
        raise InputError(f"{path}: no {kind} table ({str(error).splitlines()[0][:120]})") from error
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
            raise InputError(f"{path}: column {name} is {frame[name].dtype}; must hold {kind}") from error
    return Table(path, numbers, texts, frame.height)


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
            f"{path}: column {missing[0]} is missing; must have frame, x_px and y_px or specularity, "
            f"{', '.join(NORMAL)}, and all of a group such as {', '.join(COVARIANCE)} or none; "
            f"has {', '.join(columns)!s:.120}{' (commas must separate them)' if len(columns) == 1 else ''}"
        )
    unknown = [name for name in columns if name not in COLUMNS]
    twice = next((base for name in unknown if (base := DOUBLED.sub("", name)) != name and base in COLUMNS), None)
    if twice is not None:
        raise InputError(f"{path}: column {twice} is given twice; must be one column")
    if unknown:
        near = close_names(unknown[0], COLUMNS)
        meant = f" (is {near[0]} meant?)" if near else ""
        listed = ", ".join(str(name) for name in unknown[:5]) + (", ..." if len(unknown) > 5 else "")
        warnings.warn(f"{path}: columns that are not read: {listed}{meant}", stacklevel=5)


def _number_column(path: Path, column: pl.Series) -> Array:
    """Return a column as numbers, NaN where it is empty; raise `InputError` where it holds text, NaN or infinity."""
    if column.dtype == pl.String:
        column = column.str.strip_chars()
        column = column.set(column == "", None)
    if column.dtype.is_temporal() or column.dtype == pl.Boolean:
        raise InputError(f"{path}: column {column.name} is {column.dtype}; must hold numbers")
    made = column.cast(pl.Float64, strict=False)
    bad = (made.is_null() & column.is_not_null()) | (made.is_not_null() & ~made.is_finite().fill_null(False))
    rows = bad.arg_true()
    if len(rows):
        row = int(rows[0])
        raise InputError(
            f"{path}: row {row + 1}: {column.name} = {column[row]!s:.40}: must be a finite number or empty"
        )
    return made.fill_null(np.nan).to_numpy().astype(float)


# The table ------------------------------------------------------------------------------------------------------------

LONGEST_NAME = 80
"""Characters of a method's name."""


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
    cameras = {
        name: validate(CameraSpec, dict(described), f"export.json: {name}").model()
        for name, described in record.cameras.items()
    }
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
    # no pixel that is farther from the detection which its row names than the box is wide
    for row, (number, point) in enumerate(zip(numbers, points.tolist(), strict=True)):
        if number is None:
            continue
        *corner, width, height = record.frames[table.texts["frame"][row]].boxes[number]
        gaps = [max(low - at, at - low - size) for low, at, size in zip(corner, point, (width, height), strict=True)]
        if max(gaps) > max(width, height):
            where = f"detection {number}, whose box is {width} x {height} px at ({corner[0]}, {corner[1]})"
            raise table.refuse(row, f"x_px = {point[0]:g}, y_px = {point[1]:g}: must lie at {where} (highlights.csv)")
    return points


def _whole(table: Table, columns: Sequence[str], wanted: Mask) -> Array:
    """Return columns that are given together, shape (rows, 3), NaN where they are not."""
    values = table.stack(columns)
    given = np.isfinite(values)
    if (row := table.first(wanted & given.any(axis=1) & ~given.all(axis=1))) is not None:
        raise table.refuse(row, f"{', '.join(columns)}: some are empty; all three must be given, or none")
    return values


def _estimate(table: Table, row: int, point: Array, normal: Array, second: Array, covariance: Array) -> Estimate:
    """Return the estimate of a row."""
    candidates = np.stack([normal, second]) if np.isfinite(second).all() else normal[None]
    stated = None
    if np.isfinite(covariance).all():
        first, mixed, last = covariance
        other = table.numbers["cov_21"][row]
        stated = np.array([[first, mixed], [other if np.isfinite(other) else mixed, last]])
    target: Target = "base" if table.texts["target"][row] == "base" else "fine"
    axis_ratio, margin = (float(table.numbers[name][row]) for name in ("axis_ratio", "choice_margin"))
    return Estimate(
        normal=normal,
        candidates=candidates,
        look_px=point,
        axis_ratio=axis_ratio if np.isfinite(axis_ratio) else None,
        choice_margin=margin if np.isfinite(margin) else None,
        covariance=stated,
        flags=tuple(flag for part in table.texts["flags"][row].split(",") if (flag := part.strip())),
        target=target,
    )


def _failure(table: Table, row: int) -> Failure:
    """Return the refusal of a row: with the reason that it names, or as text."""
    status = table.texts["status"][row]
    detail = table.texts["reason"][row] or table.texts["flags"][row]
    try:
        return Failure(Reason(status), detail)
    except ValueError:
        return Failure(Reason.NO_ESTIMATE, ": ".join(part for part in (status, detail) if part))


# Doubts ---------------------------------------------------------------------------------------------------------------

LEAST_ROWS = 5
"""Rows that a doubt about all of them needs."""

STRAY_SHARE = 0.5
"""Of the rows: so many outside every detection are more than a detector's differences."""

CLEARLY = 0.5
"""A reversal is told where it leaves less than this share of the median error ..."""

LEAST_GAIN_DEG = 1.0
"""... and takes away more than this."""

FAR_TOO_WIDE = 20.0
"""A standard deviation so many times the error is doubted; one in degrees is 57 times too large ..."""

LEAST_WIDE_DEG = 5.0
"""... and one below this is not, since a method may state the resolution of its frames."""

REVERSALS: Mapping[str, tuple[int, int]] = {"x": (-1, 1), "y": (1, -1), "x and y": (-1, -1)}
"""Signs of normal_x and normal_y. With z reversed a normal faces away, which is refused row by row."""


def stray_rows(answers: Answers, record: Record) -> str | None:
    """Return a warning where most rows lie in no region of a detection, as region-relative pixels do."""
    inside: list[bool] = []
    for by_frame in answers.values():
        for frame, rows in by_frame.items():
            boxes = np.array(record.frames[frame].boxes, dtype=float).reshape(-1, 4)
            located = [answer.point_px for answer in rows if answer.specularity is None]
            low, high = boxes[:, :2], boxes[:, :2] + boxes[:, 2:]
            inside += [bool(((point >= low) & (point <= high)).all(axis=1).any()) for point in located]
    stray = inside.count(False)
    if stray < LEAST_ROWS or stray <= STRAY_SHARE * len(inside):
        return None
    return (
        f"{stray} of {len(inside)} rows lie in no detection's region (highlights.csv); x_px, x to the right, and y_px, "
        "down, count from the frame's upper left corner"
    )


def reversed_axes(results: pl.DataFrame) -> list[str]:
    """Return a warning for each method whose normals are right with an axis reversed."""
    rows = results.filter(pl.col("status") == "ok").drop_nulls(["normal_x", "truth_x"])
    found = []
    for (name,), own in rows.group_by("estimator", maintain_order=True):
        if own.height < LEAST_ROWS:
            continue
        normals = own.select("normal_x", "normal_y", "normal_z").to_numpy()
        truths = own.select("truth_x", "truth_y", "truth_z").to_numpy()
        as_given = _median_deg(normals, truths)
        errors = {axis: _median_deg(normals * [*signs, 1], truths) for axis, signs in REVERSALS.items()}
        axis = min(errors, key=lambda each: errors[each])
        if errors[axis] < CLEARLY * as_given and as_given - errors[axis] > LEAST_GAIN_DEG:
            found.append(
                f"{name}: with {axis} of the normals reversed the median error is {errors[axis]:.3g} deg, not "
                f"{as_given:.3g}; axes must be x to the right, y down, z forward"
            )
    return found


def wide_regions(results: pl.DataFrame) -> list[str]:
    """Return a warning for each method that states a far greater uncertainty than its errors have, as deg^2 do."""
    rows = results.filter(pl.col("status") == "ok").drop_nulls(["cov_11", "cov_22", "error_deg"])
    found = []
    for (name,), own in rows.group_by("estimator", maintain_order=True):
        stated = np.degrees(np.sqrt((own["cov_11"].to_numpy() + own["cov_22"].to_numpy()) / 2))
        errors = own["error_deg"].to_numpy()
        if own.height < LEAST_ROWS or np.median(stated) < LEAST_WIDE_DEG:
            continue
        if np.median(errors / stated) < 1 / FAR_TOO_WIDE:
            found.append(
                f"{name}: the covariances state a standard deviation of {np.median(stated):.3g} deg in the median, and "
                f"the median error is {np.median(errors):.3g} deg; must be in rad^2 (1 deg^2 is 0.000305 rad^2)"
            )
    return found


def _median_deg(normals: Array, truths: Array) -> float:
    return float(np.median(angle_deg(normals, truths)))
