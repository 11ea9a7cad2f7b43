"""Shipped scenes, experiments and mesh recipes found by name, in a checkout or an installed wheel."""

import os
import stat
from collections.abc import Iterable
from pathlib import Path

from simtest.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]

_ALIKE = 0.6
"""Of two names that are taken for one mistyped: twice the letters in common over those of both."""

_LONGEST_NAME = 80
"""Of what may be a mistyped name; comparing takes time with its square."""


def data_root(kind: str) -> Path:
    """Return the folder of the shipped data.

    Parameters
    ----------
    kind : {"scenes", "meshes"}
        Top-level folder of the checkout; inside a wheel it lies under ``simtest/_data``.
    """
    installed = _PACKAGE / "_data" / kind
    return installed if installed.is_dir() else _PACKAGE.parent / kind


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


def find(name: str | Path, kind: str, folder: str = "", suffixes: tuple[str, ...] = (".toml",)) -> Path:
    """Find a file by its path, or a shipped one by its name.

    Parameters
    ----------
    name : str or Path
        A path to a file, or the stem of a shipped file.
    kind, folder : str
        Shipped files lie in ``data_root(kind) / folder``.
    suffixes : tuple of str
        Suffixes tried for a bare name.

    Raises
    ------
    InputError
        If there is no such file; the message lists the names that exist.
    """
    try:
        path = Path(name).expanduser()
        if path.is_file():
            return path
    except OSError as error:
        raise InputError(f"{shown(name)}: cannot be read ({error.strerror})") from error
    except RuntimeError as error:
        raise InputError(f"{shown(name)}: no such home folder") from error
    # a shipped file, by its bare name
    root = data_root(kind) / folder
    if path.name == str(name):
        for suffix in suffixes:
            if (shipped := root / f"{path.name}{suffix}").is_file():
                return shipped
    if path.exists():
        raise InputError(f"{shown(name)}: is {kind_of(path)}; must be a file")
    names = sorted({p.stem for s in suffixes for p in root.glob(f"*{s}")})
    meant = suggestion(path.name, names)
    raise InputError(f"{shown(name)}: no such file{leads_nowhere(path)}; shipped by name: {', '.join(names)}{meant}")
