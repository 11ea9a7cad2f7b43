"""What is said of errors: a user's text on one line, near names, and what disk and memory lack."""

import errno
import os
import re
import shutil
import stat
from collections.abc import Iterable
from pathlib import Path

from simtest.errors import InputError, SimtestError

_ALIKE = 0.6
"""Of two names that are taken for one mistyped: twice the letters in common over those of both."""

_LONGEST_NAME = 80
"""Of what may be a mistyped name; comparing takes time with its square."""


def shown(text: object, limit: int = 300) -> str:
    """Return a user's text fit for a message: on one line, of at most `limit` characters."""
    # A line break in a user's text would make two lines of the message.
    line = str(text)
    if not line or not line.isprintable():
        line = repr(line)
    return line if len(line) <= limit else line[: limit - 3] + "..."


def kind_of(path: Path) -> str:
    """Return what a path that is no plain file is, in words."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        return "a folder"
    # What a shell's pipe hands on as /dev/stdin has no size and can be read but once.
    pipe = stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)
    return "no plain file but a pipe (write it to a file first)" if pipe else "no plain file but a device"


def leads_nowhere(path: Path) -> str:
    """Return where a link leads that leads nowhere, for a message; nothing for what is no link."""
    try:
        return f" (a link to {shown(os.readlink(path))}, which does not exist)" if path.is_symlink() else ""
    except OSError:
        return ""


def close_names(name: object, known: Iterable[str], count: int = 1, alike: float = _ALIKE) -> list[str]:
    """Return at most `count` known names that a wrong one may mean, the closest first; `alike` is from 0 to 1."""
    import difflib  # slow to import

    wrong, names = str(name)[:_LONGEST_NAME], list(known)
    # A name that was cut short, or written without its suffix, is meant more likely than one of like letters.
    begun = [n for n in names if wrong and n.startswith(wrong)]
    return (begun or difflib.get_close_matches(wrong, names, count, alike))[:count]


def suggestion(name: object, known: Iterable[str], count: int = 1) -> str:
    """Return " (did you mean NAME?)", or of several " (did you mean NAME or NAME?)"; nothing where none is close."""
    close = close_names(name, known, count)
    return f" (did you mean {' or '.join(close)}?)" if close else ""


_OF_THE_DISK = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ENOTDIR,
    errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ENOENT, errno.ELOOP, errno.ENOTEMPTY, errno.EMFILE,
    errno.ENFILE, errno.EBUSY, errno.ESTALE, errno.EINVAL, errno.ENXIO,
}  # fmt: skip
_OS_ERROR = re.compile(r"\(os error (\d+)\)")
"""How libraries written in Rust (polars) hand an error of the system on."""


def disk_problem(error: BaseException, near: Path | None = None) -> str | None:
    """Return an error of the disk as text: the file, what is wrong, what is free; None for any other error.

    `near` is a path on the same disk, for errors that name no file.
    """
    number = _number(error)
    if number not in _OF_THE_DISK:
        return None
    name = getattr(error, "filename", None)
    what = getattr(error, "strerror", None) or " ".join(str(error).split())[:200]
    file = f"{shown(name, 200)}: " if name else ""
    if number in (errno.ENOSPC, errno.EDQUOT):
        return f"{file}{what}" + (f"; {_free(path)}" if (path := name or near) is not None else "")
    # A limit of ours (`require_plain`) has the same number, and says so in its text.
    if number == errno.EFBIG and os.strerror(errno.EFBIG) in what:
        return f"{file}{what}; the system limits the size of a file (ulimit -f)"
    return f"{file}{what}"


def write_error(error: OSError, out: str | Path, kept: str = "") -> SimtestError:
    """Return the error, for a user, that came up while `--out` was written; `kept` says what stays of it.

    It is an `InputError` where another folder would do, and a plain `SimtestError` where the disk is full or fails, or
    the error is of a file elsewhere: an input that has gone, or a program that is missing, is no fault of the folder.
    """
    told = disk_problem(error, Path(out)) or error
    if not lies_in(error, out):
        return SimtestError(f"{told}{kept and f'; {kept}'}")
    kind = SimtestError if is_disk_full(error) else InputError
    return kind(f"--out {shown(out)}: cannot be written ({told}){kept and f'; {kept}'}")


def cannot_write(error: OSError, what: str, near: Path) -> SimtestError:
    """Return the error, for a user, that a path cannot be written: a plain one where its disk is full or fails.

    Parameters
    ----------
    error : OSError
        What the system said.
    what : str
        Option and path, as the message names them.
    near : Path
        The path, by which the disk is found.
    """
    full = is_disk_full(error)
    told = disk_problem(error, near) if full else error.strerror
    return (SimtestError if full else InputError)(f"{what}: cannot be written ({told})")


def is_disk_full(error: BaseException) -> bool:
    """Return whether an error says that a disk is full, or fails."""
    return _number(error) in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def lies_in(error: OSError, folder: str | Path) -> bool:
    """Return whether an error is of a file below a folder, or beside an output file, or names no file."""
    name = error.filename
    if not isinstance(name, str | bytes | os.PathLike):
        return True
    path, folder = Path(os.fsdecode(name)), Path(folder)
    # A file is written under another name beside its own.
    folder = folder if folder.is_dir() else folder.parent
    return path.absolute().is_relative_to(folder.absolute()) or path.resolve().is_relative_to(folder.resolve())


def machine_problem(error: BaseException) -> str | None:
    """Return an error of disk, memory or the depth of nesting as text; None for any other, which is a fault of ours."""
    if isinstance(error, MemoryError):
        told = " ".join(str(error).split())
        return f"not enough memory{f' ({shown(told, 150)})' if told else ''}; smaller frames or fewer workers need less"
    if isinstance(error, RecursionError):
        return "a value is nested too deeply"
    return disk_problem(error)


def _number(error: BaseException) -> int | None:
    """Return the number that the system gave to an error."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None and (found := _OS_ERROR.search(str(error))):
        number = int(found[1])
    return number


def _free(name: str | Path) -> str:
    """Return how much of a file's disk is free."""
    path = Path(name).absolute()
    for folder in (path, *path.parents):
        try:
            usage = shutil.disk_usage(folder)
        except OSError:
            continue
        return f"{_mb(usage.free)} of {_mb(usage.total)} MB are free on the disk of {shown(folder, 120)}"
    return "the disk is full"


def _mb(size: float) -> str:
    return f"{size / 1e6:.0f}" if size >= 1e7 else f"{size / 1e6:.2g}"
