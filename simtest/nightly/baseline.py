"""The baseline: the numbers of a night that somebody accepted, and why."""

import json
import shutil
from datetime import UTC, datetime
from typing import Any

from simtest.errors import InputError
from simtest.nightly.gate.quantities import RESULT_COLUMNS
from simtest.nightly.gate.records import PLACE, Night
from simtest.nightly.layout import Reports, new_run_id, remove_dead, replace_folder, scratch, turn
from simtest.nightly.storage import (
    BASELINE_ROWS,
    RUN_FILE,
    TONIGHT_ROWS,
    check_columns,
    load_night,
    save_night,
    told_in_one_line,
)
from simtest.runtime.resources import shown
from simtest.validation.results_table import SCHEMA

LOG = "log.jsonl"
MAX_REASON = 1000

COLUMNS = (*PLACE, "realisation", *RESULT_COLUMNS)
"""Columns of the rows that a baseline keeps: what names a row, and what `simtest.nightly.gate.compare` reads."""


def load_baseline(reports: Reports, profile: str) -> Night | None:
    """Give the baseline of a profile, with `reason` and `accepted` in its record; None where there is none.

    Raises
    ------
    InputError
        If a file of it is missing or damaged, lacks what `simtest.nightly.gate.compare` reads, or is another profile's;
        the message names it.
    """
    folder = reports.baseline(profile)
    with turn(folder):
        if not folder.is_dir():
            return None
        night = load_night(folder, BASELINE_ROWS)
    if night.run["profile"] != profile:
        raise InputError(
            f"{shown(folder / RUN_FILE)}: profile = {shown(night.run['profile'])}; the baseline of this night must be "
            f"of the profile {profile}"
        )
    check_columns(folder / BASELINE_ROWS, night.rows, {name: SCHEMA[name] for name in COLUMNS})
    return night


def accept(reports: Reports, profile: str, reason: str) -> dict[str, Any]:
    """Make a profile's last night its baseline.

    Parameters
    ----------
    reports : Reports
        Where the night lies.
    profile : str
        Its name.
    reason : str
        Why its numbers are right, for those who read them later.

    Returns
    -------
    dict
        The baseline's record.

    Raises
    ------
    InputError
        If there is no last night, it is damaged, or no reason is given.
    SimtestError
        If the disk is full, or may not be written.
    """
    reason = " ".join(reason.split())
    if not reason or len(reason) > MAX_REASON:
        raise InputError(f"--reason: {len(reason)} characters; must be 1 to {MAX_REASON} that say why")
    with told_in_one_line(reports.root, "the baseline could not be written; the last one is as it was"):
        return _accept(reports, profile, reason)


def _accept(reports: Reports, profile: str, reason: str) -> dict[str, Any]:
    source, target = reports.tonight(profile), reports.baseline(profile)
    reports.make()
    with turn(source):
        if not source.is_dir():
            raise InputError(f"{shown(source)}: no night of the profile {profile}; run simtest nightly first")
        night = load_night(source, TONIGHT_ROWS)
    now = datetime.now(UTC)
    run = {**night.run, "reason": reason, "accepted": now.isoformat(timespec="seconds")}
    remove_dead(reports)
    with scratch(reports, new_run_id(now)) as folder, turn(target):
        new = folder / "baseline"
        new.mkdir()
        save_night(new, Night(run, night.rows, night.figures), BASELINE_ROWS, COLUMNS)
        if (target / LOG).is_file():
            shutil.copyfile(target / LOG, new / LOG)
        entry = {key: run.get(key) for key in ("accepted", "reason", "id", "started", "commit", "processor")}
        with (new / LOG).open("a", encoding="utf-8") as log:
            log.write(json.dumps({**entry, "replaces": _replaced(reports, profile)}) + "\n")
        replace_folder(new, target)
    return run


def _replaced(reports: Reports, profile: str) -> str | None:
    """Give the id of the night that was the baseline, if its record can still be read."""
    try:
        found = json.loads((reports.baseline(profile) / RUN_FILE).read_text(encoding="utf-8"))
        return str(found["id"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
