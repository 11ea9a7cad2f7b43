"""The folder of a run: what it holds while the run goes on and afterwards, and what else it may be refused for."""

import re
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.files import read_json, write_json
from simtest.runtime.locks import LOCK

RESULTS = "results.parquet"
SUMMARY = "summary.json"
MOST_DIGEST_BYTES = 1000
PARTS = "parts"
"""Folder of the finished cases of a run that is not finished."""
EXPORT = "export.json"
"""What was exported of a run (`simtest.dataset.export`); it stands in the run's folder."""
EXPORTING = "exporting"
"""Folder of the lists of a run's export that is not finished."""
TRUTH = "truth"
"""Folder of the truths by which maps of its exported frames are scored (`simtest.dataset.scoring.dense`)."""


def part_file(parts: Path, index: int) -> Path:
    """Return the file of a finished case."""
    return parts / f"case-{index:05d}.parquet"


def record_in(folder: Path) -> dict[str, Any] | None:
    """Return how the finished run in a folder was made; None where there is none."""
    try:
        if (folder / PARTS).is_dir():
            # Beside the parts of a stopped run anything may be incomplete.
            return None
        record = read_json(folder / SUMMARY)["run"]
        return dict(record) if "fingerprint" in record else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def holds_finished(folder: Path, digest: str) -> bool:
    """Return whether a folder holds the finished run of a fingerprint, with the results that were written."""
    record = record_in(folder)
    if record is None or record["fingerprint"] != digest:
        return False
    try:
        return provenance.file_hash(folder / RESULTS) == record.get("results")
    except (InputError, OSError):
        return False


def prepare(folder: Path, digest: str) -> None:
    """Make the run's folder; keep the finished cases of the same run, stopped, and drop those of another."""
    parts = folder / PARTS
    record = parts / "fingerprint.json"
    if not (record.is_file() and record.stat().st_size < MOST_DIGEST_BYTES and _told_digest(record) == digest):
        # Results of an earlier run stay until the new ones replace them.
        remove_folder(parts)
        remove_folder(folder / "gallery")
        remove_folder(folder / TRUTH)
    parts.mkdir(parents=True, exist_ok=True)
    (folder / "gallery").mkdir(exist_ok=True)
    write_json(record, digest)


def _told_digest(record: Path) -> str:
    return record.read_text(encoding="utf-8", errors="replace").strip().strip('"')


def check_folder(folder: Path) -> None:
    """Raise `InputError` if a folder holds something other than a run; remove what a killed run was writing."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file; must be a folder")
    # Leftovers of a killed run.
    held = {path.name: path for path in folder.iterdir()} if folder.is_dir() else {}
    for name in [name for name in held if re.fullmatch(r"\.(results|summary|guide|index)\.\d+\.part\.\w+", name)]:
        held.pop(name).unlink()
    for left in (*folder.glob(f"{PARTS}/.*.part.*"), *folder.glob("gallery/.*.part.*")):
        left.unlink()
    # What is no part of a run.
    held.pop(LOCK, None)
    own = {RESULTS, SUMMARY, "gallery", "figures", "guide.json", "index.html"}
    own |= {PARTS, EXPORT, EXPORTING, TRUTH}
    strangers = sorted(held.keys() - own)
    # Folders of those names alone may be anyone's, and a run would replace them.
    if not strangers and not held.keys() & {"results.parquet", PARTS}:
        strangers = sorted(held)
    if strangers:
        stranger = str(strangers[0])
        raise InputError(f"--out {folder}: holds {stranger}, which is no part of a run; must be empty or hold a run")


def remove_folder(folder: Path) -> None:
    """Remove a folder of plain files that a run has made."""
    if folder.is_dir():
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
