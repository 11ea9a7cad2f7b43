"""Finds the shipped scenes, experiments and mesh recipes by name, from a checkout or from an installed wheel."""

from pathlib import Path

from simtest.errors import InputError

_PACKAGE = Path(__file__).resolve().parents[1]


def data_root(kind: str) -> Path:
    """Give the folder of the shipped data.

    Parameters
    ----------
    kind : {"scenes", "meshes"}
        Top-level folder of the checkout; inside a wheel it lies under ``simtest/_data``.

    Returns
    -------
    pathlib.Path
    """
    installed = _PACKAGE / "_data" / kind
    return installed if installed.is_dir() else _PACKAGE.parent / kind


def shown(text: object, limit: int = 300) -> str:
    """Give a user's text as it stands in a message: on one line, and not longer than `limit`."""
    line = str(text)
    if not line or not line.isprintable():
        line = repr(line)
    return line if len(line) <= limit else line[: limit - 3] + "..."


def find(name: str | Path, kind: str, folder: str = "", suffixes: tuple[str, ...] = (".toml",)) -> Path:
    """Find a file by path or by the name of a shipped one.

    Parameters
    ----------
    name : str or Path
        A path to a file, or the stem of a shipped file.
    kind, folder : str
        Where shipped files lie: ``data_root(kind) / folder``.
    suffixes : tuple of str
        Suffixes tried for a bare name.

    Returns
    -------
    pathlib.Path

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
    root = data_root(kind) / folder
    if path.name == str(name):
        for suffix in suffixes:
            if (shipped := root / f"{path.name}{suffix}").is_file():
                return shipped
    if path.is_dir():
        raise InputError(f"{shown(name)}: is a folder; a file is needed")
    names = ", ".join(sorted({p.stem for s in suffixes for p in root.glob(f"*{s}")}))
    raise InputError(f"{shown(name)}: no such file; shipped by name: {names}")
