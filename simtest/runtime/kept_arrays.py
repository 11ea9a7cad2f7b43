"""Arrays that took long to make, kept in the user's cache folder for later processes.

What is kept is found by a hash of all that it depends on: the caller's key, the sources of the modules that make it,
the versions of the libraries, and the processor, whose vector units may round otherwise. So a file is never out of
date, only unused; the folder is bounded, and the files used longest ago go first. A file that cannot be read is made
anew, and a folder that cannot be written costs only time.
"""

import contextlib
import importlib.metadata
import os
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Container, Iterator, Mapping
from contextvars import ContextVar
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.runtime import provenance
from simtest.runtime.files import write_atomically
from simtest.runtime.user_cache import user_cache

FOLDER_VARIABLE = "SIMTEST_CACHE"
"""Environment variable: the folder in which arrays are kept, or "off"."""

OFF = "off"

MAX_BYTES = 1_000_000_000
"""Of all files together."""

ABANDONED_S = 3600.0
"""A half-written file of this age belongs to a process that was ended."""

SOURCES = ("surfaces", "geometry", "spec", "runtime/seeds.py")
"""Below simtest/: what the arrays are made by."""

LIBRARIES = ("numpy", "scipy", "scikit-image")

_unkept: ContextVar[Container[str]] = ContextVar("unkept", default=())
"""Kinds of arrays that are read but not kept."""


class _All:
    """Holds every kind."""

    def __contains__(self, kind: object) -> bool:
        return True


Arrays = Mapping[str, npt.NDArray[Any]]

_ROOT = Path(__file__).resolve().parents[1]


def kept(kind: str, key: str, make: Callable[[], Arrays]) -> Arrays:
    """Return arrays by name that were kept under a key, or else make and keep them.

    Parameters
    ----------
    kind : str
        Beginning of the file's name.
    key : str
        All that the arrays depend on besides the code: recipe, settings, seed.
    make : Callable
        Makes the arrays. If it warns they are not kept, so that it warns each time.
    """
    folder = cache_folder()
    if folder is None:
        return make()
    digest = blake2b(f"{_code()} {kind} {key}".encode(), digest_size=16).hexdigest()
    path = folder / f"{kind}-{digest}.npz"
    found = _read(path)
    if found is not None:
        return found
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        arrays = make()
    for warning in caught:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if not caught and kind not in _unkept.get():
        _write(path, arrays)
    return arrays


@contextlib.contextmanager
def only_reading(*kinds: str) -> Iterator[None]:
    """Within it nothing more of some kinds is kept, by default of all: for what is made once and never again.

    Such are a dataset's anatomies, and reliefs that are drawn for one frame.
    """
    before = _unkept.set(kinds or _All())
    try:
        yield
    finally:
        _unkept.reset(before)


def cache_folder() -> Path | None:
    """Return the folder of kept arrays; None where the user wants none."""
    chosen = os.environ.get(FOLDER_VARIABLE, "")
    if chosen.lower() == OFF:
        return None
    if chosen:
        return Path(chosen).expanduser()
    kept = user_cache()
    return None if kept is None else kept / "arrays"


@cache
def _code() -> str:
    """Return a hash of what makes the arrays: sources, libraries, processor."""
    digest = blake2b(digest_size=16)
    for source in SOURCES:
        path = _ROOT / source
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(str(file.relative_to(_ROOT)).encode())
            digest.update(file.read_bytes())
    versions = [importlib.metadata.version(name) for name in LIBRARIES]
    digest.update(repr((versions, provenance.processor())).encode())
    return digest.hexdigest()


def _read(path: Path) -> Arrays | None:
    """Return the arrays of a file, or None if it is missing or damaged: the archive holds a checksum of each."""
    try:
        # Opened here: NumPy leaves a damaged file open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        # The time of change is that of the last use.
        os.utime(path)
    except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error, NotImplementedError):
        return None
    return arrays


def _write(path: Path, arrays: Arrays) -> None:
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, lambda part: np.savez(part, **arrays))  # type: ignore[arg-type]
        _prune(path.parent)


def _prune(folder: Path) -> None:
    """Remove the files used longest ago beyond `MAX_BYTES`, and what ended processes left half-written."""
    states = []
    for path in folder.glob("*.npz"):
        # Another process may remove it meanwhile.
        with contextlib.suppress(OSError):
            states.append((path.stat().st_mtime, path.stat().st_size, path))
    total = 0
    for changed, size, path in sorted(states, reverse=True):
        half_written = path.name.startswith(".")
        total += size
        if total > MAX_BYTES if not half_written else time.time() - changed > ABANDONED_S:
            path.unlink(missing_ok=True)
