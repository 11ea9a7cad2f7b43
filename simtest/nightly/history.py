"""The history of runs: an immutable Parquet file each, which is never changed once it is there."""

import hashlib
import json
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime
from pathlib import Path

import polars as pl

from simtest.nightly.phrases import short_commit
from simtest.nightly.records import CELL, FIGURES, NightlyRun, Verdict
from simtest.runtime.files import require_plain, sync_folder, write_atomically
from simtest.runtime.resources import shown

HISTORY: dict[str, pl.DataType] = {
    **FIGURES, "run_id": pl.String(), "started": pl.Datetime("us", "UTC"), "commit": pl.String(),
    "profile": pl.String(), "state": pl.String(), "bit_equal": pl.Boolean(), "processor": pl.String(),
    "versions": pl.String(), "duration_s": pl.Float64(), "source_hash": pl.String(),
}  # fmt: skip
"""Columns of the history: a run's figures, and what is the same in all its rows."""

_NEVER_NULL = ("run_id", "started", "profile")
_NEEDED = ("kind", "experiment", "estimator", "quantity", "value", *_NEVER_NULL)
"""Columns without which a file is none of the history; the others, which a later version may have added, may lack."""

DIGEST_DIGITS = 16
"""Digits of a cell's hash that are kept: enough to see whether two runs are the same."""

TRENDS = ("mean_deg", "unanswered", "coverage95")
"""Quantities of settings whose course over the runs the page shows."""

TREND_COLUMNS = (
    "kind", *CELL, "quantity", "unit", "value", "run_id", "started", "commit", "state", "profile",
)  # fmt: skip
"""Columns of the history that the page needs: all columns of 1,000 runs would take gigabytes."""

MAX_NAMED = 5
"""Damaged files that the notes name one by one."""


def history_rows(run: NightlyRun, verdict: Verdict) -> pl.DataFrame:
    """Return a run's figures with the columns `HISTORY`."""
    record = run.record
    # The whole digest would be most of the file.
    digest = pl.col("digest").str.slice(0, DIGEST_DIGITS)
    return run.figures.select(*FIGURES).with_columns(
        digest, run_id=pl.lit(record.id), started=pl.lit(record.start, HISTORY["started"]),
        commit=pl.lit(record.commit, pl.String), profile=pl.lit(record.profile), state=pl.lit(verdict.state),
        bit_equal=pl.lit(verdict.bit_equal, pl.Boolean), processor=pl.lit(record.processor, pl.String),
        versions=pl.lit(versions_hash(record.versions)), duration_s=pl.lit(record.duration_s, pl.Float64),
        source_hash=pl.lit(record.source_hash, pl.String),
    )  # fmt: skip


def versions_hash(versions: Mapping[str, str]) -> str:
    """Return a short hash of packages' versions."""
    return hashlib.sha256(json.dumps(dict(versions), sort_keys=True).encode()).hexdigest()[:12]


def append(folder: Path, rows: pl.DataFrame) -> Path:
    """Write a run's rows (see `history_rows`) into the history; the file is whole on disk, or not there at all."""
    run_id, started, commit = rows.select("run_id", "started", "commit").row(0)
    partition = folder / f"date={started:%Y-%m-%d}" / f"commit={short_commit(commit)}"
    partition.mkdir(parents=True, exist_ok=True)
    file = partition / f"{run_id}.parquet"
    write_atomically(file, lambda part: rows.write_parquet(part, compression="zstd"))
    # The new names outlast a loss of power.
    for made in (partition, partition.parent, folder):
        sync_folder(made)
    return file


def read_history(
    folder: Path,
    profile: str | None = None,
    columns: Sequence[str] = tuple(HISTORY),
    quantities: Sequence[str] | None = None,
) -> tuple[pl.DataFrame, list[str]]:
    """Read the history; files that are damaged or foreign are skipped, with a warning each.

    Parameters
    ----------
    folder : Path
        The history; may be missing.
    profile : str, optional
        Only the runs of this profile.
    columns : sequence of str
        Of `HISTORY`, `run_id`, `started`, `profile`, `kind` and `quantity` among them.
    quantities : sequence of str, optional
        Of the settings' figures, only these; default all.

    Returns
    -------
    rows : polars.DataFrame
        The columns, run after run in the order of their start, whatever their folders are called.
    notes : list of str
        What was skipped, for the page.
    """
    files = sorted(path for path in folder.glob("date=*/commit=*/*.parquet") if not path.name.startswith("."))
    # Reading waits for the disk more than it works.
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(lambda file: _read(file, columns, quantities), files))
    # Skip what cannot be used, and copies
    runs: dict[str, pl.DataFrame] = {}
    skipped = []
    for file, found in zip(files, read, strict=True):
        if not isinstance(found, str) and found["run_id"][0] in runs:
            found = "a night that another file holds already"
        if isinstance(found, str):
            warnings.warn(f"{shown(file)}: {found}; skipped", stacklevel=2)
            skipped.append(f"{shown(file.relative_to(folder))} ({found})")
        else:
            runs[found["run_id"][0]] = found
    wanted = [run for run in runs.values() if profile in (None, run["profile"][0])]
    wanted.sort(key=lambda run: (run["started"][0], run["run_id"][0]))
    return pl.concat([pl.DataFrame(schema=HISTORY).select(columns), *wanted]), _skipped_note(skipped)


def trend_columns(
    rows: pl.DataFrame, columns: Sequence[str] = TREND_COLUMNS, quantities: Sequence[str] | None = None
) -> pl.DataFrame:
    """Return the columns and figures of some rows of the history that `read_history` would return."""
    if quantities is not None:
        rows = rows.filter((pl.col("kind") != "setting") | pl.col("quantity").is_in(quantities))
    return rows.select(columns)


def _skipped_note(skipped: list[str]) -> list[str]:
    if not skipped:
        return []
    more = f" and {len(skipped) - MAX_NAMED} more" if len(skipped) > MAX_NAMED else ""
    files = f"file{'s' * (len(skipped) > 1)}"
    return [f"History: {len(skipped)} {files} skipped: {'; '.join(skipped[:MAX_NAMED])}{more}."]


def _read(file: Path, columns: Sequence[str], quantities: Sequence[str] | None) -> pl.DataFrame | str:
    """Read one run's file; return the reason where it cannot be used."""
    try:
        held = pl.read_parquet_schema(require_plain(file))
        if missing := [name for name in _NEEDED if name not in held]:
            return f"no night's figures: no column {missing[0]}"
        wanted = [name for name in columns if name in held]
        found = pl.read_parquet(file, columns=wanted, hive_partitioning=False, memory_map=False)
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        return f"not a readable Parquet file: {_first_line(error)}"
    # Columns that a later version added are null.
    try:
        found = found.select(
            (pl.col(name) if name in wanted else pl.lit(None)).cast(HISTORY[name]).alias(name) for name in columns
        )
    except pl.exceptions.PolarsError as error:
        return f"no night's figures: {_first_line(error)}"
    if found["run_id"].n_unique() != 1 or any(found.select(_NEVER_NULL).null_count().row(0)):
        return "no night's figures: must be those of one run, with its id, start and profile"
    return trend_columns(found, columns, quantities)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:160]


def clock_note(history: pl.DataFrame, started: datetime) -> str | None:
    """Return a note where a run starts before one that the history holds already: the clock went back."""
    last = history["started"].max()
    if not isinstance(last, datetime) or last <= started:
        return None
    return (
        f"The clock went back: this night started {started:%Y-%m-%d %H:%M:%S} UTC, "
        f"and the history holds one of {last:%Y-%m-%d %H:%M:%S}."
    )
