"""A night as files: the rows, the figures, and the run's record with their hashes."""

import contextlib
import errno
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from simtest.errors import InputError, SimtestError
from simtest.nightly.gate.records import FIGURES, Night
from simtest.runtime.files import sync_folder, write_atomically, write_json
from simtest.runtime.provenance import file_hash
from simtest.runtime.resources import shown

FIGURES_FILE, RUN_FILE = "figures.parquet", "run.json"
TONIGHT_ROWS, BASELINE_ROWS = "rows.parquet", "night.parquet"

_OF_THE_DISK = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ENOTDIR,
    errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG,
}  # fmt: skip


@contextlib.contextmanager
def told_in_one_line(root: Path, said: str) -> Iterator[None]:
    """Turn what the disk refuses into an error that says so; any other error is a fault, and stays what it is.

    Parameters
    ----------
    root : Path
        Folder of the reports.
    said : str
        What could not be done; what is left as it was, after a semicolon.

    Raises
    ------
    SimtestError
        In place of an error of the file system, also of one that polars hands on.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _OF_THE_DISK and "(os error " not in str(error):
            raise
        raise _refused(root, said, error.strerror or str(error)) from error
    except pl.exceptions.PolarsError as error:
        # Its own errors, of a missing column say, have nothing to do with the disk.
        if "(os error " not in str(error):
            raise
        raise _refused(root, said, str(error)) from error


def _refused(root: Path, said: str, why: str) -> SimtestError:
    what, _, left = said.partition("; ")
    return SimtestError(f"--reports {shown(root)}: {what} ({' '.join(why.split())[:200]}); {left}")


def save_night(folder: Path, night: Night, rows_file: str, columns: Sequence[str] | None = None) -> None:
    """Write a night.

    Parameters
    ----------
    folder : Path
        Exists.
    night : Night
        The night.
    rows_file : str
        Name of the file of rows.
    columns : sequence of str, optional
        The rows' columns that are kept; default all.
    """
    rows = night.rows if columns is None else night.rows.select(name for name in columns if name in night.rows.columns)
    tables = {rows_file: rows, FIGURES_FILE: night.figures}
    for name, table in tables.items():
        write_atomically(folder / name, lambda part, table=table: _write(table, part))  # type: ignore[misc]
    write_json(folder / RUN_FILE, {**night.run, "files": {name: file_hash(folder / name) for name in tables}})
    sync_folder(folder)


def _write(table: pl.DataFrame, path: Path) -> None:
    table.write_parquet(path, compression="zstd", compression_level=19)


def load_night(folder: Path, rows_file: str) -> Night:
    """Read a night.

    Raises
    ------
    InputError
        If a file is missing, damaged, or not the one that was written; the message names it.
    """
    run = _record(folder / RUN_FILE)
    rows, figures = (_table(folder / name, run) for name in (rows_file, FIGURES_FILE))
    check_columns(folder / FIGURES_FILE, figures, FIGURES)
    return Night({key: value for key, value in run.items() if key != "files"}, rows, figures.select(*FIGURES))


def check_columns(path: Path, table: pl.DataFrame, schema: Mapping[str, pl.DataType]) -> None:
    """Refuse a table that lacks a column, or holds one of another type.

    Raises
    ------
    InputError
        The message names file and column.
    """
    for name, dtype in schema.items():
        if name not in table.columns:
            raise InputError(f"{shown(path)}: damaged (no column {name})")
        if table.schema[name] != dtype:
            raise InputError(f"{shown(path)}: damaged (column {name} is of type {table.schema[name]}, not {dtype})")


def _record(path: Path) -> dict[str, Any]:
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{shown(path)}: damaged (not JSON: {error})") from error
    if not isinstance(run, dict) or not all(isinstance(run.get(key), str) for key in ("id", "profile", "started")):
        raise InputError(f"{shown(path)}: damaged (no record of a night, with id, profile and started)")
    if not isinstance(run.get("files"), dict):
        raise InputError(f"{shown(path)}: damaged (no hashes under files)")
    return run


def _table(path: Path, run: dict[str, Any]) -> pl.DataFrame:
    try:
        same = file_hash(path) == run["files"].get(path.name)
        if same:
            return pl.read_parquet(path, memory_map=False)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    except pl.exceptions.PolarsError as error:
        raise InputError(f"{shown(path)}: damaged ({str(error).splitlines()[0]})") from error
    raise InputError(f"{shown(path)}: damaged, or not of the same night as {RUN_FILE} (another SHA-256)")
