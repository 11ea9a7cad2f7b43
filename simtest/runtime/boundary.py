"""What a user is told of an error: one line, said in one place; and the names that a wrong one may mean.

Readers and writers raise what they run into. The command line, and the public functions under `plain_errors`, turn it
into a `SimtestError` of one line; what is a fault of the program stays what it is.
"""

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

from simtest.errors import InputError, SimtestError

P = ParamSpec("P")
R = TypeVar("R")

_ALIKE = 0.6
"""Of two names that are taken for one mistyped: twice the letters in common over those of both."""

_LONGEST_NAME = 80
"""Of what may be a mistyped name; comparing takes time with its square."""

_OF_THE_DISK = {
    errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM, errno.ENOTDIR,
    errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ENOENT, errno.ELOOP, errno.ENOTEMPTY, errno.EMFILE,
    errno.ENFILE, errno.EBUSY, errno.ESTALE, errno.EINVAL, errno.ENXIO,
}  # fmt: skip
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""The disk is full, or fails: no other folder or file is asked for."""

_OS_ERROR = re.compile(r"\(os error (\d+)\)")
"""How libraries written in Rust (polars) hand an error of the system on."""


def shown(value: object) -> str:
    """Return a value as a message shows it: on one line, 80 characters at most."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:
        # Python refuses to write integers of more than 4300 digits.
        text = "a number of too many digits"
    return text if len(text) <= 80 else text[:77] + "..."


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


def explain(error: BaseException, near: Path | None = None) -> str | None:
    """Return what a user is told of an error; None for one that is a fault of the program.

    An error of the disk names its file, what is wrong and, of a full one, what is free; `near` is named by one that
    knows no file.
    """
    if isinstance(error, SimtestError):
        return str(error)
    if isinstance(error, MemoryError):
        lacks = " ".join(str(error).split())
        return f"not enough memory{f' ({lacks:.150})' if lacks else ''}; smaller frames or fewer workers need less"
    if isinstance(error, RecursionError):
        return "a value is nested too deeply"
    number = _number(error)
    if number not in _OF_THE_DISK:
        return None
    name = getattr(error, "filename", None) or near
    file = f"{name}: " if name else ""
    what = getattr(error, "strerror", None) or " ".join(str(error).split())[:200]
    if name and number in (errno.ENOSPC, errno.EDQUOT):
        return f"{file}{what}; {_free(name)}"
    if number == errno.EFBIG:
        return f"{file}{what}; the system limits the size of a file (ulimit -f)"
    return f"{file}{what}"


def plain(error: BaseException, kept: str = "", near: Path | None = None) -> BaseException:
    """Return the error that a user gets in place of one; a fault of the program stays what it is.

    It is an `InputError` where another file or folder would do, and a plain `SimtestError` where the machine lacks
    something. `kept` says what stays of the work, and `near` is a path of an error that knows no file.
    """
    told = explain(error, near)
    if told is None or isinstance(error, SimtestError):
        return error
    kind = InputError if isinstance(error, OSError) and error.errno not in _FULL else SimtestError
    return kind(f"{told}; {kept}" if kept else told)


def plain_errors(function: Callable[P, R]) -> Callable[P, R]:
    """Let a public function raise a `SimtestError` of one line for every error that is no fault of the program."""

    @wraps(function)
    def call(*arguments: P.args, **named: P.kwargs) -> R:
        try:
            return function(*arguments, **named)
        except Exception as error:
            told = plain(error)
            if told is error:
                raise
            raise told from error

    return call


def _number(error: BaseException) -> int | None:
    """Return the number that the system gave to an error."""
    number = error.errno if isinstance(error, OSError) else None
    if number is None and (found := _OS_ERROR.search(str(error))):
        number = int(found[1])
    return number


def _free(name: str | Path) -> str:
    """Return how much of a file's disk is free."""
    path = Path(os.fsdecode(name)).absolute()
    for folder in (path, *path.parents):
        try:
            usage = shutil.disk_usage(folder)
        except OSError:
            continue
        return f"{_mb(usage.free)} of {_mb(usage.total)} MB are free on the disk of {folder}"
    return "the disk is full"


def _mb(size: float) -> str:
    return f"{size / 1e6:.0f}" if size >= 1e7 else f"{size / 1e6:.2g}"
