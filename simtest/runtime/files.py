"""Atomic writing of files: a reader never meets half of one."""

import contextlib
import errno
import json
import os
import stat
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime.limits import VARIABLE, limit
from simtest.runtime.machine_errors import cannot_write
from simtest.runtime.resources import shown

Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]
"""What a JSON file can hold."""
JsonObject = dict[str, Any]
"""An object as it stands in a JSON file: what records become when they are written, and are made of when read."""


def refuse_file(folder: Path, option: str = "--out") -> None:
    """Raise `InputError` if the path of a results folder is a file, or a link that leads nowhere.

    `option` is how the user names it.
    """
    what = f"{option} {shown(folder)}"
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{what}: is a file; must be a folder")
        if not folder.exists() and folder.is_symlink():
            raise InputError(f"{what}: is a link to {shown(os.readlink(folder))}, which does not exist; make it first")
    except OSError as error:
        raise cannot_write(error, what, folder) from error


def make_folder(folder: Path, option: str = "--out") -> None:
    """Make a folder for results; raise `InputError` if that is impossible, `SimtestError` if its disk is full."""
    refuse_file(folder, option)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(error, f"{option} {shown(folder)}", folder) from error


def are_nested(one: Path, other: Path) -> bool:
    """Return whether two folders, which need not exist, are the same one, or one lies inside the other."""
    first, second = one.resolve(), other.resolve()
    return first == second or first in second.parents or second in first.parents


def require_plain(path: Path, limited_by: str | None = None) -> Path:
    """Return a path that is a plain file, and within a limit of `simtest.runtime.limits` where one is named.

    Raises `OSError` if it is none: a pipe or a device might never end.
    """
    found = path.stat()
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.ENXIO, "is no plain file", str(path))
    if limited_by is not None and found.st_size > limit(limited_by):
        told = f"at most {limit(limited_by)} are allowed ({VARIABLE}={limited_by}=N sets another limit)"
        raise OSError(errno.EFBIG, f"{found.st_size} bytes; {told}", str(path))
    return path


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under a temporary name, flush it to disk, then rename it.

    `write` is called with the temporary path, which has the final file's suffix. An `OSError` names the file, also
    where the system's own does not (a full disk), or where `write` returns False, as OpenCV does.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        if write(part) is False:
            raise OSError(errno.EIO, "cannot be written; is the disk full?", str(path))
        # The content must be on disk before the rename is, or a loss of power leaves an empty file.
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if error.errno is not None and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of files to disk, so that a rename into it survives a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_json(path: Path, value: Any, compact: bool = False) -> None:
    """Write JSON atomically, on one line where `compact`; NaN and infinity are refused, since JSON has none.

    Arrays in it are written as lists, records by their `to_json`, or by their fields where they have none.
    """
    how: dict[str, Any] = {"separators": (",", ":")} if compact else {"indent": 2}
    text = json.dumps(value, allow_nan=False, default=as_json, **how) + "\n"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def as_json(value: Any) -> Any:
    """Return what JSON holds of an array or a record."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return value.to_json() if hasattr(value, "to_json") else vars(value)
