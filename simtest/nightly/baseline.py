"""The baseline: the numbers of a run that somebody accepted, and why."""

import dataclasses
import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

from simtest.errors import InputError
from simtest.nightly.gate.quantities import OLDEST_COLUMNS, OPTIONAL_COLUMNS, RESULT_COLUMNS
from simtest.nightly.layout import (
    Reports,
    current,
    exclusive_replacement,
    new_run_id,
    remove_dead,
    replace_folder,
    scratch,
)
from simtest.nightly.records import CELL, NightlyRun, RunRecord
from simtest.nightly.small_rows import small, whole
from simtest.nightly.storage import (
    BASELINE_ROWS,
    LATEST_ROWS,
    RUN_FILE,
    check_columns,
    disk_errors_in_one_line,
    load_run,
    save_run,
)
from simtest.runtime.files import require_plain
from simtest.runtime.resources import shown
from simtest.validation.columns import SCHEMA

LOG = "log.jsonl"
MAX_REASON = 1000

COLUMNS = (*CELL, "realisation", *RESULT_COLUMNS, *OPTIONAL_COLUMNS)
"""Columns of the rows that a baseline keeps: what names a row, and what `simtest.nightly.gate.compare` reads.

Those of `OPTIONAL_COLUMNS` stand in runs of some scenes alone.
"""

NEEDED = (*CELL, "realisation", *OLDEST_COLUMNS)
"""Columns without which a baseline is none; one of an older version may lack the others."""


def load_baseline(reports: Reports, profile: str) -> NightlyRun | None:
    """Read the baseline of a profile, with `reason` and `accepted` in its record; None where there is none.

    Raises
    ------
    InputError
        If a file of it is missing or damaged, lacks what `simtest.nightly.gate.compare` reads, or is another profile's;
        the message names it.
    """
    # Without a lock: the folder is kept in git, and whoever reads it writes nothing there.
    folder = current(reports.baseline(profile))
    if not folder.is_dir():
        return None
    run = load_run(folder, BASELINE_ROWS)
    if run.record.profile != profile:
        raise InputError(
            f"{shown(folder / RUN_FILE)}: profile = {shown(run.record.profile)}; the baseline of this night must be "
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
        return f"{shown(path)}: cannot be read ({error.strerror})."
    broken = [number for number, line in enumerate(lines, 1) if not _is_entry(line)]
    if not broken:
        return None
    more = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
    return (
        f"{shown(path)}: damaged (line {broken[0]}{more} of {len(lines)} is no entry; cut off?); the rest is kept, "
        "the baseline itself is sound."
    )


def _is_entry(line: str) -> bool:
    try:
        return isinstance(json.loads(line), dict)
    except ValueError:
        return False


def accept(reports: Reports, profile: str, reason: str) -> RunRecord:
    """Make a profile's last run its baseline, and store the reason why its numbers are right.

    Returns
    -------
    RunRecord
        The baseline's.

    Raises
    ------
    InputError
        If there is no last run, it is damaged, or no reason is given.
    SimtestError
        If the disk is full, or may not be written.
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
        raise InputError(f"{shown(source)}: no night of the profile {profile}; run simtest nightly first")
    reports.make()
    # Read tonight's run under its lock, so that no other run replaces it meanwhile.
    with exclusive_replacement(source):
        if not source.is_dir():
            raise InputError(f"{shown(source)}: no night of the profile {profile}; run simtest nightly first")
        run = load_run(source, LATEST_ROWS)
    now = datetime.now(UTC)
    record = run.record.model_copy(update={"reason": reason, "accepted": now.isoformat(timespec="seconds")})
    remove_dead(reports)
    with scratch(reports, new_run_id(now)) as folder, exclusive_replacement(target):
        new = folder / "baseline"
        new.mkdir()
        rows = small(run.rows.select(name for name in COLUMNS if name in run.rows.columns))
        save_run(new, NightlyRun(record, rows, run.figures), BASELINE_ROWS, smallest=True)
        # The log of all acceptances goes along.
        if (target / LOG).is_file():
            shutil.copyfile(target / LOG, new / LOG)
            _end_line(new / LOG)
        entry = {key: getattr(record, key) for key in ("accepted", "reason", "id", "started", "commit", "processor")}
        with (new / LOG).open("a", encoding="utf-8") as log:
            log.write(json.dumps({**entry, "replaces": _replaced(reports, profile)}) + "\n")
        replace_folder(new, target)
    return record


def _end_line(log: Path) -> None:
    """End a last line that was cut off, so that the next entry has one of its own."""
    held = log.read_bytes()
    if held and not held.endswith(b"\n"):
        log.write_bytes(held + b"\n")


def _replaced(reports: Reports, profile: str) -> str | None:
    """Return the id of the run that was the baseline, if its record can still be read."""
    try:
        found = json.loads(
            require_plain(reports.baseline(profile) / RUN_FILE, "record_bytes").read_text(encoding="utf-8")
        )
        return str(found["id"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
