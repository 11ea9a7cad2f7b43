"""What the nightly keeps: the folders of its reports, runs as files, their history, and the accepted baseline.

Folders are changed so that a kill at any moment leaves them whole.
"""

import contextlib
import dataclasses
import hashlib
import json
import os
import secrets
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from simtest.errors import InputError, SimtestError
from simtest.nightly.quantities import OLDEST_COLUMNS, OPTIONAL_COLUMNS, RESULT_COLUMNS
from simtest.nightly.records import CELL, FIGURES, NightlyRun, RunRecord, Verdict
from simtest.runtime.boundary import explain
from simtest.runtime.files import read_json, require_plain, sync_folder, write_json, write_parquet
from simtest.runtime.locks import exclusive_file, waiting_for
from simtest.runtime.provenance import file_hash
from simtest.validation.columns import SCHEMA


@dataclass(frozen=True)
class Reports:
    """Folders under ``--reports``, the `root`, which is made if need be."""

    root: Path

    def history(self, profile: str) -> Path:
        """Return the folder of a profile's history: the figures of all runs, a file each, never changed."""
        return self.root / "history" / profile

    @property
    def work(self) -> Path:
        """Scratch of runs in progress, a folder for each profile."""
        return self.root / "work"

    def baseline(self, profile: str) -> Path:
        """Return the folder of a profile's accepted numbers."""
        return self.root / "baseline" / profile

    def latest(self, profile: str) -> Path:
        """Return the folder of a profile's last run: numbers, page and outputs for machines."""
        return self.root / "nightly" / profile

    def make(self) -> None:
        """Make the root; raise `InputError` where that cannot be."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except FileExistsError:
            raise InputError(f"--reports {self.root}: is a file; must be a folder") from None


def new_run_id(now: datetime) -> str:
    """Return a name that no other run has, whatever the clock says."""
    return f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{os.getpid()}-{secrets.token_hex(4)}"


@contextlib.contextmanager
def only_night(reports: Reports, profile: str) -> Iterator[Path]:
    """Keep a profile's nights to this process, and yield its scratch folder, which is removed at the end.

    What a killed night left there is removed first. Raises `InputError`, which names the other process, where one is at
    work.
    """
    reports.make()
    with exclusive_file(reports.root / profile, "--reports"), scratch(reports.work / profile) as folder:
        yield folder


@contextlib.contextmanager
def scratch(folder: Path) -> Iterator[Path]:
    """Make a folder that nobody else uses, anew, and remove it at the end."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def exclusive_replacement(folder: Path) -> Iterator[None]:
    """Lock the folder for replacement; first roll back an interrupted swap."""
    with waiting_for(folder.parent / f".{folder.name}.lock"):
        if (where := current(folder)) != folder:
            where.rename(folder)
        shutil.rmtree(_old(folder), ignore_errors=True)
        yield


def current(folder: Path) -> Path:
    """Return where a folder lies: aside, where a kill between the two renames of `replace_folder` left it."""
    return _old(folder) if _old(folder).is_dir() and not folder.is_dir() else folder


