"""The history of nights: an immutable Parquet file each, which is never changed once it is there."""

import hashlib
import json
import re
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.gate.records import FIGURES, PLACE, Night, Verdict
from simtest.runtime.files import sync_folder, write_atomically
from simtest.runtime.resources import shown

HISTORY: dict[str, pl.DataType] = {
    **FIGURES, "run_id": pl.String(), "started": pl.Datetime("us", "UTC"), "commit": pl.String(),
    "profile": pl.String(), "state": pl.String(), "bit_equal": pl.Boolean(), "processor": pl.String(),
    "versions": pl.String(), "duration_s": pl.Float64(), "source_hash": pl.String(),
}  # fmt: skip
"""Columns of the history: a night's figures, and what is the same in all its rows."""

_NEEDED = ("kind", "experiment", "estimator", "quantity", "value", "run_id", "started", "profile")
"""Without these a file is no night's; the others, which a later version may have added, are null where they lack."""

DIGEST_DIGITS = 16
"""Digits of a place's hash that are kept: enough to see whether two nights are the same."""

TRENDS = ("mean_deg", "unanswered", "coverage95")
"""Quantities of settings whose course over the nights the page shows."""

TREND_COLUMNS = (
    "kind", *PLACE, "quantity", "unit", "value", "run_id", "started", "commit", "state", "profile",
)  # fmt: skip
"""Columns that the page needs of the history: all of 1,000 nights would take gigabytes."""

MAX_NAMED = 5
"""Damaged files that the notes name one by one."""


def history_rows(night: Night, verdict: Verdict) -> pl.DataFrame:
    """Give a night's figures with the columns `HISTORY`."""
    run = night.run
    constant: dict[str, Any] = {
        "run_id": run["id"],
        "started": datetime.fromisoformat(run["started"]).astimezone(UTC),
        "commit": run["commit"],
        "profile": run["profile"],
        "state": verdict.state,
        "bit_equal": verdict.bit_equal,
        "processor": run["processor"],
        "versions": versions_hash(run["versions"]),
        "duration_s": run["duration_s"],
        "source_hash": run["source_hash"],
    }
    figures = night.figures.select(pl.col(name).cast(dtype) for name, dtype in FIGURES.items())
    # Whole, it would be most of the file.
    figures = figures.with_columns(pl.col("digest").str.slice(0, DIGEST_DIGITS))
    return figures.with_columns(pl.lit(value, dtype=HISTORY[name]).alias(name) for name, value in constant.items())


def versions_hash(versions: Mapping[str, str]) -> str:
    """Give a short hash of packages' versions."""
    return hashlib.sha256(json.dumps(dict(versions), sort_keys=True).encode()).hexdigest()[:12]


def append(folder: Path, rows: pl.DataFrame) -> Path:
    """Write a night's rows into the history.

    Parameters
    ----------
    folder : Path
        The history; made if need be.
    rows : polars.DataFrame
        As `history_rows` gives them.

    Returns
    -------
    Path
        The file: whole on disk, or not there at all.
    """
    run_id, started, commit = rows.row(0, named=True)["run_id"], rows["started"][0], rows["commit"][0]
    partition = folder / f"date={started:%Y-%m-%d}" / f"commit={short_commit(commit)}"
    partition.mkdir(parents=True, exist_ok=True)
    file = partition / f"{run_id}.parquet"
    write_atomically(file, lambda part: rows.write_parquet(part, compression="zstd"))
    for made in (partition, partition.parent, folder):
        sync_folder(made)
    return file


