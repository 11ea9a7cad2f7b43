"""Reads a table of answers, CSV or Parquet: its columns as numbers and texts."""

import codecs
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import close_names
from simtest.runtime.files import require_plain

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
    if not is_parquet and _is_utf16(path):
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


def _is_utf16(path: Path) -> bool:
    """Return whether a file begins with the mark of UTF-16, as spreadsheets save "Unicode text"."""
    with path.open("rb") as file:
        return file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


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
