"""The folders of the nightly's reports, and changing them so that a kill at any moment leaves them whole."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.files import sync_folder
from simtest.runtime.locks import exclusive_file, is_held, waiting_for

LOCK = "lock"
_ENTRY, _OLD = ".lock", ".old"


@dataclass(frozen=True)
class Reports:
    """Folders under ``--reports``, the `root`, which is made if need be."""

    root: Path

    def history(self, profile: str) -> Path:
        """Return the folder of a profile's history: the figures of all runs, a file each, never changed."""
        return self.root / "history" / profile

    @property
    def work(self) -> Path:
        """Scratch of runs in progress, a folder each."""
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
def scratch(reports: Reports, run_id: str) -> Iterator[Path]:
    """Make a run's scratch folder, locked while the run lives and removed when it ends."""
    folder = reports.work / run_id
    with contextlib.ExitStack() as stack:
        # Together with the lock, or another run would take the folder for a dead one's.
        with waiting_for(reports.work / _ENTRY):
            folder.mkdir()
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            stack.enter_context(waiting_for(folder / LOCK))
        yield folder


def remove_dead(reports: Reports) -> list[str]:
    """Remove the leftovers of killed runs and return their names; living runs hold a lock and are left alone."""
    dead = []
    with waiting_for(reports.work / _ENTRY):
        for folder in sorted(path for path in reports.work.iterdir() if path.is_dir()):
            if not is_held(folder / LOCK):
                shutil.rmtree(folder, ignore_errors=True)
                dead.append(folder.name)
    return dead


@contextlib.contextmanager
def only_night(reports: Reports, profile: str) -> Iterator[None]:
    """Keep a profile's nights to this process; raise `InputError`, which names the other one, where one is at work."""
    reports.make()
    with exclusive_file(reports.root / profile, "--reports"):
        yield


@contextlib.contextmanager
def exclusive_replacement(folder: Path) -> Iterator[None]:
    """Lock the folder for replacement; first roll back an interrupted swap."""
    with waiting_for(folder.parent / f".{folder.name}.{LOCK}"):
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
    return folder.with_name(f".{folder.name}{_OLD}")