def replace_folder(new: Path, folder: Path) -> None:
    """Replace a folder, if any, by a finished one, under `exclusive_replacement`: at any moment one of them exists.

    Both are on the same file system, the new one's files on disk.
    """
    # Move the old folder aside, the new one in, then delete
    old = _old(folder)
    if folder.exists():
        folder.rename(old)
    new.rename(folder)
    sync_folder(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


def _old(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.old")


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
        why = None if cause is None or isinstance(cause, SimtestError) else explain(cause, root)
        if why is None:
            raise
        raise SimtestError(f"--reports {root}: {what} ({why}); {left}") from error


def save_run(folder: Path, run: NightlyRun, rows_file: str, smallest: bool = False) -> None:
    """Write a run into an existing folder: run.json, the figures and the rows, in the `smallest` form if need be."""
    # The record comes last: it holds the hashes of the tables.
    tables = {rows_file: run.rows, FIGURES_FILE: run.figures}
    how = _SMALL if smallest else _FAST
    for name, table in tables.items():
        write_parquet(folder / name, table, **how)
    hashes = {name: file_hash(folder / name) for name in tables}
    write_json(folder / RUN_FILE, {**run.record.to_json(), "files": hashes})
    sync_folder(folder)


def load_run(folder: Path, rows_file: str) -> NightlyRun:
    """Read a run; raise `InputError`, which names the file, if one is missing, damaged, or not of this run."""
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


_TYPES = {name: SCHEMA[name] for name in RESULT_COLUMNS if name not in OLDEST_COLUMNS} | OPTIONAL_COLUMNS

SINGLE_PRECISION = tuple(name for name, dtype in _TYPES.items() if dtype == pl.Float64())
"""Columns that a baseline keeps in single precision, for it lies in git: they are compared with margins."""

REFERENCE = "error_deg"
NEAR_REFERENCE = ("error_oracle_deg", "error_base_deg", "error_look_deg")
"""Errors that equal `REFERENCE` in most rows. Each is kept as the bits in which the two differ, so most are 0 and
compress well; no value changes."""

_BITS = "_bits"
"""Ends the name of a column of such bits."""


def small(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows as a baseline keeps them; `whole` undoes everything but the rounding to single precision."""
    made = rows.with_columns(pl.col(name).cast(pl.Float32) for name in SINGLE_PRECISION if name in rows.columns)
    if REFERENCE not in rows.columns:
        return made
    reference = _bits(rows[REFERENCE])
    for name in (name for name in NEAR_REFERENCE if name in rows.columns):
        kept = pl.Series(name + _BITS, _bits(made[name]) ^ reference)
        kept = pl.select(pl.when(made[name].is_not_null()).then(kept)).to_series()
        # At the column's own position.
        made = made.with_columns(kept.alias(name)).rename({name: name + _BITS})
    return made


def whole(rows: pl.DataFrame, path: Path) -> pl.DataFrame:
    """Return the rows of a baseline in double precision, errors restored; `path` is their file, for messages.

    Baselines of older versions, which hold the errors themselves, are read too. Raises `InputError` if a column is of
    another type than `small` gives it.
    """
    for name in NEAR_REFERENCE:
        held = name + _BITS
        if held not in rows.columns:
            continue
        types = {column: rows.schema.get(column) for column in (held, REFERENCE)}
        if types != {held: pl.UInt32(), REFERENCE: pl.Float64()}:
            told = ", ".join(f"column {column} is of type {kind}" for column, kind in types.items())
            raise InputError(f"{path}: damaged ({told}; must be UInt32 and Float64)")
        bits = rows[held].fill_null(0).to_numpy() ^ _bits(rows[REFERENCE])
        restored = pl.Series(name, bits.view(np.float32))
        restored = pl.select(pl.when(rows[held].is_not_null()).then(restored)).to_series()
        rows = rows.with_columns(restored.alias(held)).rename({held: name})
    return rows.with_columns(pl.col(name).cast(pl.Float64) for name in SINGLE_PRECISION if name in rows.columns)


def _bits(values: pl.Series) -> "np.ndarray[tuple[int], np.dtype[np.uint32]]":
    """Return the bits of values in single precision; null counts as 0."""
    return np.ascontiguousarray(values.cast(pl.Float32).fill_null(0.0).to_numpy()).view(np.uint32)


LOG = "log.jsonl"
MAX_REASON = 1000

COLUMNS = (*CELL, "realisation", *RESULT_COLUMNS, *OPTIONAL_COLUMNS)
"""Columns of the rows that a baseline keeps: what names a row, and what `simtest.nightly.compare` reads.

Those of `OPTIONAL_COLUMNS` stand in runs of some scenes alone.
"""

NEEDED = (*CELL, "realisation", *OLDEST_COLUMNS)
"""Columns without which a baseline is none; one of an older version may lack the others."""


def load_baseline(reports: Reports, profile: str) -> NightlyRun | None:
    """Read the baseline of a profile, with `reason` and `accepted` in its record; None where there is none.

    Raises `InputError`, which names the file, if one is missing or damaged, lacks what `simtest.nightly.compare`
    reads, or is another profile's.
    """
    # Without a lock: the folder is kept in git, and whoever reads it writes nothing there.
    folder = current(reports.baseline(profile))
    if not folder.is_dir():
        return None
    run = load_run(folder, BASELINE_ROWS)
    if run.record.profile != profile:
        raise InputError(
            f"{folder / RUN_FILE}: profile = {run.record.profile}; the baseline of this night must be "
            f"of the profile {profile}"
        )
    rows = whole(run.rows, folder / BASELINE_ROWS)
    types = {**SCHEMA, **OPTIONAL_COLUMNS}
    known = {name: dtype for name, dtype in types.items() if name in NEEDED or name in rows.columns}
    check_columns(folder / BASELINE_ROWS, rows, known)
    return dataclasses.replace(run, rows=rows)


def log_note(reports: Reports, profile: str) -> str | None:
    """Return a note where the log of acceptances holds a line that is no entry, such as one that was cut off."""
    path = reports.baseline(profile) / LOG
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{path}: cannot be read ({error.strerror})."
    broken = [number for number, line in enumerate(lines, 1) if not _is_entry(line)]
    if not broken:
        return None
    more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
    return (
        f"{path}: damaged (line {broken[0]}{more} of {len(lines)} is no entry; cut off?); the rest is kept, "
        "the baseline itself is sound."
    )


def _is_entry(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False


def accept(reports: Reports, profile: str, reason: str) -> RunRecord:
    """Make a profile's last run its baseline, and store the reason why its numbers are right; return its record.

    Raises `InputError` if there is no last run, it is damaged, or no reason is given, and `SimtestError` if the disk is
    full, or may not be written.
    """
    reason = " ".join(reason.split())
    if not reason or len(reason) > MAX_REASON:
        raise InputError(f"--reason: {len(reason)} characters; must be 1 to {MAX_REASON} that say why")
    with disk_errors_in_one_line(reports.root, "the baseline could not be written", "the last one is as it was"):
        return _accept(reports, profile, reason)


def _accept(reports: Reports, profile: str, reason: str) -> RunRecord:
    source, target = reports.latest(profile), reports.baseline(profile)
    # Nothing is made where there never was a night.
    if not source.parent.is_dir():
        raise InputError(f"{source}: no night of the profile {profile}; run simtest nightly first")
    reports.make()
    # Read tonight's run under its lock, so that no other run replaces it meanwhile.
    with exclusive_replacement(source):
        if not source.is_dir():
            raise InputError(f"{source}: no night of the profile {profile}; run simtest nightly first")
        run = load_run(source, LATEST_ROWS)
    now = datetime.now(UTC)
    record = run.record.model_copy(update={"reason": reason, "accepted": now.isoformat(timespec="seconds")})
    with exclusive_replacement(target), scratch(reports.work / f".{profile}.baseline") as new:
        rows = small(run.rows.select(name for name in COLUMNS if name in run.rows.columns))
        save_run(new, NightlyRun(record, rows, run.figures), BASELINE_ROWS, smallest=True)
        replaced: str | None = None
        # The log of all acceptances goes along.
        if (target / LOG).is_file():
            held = (target / LOG).read_bytes()
            # A last line that was cut off is ended, so that the next entry has one of its own.
            (new / LOG).write_bytes(held + b"\n" * (held[-1:] not in (b"", b"\n")))
        entry = {key: getattr(record, key) for key in ("accepted", "reason", "id", "started", "commit", "processor")}
        with contextlib.suppress(InputError):
            replaced = _record(target / RUN_FILE)[0].id
        with (new / LOG).open("a", encoding="utf-8") as log:
            log.write(json.dumps({**entry, "replaces": replaced}) + "\n")
        replace_folder(new, target)
    return record


HISTORY: dict[str, pl.DataType] = {
    **FIGURES, "run_id": pl.String(), "started": pl.Datetime("us", "UTC"), "commit": pl.String(),
    "profile": pl.String(), "state": pl.String(), "bit_equal": pl.Boolean(), "processor": pl.String(),
    "versions": pl.String(), "duration_s": pl.Float64(), "source_hash": pl.String(),
}  # fmt: skip
"""Columns of the history: a run's figures, and what is the same in all its rows."""

DIGEST_DIGITS = 16
"""Digits of a cell's hash that are kept: enough to see whether two runs are the same."""

TRENDS = ("mean_deg", "unanswered", "coverage95")
"""Quantities whose course over the runs the page shows."""

TREND_COLUMNS = (*CELL, "quantity", "unit", "value", "run_id", "started", "commit", "state")
"""Columns of the history that the page needs."""

NEWEST = 400
"""Runs that the page shows: it neither grows nor takes longer with each night."""

MAX_NAMED = 5
"""Damaged files that the notes name one by one."""


def history_rows(run: NightlyRun, verdict: Verdict) -> pl.DataFrame:
    """Return a run's figures with the columns `HISTORY`."""
    record = run.record
    versions = hashlib.sha256(json.dumps(record.versions, sort_keys=True).encode()).hexdigest()[:12]
    # The whole digest would be most of the file.
    digest = pl.col("digest").str.slice(0, DIGEST_DIGITS)
    return run.figures.select(*FIGURES).with_columns(
        digest, run_id=pl.lit(record.id), started=pl.lit(record.start, HISTORY["started"]),
        commit=pl.lit(record.commit, pl.String), profile=pl.lit(record.profile), state=pl.lit(verdict.state),
        bit_equal=pl.lit(verdict.bit_equal, pl.Boolean), processor=pl.lit(record.processor, pl.String),
        versions=pl.lit(versions), duration_s=pl.lit(record.duration_s, pl.Float64),
        source_hash=pl.lit(record.source_hash, pl.String),
    )  # fmt: skip


def append(folder: Path, rows: pl.DataFrame, scratch: Path) -> Path:
    """Write a run's rows (see `history_rows`) into a profile's history; the file is whole there, or not at all.

    It is made in `scratch`, on the same file system: whoever reads ``*.parquet`` never meets half of one.
    """
    name = f"{rows['run_id'][0]}.parquet"
    folder.mkdir(parents=True, exist_ok=True)
    write_parquet(scratch / name, rows, compression="zstd")
    os.replace(scratch / name, folder / name)
    # The new names outlast a loss of power.
    for made in (folder, folder.parent):
        sync_folder(made)
    return folder / name


def trend_rows(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows and columns of the history that `read_history` returns."""
    # Figures of no estimator are checks of older versions.
    return rows.filter(pl.col("quantity").is_in(TRENDS), pl.col("estimator") != "").select(*TREND_COLUMNS)


def read_history(folder: Path, newest: int = NEWEST) -> tuple[pl.DataFrame, list[str]]:
    """Read what the page shows of the `newest` runs of a profile's history, and notes of what was skipped.

    The rows are `TREND_COLUMNS` of the quantities `TRENDS`, run after run in the order of their start. Files are chosen
    by name, which begins with the run's start; damaged and foreign ones are skipped, with a warning each.
    """
    runs: dict[str, pl.DataFrame] = {}
    skipped = []
    for file in sorted(folder.glob("*.parquet"))[-newest:]:
        found = _read(file)
        if not isinstance(found, str) and found["run_id"][0] in runs:
            found = "a night that another file holds already"
        if isinstance(found, str):
            warnings.warn(f"{file}: {found}; skipped", stacklevel=2)
            skipped.append(f"{file.relative_to(folder)} ({found})")
        else:
            runs[found["run_id"][0]] = found
    # The run's id may be of a clock that went back.
    ordered = sorted(runs.values(), key=lambda run: (run["started"][0], run["run_id"][0]))
    none = pl.DataFrame(schema=HISTORY).select(*TREND_COLUMNS)
    rows = pl.concat([none, *map(trend_rows, ordered)])
    if not skipped:
        return rows, []
    more = f" and {len(skipped) - MAX_NAMED} more" if len(skipped) > MAX_NAMED else ""
    files = f"{len(skipped)} file{'s' * (len(skipped) > 1)}"
    return rows, [f"History: {files} skipped: {'; '.join(skipped[:MAX_NAMED])}{more}."]


def _read(file: Path) -> pl.DataFrame | str:
    """Read one run's file; return the reason where it cannot be used."""
    try:
        found = pl.read_parquet(require_plain(file), columns=list(TREND_COLUMNS), memory_map=False)
        found = found.cast({name: HISTORY[name] for name in TREND_COLUMNS})
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0][:160]
        return f"not a night's figures: {first}"
    if found["run_id"].n_unique() != 1 or any(found.select("run_id", "started").null_count().row(0)):
        return "not a night's figures: must be those of one run, with its id and start"
    return found


def clock_note(history: pl.DataFrame, started: datetime) -> str | None:
    """Return a note where a run starts before one that the history holds already: the clock went back."""
    last = history["started"].max()
    if not isinstance(last, datetime) or last <= started:
        return None
    return (
        f"The clock went back: this night started {started:%Y-%m-%d %H:%M:%S} UTC, "
        f"and the history holds one of {last:%Y-%m-%d %H:%M:%S}."
    )