def short_commit(commit: str | None) -> str:
    """Give a commit as it stands in names: 12 digits, "+" where the checkout was changed, or "unknown"."""
    found = re.fullmatch(r"([0-9a-f]{12})[0-9a-f]*(\+?)", commit or "")
    return "".join(found.groups()) if found else "unknown"


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
        Only the nights of this profile.
    columns : sequence of str
        Of `HISTORY`, `run_id`, `started`, `profile`, `kind` and `quantity` among them.
    quantities : sequence of str, optional
        Of the settings' figures, only these; default all.

    Returns
    -------
    rows : polars.DataFrame
        The columns, night after night by the time they started, whatever their folders are called.
    notes : list of str
        What was skipped, for the page.
    """
    files = sorted(path for path in folder.glob("date=*/commit=*/*.parquet") if not path.name.startswith("."))
    # Reading waits for the disk more than it works.
    with ThreadPoolExecutor(4) as pool:
        read = list(pool.map(lambda file: _read(file, columns, quantities), files))
    nights: dict[str, pl.DataFrame] = {}
    skipped = []
    for file, found in zip(files, read, strict=True):
        told = found if isinstance(found, str) else _twice(found, nights)
        if told:
            warnings.warn(f"{shown(file)}: {told}; skipped", stacklevel=2)
            skipped.append(f"{shown(file.relative_to(folder))} ({told})")
        elif not isinstance(found, str):
            nights[found["run_id"][0]] = found
    wanted = [night for night in nights.values() if profile in (None, night["profile"][0])]
    wanted.sort(key=lambda night: (night["started"][0], night["run_id"][0]))
    return pl.concat([trend_columns(pl.DataFrame(schema=HISTORY), columns), *wanted]), _told(skipped)


def trend_columns(
    rows: pl.DataFrame, columns: Sequence[str] = TREND_COLUMNS, quantities: Sequence[str] | None = None
) -> pl.DataFrame:
    """Give the columns and figures of some rows of the history that `read_history` would give."""
    if quantities is not None:
        rows = rows.filter((pl.col("kind") != "setting") | pl.col("quantity").is_in(quantities))
    return rows.select(columns)


def _twice(found: pl.DataFrame, nights: Mapping[str, pl.DataFrame]) -> str:
    return "a night that another file holds already" if found["run_id"][0] in nights else ""


def _told(skipped: list[str]) -> list[str]:
    if not skipped:
        return []
    more = f" and {len(skipped) - MAX_NAMED} more" if len(skipped) > MAX_NAMED else ""
    files = f"file{'s' * (len(skipped) > 1)}"
    return [f"History: {len(skipped)} {files} skipped: {'; '.join(skipped[:MAX_NAMED])}{more}."]


def _read(file: Path, columns: Sequence[str], quantities: Sequence[str] | None) -> pl.DataFrame | str:
    """Read one night's file; text says why it cannot be used."""
    try:
        held = pl.read_parquet_schema(file)
        if missing := [name for name in _NEEDED if name not in held]:
            return f"no night's figures: no column {missing[0]}"
        wanted = [name for name in columns if name in held]
        found = pl.read_parquet(file, columns=wanted, hive_partitioning=False, memory_map=False)
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        return f"not a readable Parquet file: {_first_line(error)}"
    as_written = [
        (pl.col(name) if name in wanted else pl.lit(None)).cast(HISTORY[name]).alias(name) for name in columns
    ]
    try:
        found = found.select(as_written)
    except pl.exceptions.PolarsError as error:
        return f"no night's figures: {_first_line(error)}"
    if not found.height or found["run_id"].n_unique() > 1 or found.select(_NEEDED[5:]).null_count().row(0) != (0, 0, 0):
        return "no night's figures: must be those of one run, with its id, start and profile"
    return trend_columns(found, columns, quantities)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:160]


def clock_note(history: pl.DataFrame, started: datetime) -> str | None:
    """Say so where a night starts before one that the history holds already: the clock went back."""
    last = history["started"].max()
    if not isinstance(last, datetime) or last <= started:
        return None
    return (
        f"The clock went back: this night started {started:%Y-%m-%d %H:%M:%S} UTC, "
        f"and the history holds one of {last:%Y-%m-%d %H:%M:%S}."
    )
