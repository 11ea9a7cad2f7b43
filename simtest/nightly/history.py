"""The history of runs: a Parquet file each in the folder of its profile, never changed once it is there."""

import hashlib
import json
import os
import warnings
from datetime import datetime
from pathlib import Path

import polars as pl

from simtest.nightly.records import CELL, FIGURES, NightlyRun, Verdict
from simtest.runtime.files import require_plain, sync_folder, write_atomically

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
    write_atomically(scratch / name, lambda part: rows.write_parquet(part, compression="zstd"))
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
