"""Arrays: their types, short texts of records with arrays, .npz files, and arrays kept in the user's cache folder.

The types say what an array holds; shapes and units stand where it is used.

Arrays that took long to make are kept for later processes. They are found by a hash of all that they depend on: the
caller's key, the sources of the modules that make them, the versions of the libraries, and the processor, whose vector
units may round otherwise. So a file is never out of date, only unused; the folder is bounded, and the files used
longest ago go first. A file that cannot be read is made anew, and a folder that cannot be written costs only time.
"""

import contextlib
import importlib.metadata
import io
import os
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextvars import ContextVar
from dataclasses import fields, is_dataclass
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.runtime import provenance
from simtest.runtime.files import user_cache, write_atomically

Array = npt.NDArray[np.float64]
"""Geometry: points, normals, curvatures, conics."""

Image = npt.NDArray[np.float32]
"""Radiance, frames and label images."""

Picture = npt.NDArray[np.uint8]
"""Encoded pixels, 8 bits a channel."""

Mask = npt.NDArray[np.bool_]

Index = npt.NDArray[np.intp]
"""Positions in other arrays, as NumPy returns them."""

IntArray = npt.NDArray[np.int64]
"""Indices, faces, counts."""

AnyArray = npt.NDArray[Any]
"""Arrays of several dtypes, as in a sample of a dataset."""


LONGEST = 280
"""Characters of a text, with the name of the type."""

LONGEST_PART = 60
"""Characters of one field's text."""

FEW = 3
"""Arrays and sequences of no more elements are shown; of longer ones, their size."""


def short_repr(self: object) -> str:
    """Return the type's name with its fields, arrays and nested records shortened; a `__repr__` for records.

    Fields that are None are left out. The text has at most `LONGEST` characters.
    """
    name, parts, used = type(self).__name__, [], 0
    for field, value in _fields(self):
        if value is None:
            continue
        part = f"{field}={clipped(short(value), LONGEST_PART)}"
        used += len(part) + 2
        if len(name) + used > LONGEST - 7:
            parts.append("...")
            break
        parts.append(part)
    return f"{name}({', '.join(parts)})"


def short(value: object) -> str:
    """Return a value as short text: small arrays and sequences by their elements, others by their size."""
    if isinstance(value, np.ndarray):
        if value.ndim <= 1 and value.size <= FEW:
            return vector(value)
        return f"<{' x '.join(map(str, value.shape))} {value.dtype}>"
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return f"{float(value):.4g}"
    if isinstance(value, str):
        return repr(str(value))
    if isinstance(value, Mapping):
        return f"{{{', '.join(map(str, value))}}}"
    if isinstance(value, list | tuple):
        if len(value) <= FEW or (isinstance(value, tuple) and all(isinstance(each, str) for each in value)):
            return f"({', '.join(map(short, value))})"
        return f"<{len(value)} items>"
    if is_dataclass(value) or hasattr(value, "model_fields_set"):
        return f"<{type(value).__name__}>"
    return repr(value)


def vector(values: Any, digits: int = 4) -> str:
    """Return a few numbers in brackets."""
    return f"({', '.join(f'{float(v):.{digits}g}' for v in np.atleast_1d(values))})"


def _fields(value: object) -> Iterator[tuple[str, object]]:
    """Yield the names and values of a data class's or a model's public fields."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.repr]
    else:
        names = list(type(value).model_fields)  # type: ignore[attr-defined]
    for name in names:
        if not name.startswith("_"):
            yield name, getattr(value, name)


def clipped(text: str, length: int) -> str:
    """Return a text, or its beginning with dots where it is longer than `length`."""
    return text if len(text) <= length else text[: length - 3] + "..."


WORTHWHILE = 0.75
"""Arrays whose sample shrinks to less than this share are compressed. Maps of floats shrink to 0.9, for 4 s a frame."""

SAMPLES, SAMPLE_BYTES = 32, 8192
"""Pieces of an array that are tried, evenly spaced, and their size."""

LEVEL = 1
"""Of zlib: higher ones take longer and gain less than one per cent."""


def write_arrays(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Write arrays by name to an .npz file; the same arrays give the same bytes."""
    with zipfile.ZipFile(path, "w") as file:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asanyarray(array), allow_pickle=False)
            data = content.getbuffer()
            # Without a date, which would differ from run to run.
            entry = zipfile.ZipInfo(f"{name}.npy")
            kind = zipfile.ZIP_DEFLATED if _shrinks(data) else zipfile.ZIP_STORED
            file.writestr(entry, data, kind, LEVEL)


def _shrinks(data: memoryview) -> bool:
    """Return whether a file's content is worth its compression."""
    step = max(len(data) // SAMPLES, SAMPLE_BYTES)
    pieces = [data[start : start + SAMPLE_BYTES] for start in range(0, len(data), step)]
    shrunk = sum(len(zlib.compress(piece, LEVEL)) for piece in pieces)
    return shrunk < WORTHWHILE * sum(map(len, pieces))


FOLDER_VARIABLE = "SIMTEST_CACHE"
"""Environment variable: the folder in which arrays are kept, or "off"."""

MAX_BYTES = 1_000_000_000
"""Of all files together."""

ABANDONED_S = 3600.0
"""A half-written file of this age belongs to a process that was ended."""

SOURCES = ("surfaces", "geometry", "spec", "runtime/seeds.py", "fitted.toml")
"""Below simtest/: what the arrays are made by."""

LIBRARIES = ("numpy", "scipy", "scikit-image")

_unkept: ContextVar[tuple[str, ...]] = ContextVar("unkept", default=())
"""How the kinds begin of which nothing is kept."""

Arrays = Mapping[str, npt.NDArray[Any]]

_ROOT = Path(__file__).resolve().parents[1]


def kept(kind: str, key: str, make: Callable[[], Arrays]) -> Arrays:
    """Return arrays by name that were kept under a kind and key, or else make and keep them.

    The key holds all that the arrays depend on besides the code: recipe, settings, seed. Where `make` warns they are
    not kept, so that it warns each time.
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
    if not caught and not kind.startswith(_unkept.get()):
        _write(path, arrays)
    return arrays


@contextlib.contextmanager
def only_reading(*kinds: str) -> Iterator[None]:
    """Keep nothing more of some kinds, by default of all: for what is made once and never again."""
    before = _unkept.set(kinds or ("",))
    try:
        yield
    finally:
        _unkept.reset(before)


def cache_folder() -> Path | None:
    """Return the folder of kept arrays; None where the user wants none."""
    chosen = os.environ.get(FOLDER_VARIABLE, "")
    if chosen.lower() == "off":
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
    except Exception:
        # What cannot be read is made anew, whatever is wrong with it.
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
