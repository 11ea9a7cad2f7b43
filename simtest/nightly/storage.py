"""A night as files: the rows, the figures, and the run's record with their hashes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import polars as pl

from simtest.errors import InputError
from simtest.files import sync_folder, write_atomically, write_json
from simtest.gate.records import FIGURES, Night
from simtest.provenance import file_hash
from simtest.resources import shown

FIGURES_FILE, RUN_FILE = "figures.parquet", "run.json"
TONIGHT_ROWS, BASELINE_ROWS = "rows.parquet", "night.parquet"


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
    if missing := next((name for name in FIGURES if name not in figures.columns), None):
        raise InputError(f"{shown(folder / FIGURES_FILE)}: damaged (no column {missing})")
    return Night({key: value for key, value in run.items() if key != "files"}, rows, figures.select(*FIGURES))


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
