"""Shipped scenes, experiments and mesh recipes found by name, in a checkout or an installed wheel."""

from pathlib import Path

from simtest.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]


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
    if path.is_dir():
        raise InputError(f"{shown(name)}: is a folder; a file is needed")
    names = ", ".join(sorted({p.stem for s in suffixes for p in root.glob(f"*{s}")}))
    raise InputError(f"{shown(name)}: no such file; shipped by name: {names}")
