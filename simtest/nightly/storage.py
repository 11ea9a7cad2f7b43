"""A run as files: the rows, the figures, and the run's record with their hashes."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import polars as pl

from simtest.errors import InputError, SimtestError
from simtest.nightly.records import FIGURES, NightlyRun, RunRecord
from simtest.runtime.boundary import explain
from simtest.runtime.files import read_json, sync_folder, write_atomically, write_json
from simtest.runtime.provenance import file_hash

FIGURES_FILE, RUN_FILE = "figures.parquet", "run.json"
LATEST_ROWS, BASELINE_ROWS = "rows.parquet", "night.parquet"

_FAST: dict[str, Any] = {"compression": "zstd", "compression_level": 19}
_SMALL: dict[str, Any] = {"compression": "brotli", "compression_level": 11}
"""4 % smaller, in seven times the time: for baselines, which stand in git."""


@contextlib.contextmanager
def disk_errors_in_one_line(root: Path, what: str, left: str) -> Iterator[None]:
    """Raise `SimtestError`, of one line, in place of an error of the disk, also one that polars hands on.

    The line names the reports' `root`, what could not be done, and what is left as it was. Any other error is a fault,
    and stays what it is.
    """
    try:
        yield
    except (OSError, pl.exceptions.PolarsError, SimtestError) as error:
        # A full disk under an experiment's scratch folder is told by the name of that; the user gave the reports'.
        cause = error.__cause__ if type(error) is SimtestError else error
        why = None if cause is None or isinstance(cause, SimtestError) else explain(cause)
        if why is None:
            raise
        raise SimtestError(f"--reports {root}: {what} ({why}); {left}") from error


def save_run(folder: Path, run: NightlyRun, rows_file: str, smallest: bool = False) -> None:
    """Write a run into an existing folder: run.json, the figures and the rows, in the `smallest` form if need be."""
    # The record comes last: it holds the hashes of the tables.
    tables = {rows_file: run.rows, FIGURES_FILE: run.figures}
    how = _SMALL if smallest else _FAST
    for name, table in tables.items():
        write_atomically(folder / name, lambda part, table=table: table.write_parquet(part, **how))  # type: ignore[misc]
    hashes = {name: file_hash(folder / name) for name in tables}
    write_json(folder / RUN_FILE, {**run.record.to_json(), "files": hashes})
    sync_folder(folder)


def load_run(folder: Path, rows_file: str) -> NightlyRun:
    """Read a run."""
    record, hashes = _record(folder / RUN_FILE)
    # A table of another run has another hash.
    rows, figures = (_table(folder / name, hashes) for name in (rows_file, FIGURES_FILE))
    check_columns(folder / FIGURES_FILE, figures, FIGURES)
    # An older version's have canaries and costs among them, which are of no cell and have no hash.
    return NightlyRun(record, rows, figures.select(*FIGURES).drop_nulls("digest"))


def check_columns(path: Path, table: pl.DataFrame, schema: Mapping[str, pl.DataType]) -> None:
    """Raise `InputError`, with file and column, where a table lacks a column or holds one of another type."""
    for name, dtype in schema.items():
        if name not in table.columns:
            raise InputError(f"{path}: damaged (no column {name})")
        if table.schema[name] != dtype:
            raise InputError(f"{path}: damaged (column {name} is of type {table.schema[name]}, not {dtype})")


def _record(path: Path) -> tuple[RunRecord, dict[str, str]]:
    """Read a run's record, and the hashes of its tables by file name."""
    data = read_json(path, "a run's record")
    try:
        hashes = data.pop("files", None)
        record = RunRecord.model_validate(data)
        sound = {"id", "profile", "started"} <= record.model_fields_set and record.start is not None
    except (AttributeError, TypeError, KeyError, ValueError):
        sound = False
    if not sound:
        raise InputError(f"{path}: damaged (no record of a night, with id, profile and started)")
    if not isinstance(hashes, dict):
        raise InputError(f"{path}: damaged (no hashes under files)")
    return record, hashes


def _table(path: Path, hashes: Mapping[str, str]) -> pl.DataFrame:
    try:
        same = file_hash(path) == hashes.get(path.name)
        if same:
            return pl.read_parquet(path, memory_map=False)
    except pl.exceptions.PolarsError as error:
        raise InputError(f"{path}: damaged ({str(error).splitlines()[0]})") from error
    raise InputError(f"{path}: damaged, or not of the same night as {RUN_FILE} (another SHA-256)")
