"""Locks between processes: one run writes to a folder, and whoever comes second is told who is there.

A lock is held by the operating system for an open file (flock), so it ends with the process that holds it, however that
ends. What the file holds is for messages alone: a file that a killed process has left behind locks nothing.
"""

import contextlib
import errno
import fcntl
import json
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from simtest.errors import InputError
from simtest.runtime.files import make_folder

LOCK = ".lock"
"""Name of the lock file in a folder, and end of the name of one beside a file."""

_MOST_BYTES = 4096
_WITHOUT_LOCKS = {errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS}


@contextlib.contextmanager
def exclusive_folder(folder: Path, option: str = "--out") -> Iterator[None]:
    """Keep a folder for results to this run; it is made if need be, and removed again if it stays empty.

    Raises `InputError` if another run is at work in the folder: the message names its process. `option` is how the user
    names the folder.
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder, option)
    try:
        with _exclusive(folder / LOCK, folder, option):
            yield
    finally:
        # What was refused leaves nothing behind.
        for path in missing:
            with contextlib.suppress(OSError):
                path.rmdir()


@contextlib.contextmanager
def exclusive_file(path: Path, option: str = "--out") -> Iterator[None]:
    """Keep a file for results to this run, by a lock beside it; its folder must be there.

    Raises `InputError` as `exclusive_folder` does.
    """
    if path.name in ("", ".."):
        raise InputError(f"{option} {path}: is a folder; must be a file")
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: no such folder {path.parent}")
    with _exclusive(path.with_name(f".{path.name[:200]}{LOCK}"), path, option):
        yield


@contextlib.contextmanager
def _exclusive(lock: Path, path: Path, option: str) -> Iterator[None]:
    """Hold a lock of a path meanwhile; where nothing can be locked, or written at all, nobody is refused."""
    try:
        file = _open(lock)
    except OSError as error:
        _require_without_locks(error, path)
        yield
        return
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            taken = is_same(lock, file)
        except BlockingIOError:
            taken = False
        except OSError as error:
            _require_without_locks(error, path)
            taken = True
        if not taken:
            raise InputError(f"{option} {path}: is in use by {_holder(lock)}; wait until it ends, or name another")
        try:
            with contextlib.suppress(OSError):
                file.truncate(0)
                file.write(json.dumps(_own()).encode())
                file.flush()
            yield
        finally:
            # While it is held: whoever waits for the file finds that it is no longer the one of this name.
            # In a folder such as /tmp another user's file stays; without its lock it locks nothing.
            with contextlib.suppress(OSError):
                lock.unlink(missing_ok=True)


def _require_without_locks(error: OSError, path: Path) -> None:
    """Raise an error under the name that the user gave, unless it says that nothing can be locked at this place."""
    if error.errno not in _WITHOUT_LOCKS:
        raise OSError(error.errno or errno.EINVAL, error.strerror or str(error), str(path)) from error


def _open(lock: Path) -> IO[bytes]:
    """Open a lock file, made if need be; only to read where it is another user's in a folder that both may write to.

    Raises `OSError` if it cannot be opened, with EBUSY where another user's file cannot even be read.
    """
    # Not followed where it is a link, and never waited for where it is a pipe.
    flags = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    writing = flags | os.O_RDWR | os.O_CREAT
    try:
        return os.fdopen(os.open(lock, writing, 0o644), "r+b")
    except PermissionError:
        if not os.access(lock.parent, os.W_OK):
            raise
    try:
        return os.fdopen(os.open(lock, flags | os.O_RDONLY), "rb")
    except FileNotFoundError:
        # Just given back, or nothing may be made here.
        return os.fdopen(os.open(lock, writing, 0o644), "r+b")
    except PermissionError as error:
        told = f"{lock.name} is another user's and cannot be read; remove it where no run is at work"
        raise OSError(errno.EBUSY, told) from error


def is_same(path: Path, file: IO[bytes]) -> bool:
    """Return whether an open file is the one that a path names now."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


@contextlib.contextmanager
def waiting_for(path: Path) -> Iterator[IO[bytes]]:
    """Open a file to append to, made if need be, once no other process holds it.

    The holder may meanwhile have renamed or removed the file: then the one that has its name now is taken. Another
    user's file is opened to read alone, which is enough to hold it; where the file system has no locks nobody waits.
    Raises `OSError` if the file cannot be opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with _open(path) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in _WITHOUT_LOCKS:
                    raise
            if is_same(path, file):
                yield file
                return


def _own() -> dict[str, str | int]:
    command = shlex.join([Path(sys.argv[0]).name or "python", *sys.argv[1:]])[:500]
    started = datetime.now(UTC).isoformat(timespec="seconds")
    return {"process": os.getpid(), "machine": socket.gethostname(), "command": command, "started": started}


def _holder(lock: Path) -> str:
    """Return who holds a lock, as far as its file tells."""
    try:
        with lock.open("rb") as file:
            told = json.loads(file.read(_MOST_BYTES))
        own = "" if told["machine"] == socket.gethostname() else f" on {told['machine']!s:.60}"
        return f"process {int(told['process'])}{own} ({told['command']!s:.120}, since {told['started']!s:.40})"
    except (OSError, ValueError, KeyError, TypeError):
        # Just taken, or just given back.
        return "another process"
