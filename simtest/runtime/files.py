"""Files: written atomically, so that a reader never meets half of one, and refused beyond limits before they are read.

The environment variable SIMTEST_LIMITS replaces limits by name: ``SIMTEST_LIMITS="picture_pixels=1e8,mesh_faces=1e7"``.
The ranges of single values (a width, an exponent) stand in the schemas and are fixed.
"""

import contextlib
import errno
import io
import json
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.errors import InputError
from simtest.runtime.boundary import shown, suggestion
from simtest.runtime.messages import LOGGER

if TYPE_CHECKING:
    import polars as pl

Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]
"""What a JSON file can hold."""
JsonObject = dict[str, Any]
"""An object as it stands in a JSON file: what records become when they are written, and are made of when read."""


def as_path(value: object, name: str = "path") -> Path:
    """Return a path that a caller from Python gave under a name; raise `InputError` for what is none."""
    if not isinstance(value, str | os.PathLike) or "\0" in str(value):
        raise InputError(f"{name} = {shown(value)}: must be a path")
    return Path(value)


def refuse_file(folder: Path, option: str = "--out") -> None:
    """Raise `InputError` if the path of a results folder is a file, or a link that leads nowhere.

    `option` is how the user names it.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{option} {folder}: is a file; must be a folder")
    if not folder.exists() and folder.is_symlink():
        raise InputError(f"{option} {folder}: is a link to {os.readlink(folder)}, which does not exist; make it first")


def make_folder(folder: Path, option: str = "--out") -> None:
    """Make a folder for results; raise `InputError` if a file is in its place."""
    refuse_file(folder, option)
    folder.mkdir(parents=True, exist_ok=True)


def are_nested(one: Path, other: Path) -> bool:
    """Return whether two folders, which need not exist, are the same one, or one lies inside the other."""
    first, second = one.resolve(), other.resolve()
    return first == second or first in second.parents or second in first.parents


def require_plain(path: Path, limited_by: str | None = None, wanted: str = "a file", hint: str = "") -> Path:
    """Return a path that is a plain file within a limit of its bytes, unopened: a pipe or a device might never end.

    Raises `InputError` otherwise; its message says what the file should be (`wanted`), and what can be done with one
    that is too large (`hint`).
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; must be {wanted}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{path}: cannot be read ({reason})") from error
    if stat.S_ISDIR(found.st_mode):
        raise InputError(f"{path}: is a folder; must be {wanted}")
    if not stat.S_ISREG(found.st_mode):
        # What a shell's pipe hands on as /dev/stdin has no size and can be read but once.
        told = "is no plain file but a pipe or a device (write it to a file first)"
        raise InputError(f"{path}: {told}; must be {wanted}")
    if limited_by is not None:
        check_limit(limited_by, found.st_size, path, "bytes", hint)
    return path


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Write a file under a temporary name, flush it to disk, then rename it.

    `write` is called with the temporary path, which has the final file's suffix. An `OSError` names the final file,
    also where the system's own names none (a full disk).
    """
    if not path.name:
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        write(part)
        # The content must be on disk before the rename is, or a loss of power leaves an empty file.
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
        LOGGER.debug("wrote %s", path)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(part)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


@contextlib.contextmanager
def written_together(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder for files that belong together; at the end they take the place of these names in `folder`.

    What an earlier result left under the names goes before the first new file comes: at no moment do old and new files
    stand side by side. A full disk leaves the earlier files; a kill leaves these, or new ones alone, of which those
    that come last in `names` may lack. An `OSError` names the final file.
    """
    new = folder / f".{Path(names[-1]).name}.new"
    shutil.rmtree(new, ignore_errors=True)
    try:
        new.mkdir()
        yield new
        for name in names:
            (folder / name).unlink(missing_ok=True)
        for name in filter(lambda name: (new / name).exists(), names):
            os.replace(new / name, folder / name)
        sync_folder(folder)
    except OSError as error:
        if error.filename is not None and (path := Path(os.fsdecode(error.filename))).is_relative_to(new):
            error.filename = str(folder / path.relative_to(new))
        raise
    finally:
        shutil.rmtree(new, ignore_errors=True)


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


def write_parquet(path: Path, table: "pl.DataFrame", **how: Any) -> None:
    """Write a table atomically: made in memory, since polars hands on an error of the disk without number or file."""
    made = io.BytesIO()
    table.write_parquet(made, **how)
    write_atomically(path, lambda part: part.write_bytes(made.getbuffer()))


def read_json(path: Path, wanted: str = "a JSON file") -> Any:
    """Read what a run has written as JSON; raise `InputError` where it is missing, too large or damaged."""
    require_plain(path, "record_bytes", wanted)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: damaged (not JSON: {error!s:.80})") from None


def as_json(value: Any) -> Any:
    """Return what JSON holds of an array or a record."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return value.to_json() if hasattr(value, "to_json") else vars(value)


VARIABLE = "SIMTEST_LIMITS"

DEFAULTS = {
    # files, bytes
    "text_bytes": 1_000_000,  # TOML, YAML, XML, JSON
    "record_bytes": 20_000_000,  # JSON that a run has written
    "manifest_bytes": 100_000_000,  # of a dataset or an export
    "picture_bytes": 250_000_000,
    "mesh_bytes": 1_500_000_000,  # five million faces: an STL of text takes about 250 bytes a face, others less
    # pictures and frames, px
    "picture_pixels": 50_000_000,  # 8K has 33 million; a picture that is read takes 26 bytes a pixel and more
    "picture_side": 16_384,
    "frame_pixels": 20_000_000,
    "frame_samples": 4_000_000_000,  # rays of one rendered frame: pixels times samples
    # meshes
    "mesh_faces": 5_000_000,
}


def limit(name: str) -> int:
    """Return a limit by name, as SIMTEST_LIMITS replaces it or the default; raise `InputError` if that is malformed."""
    return _limits(os.environ.get(VARIABLE, ""))[name]


def check_limit(name: str, value: float, where: object, unit: str, hint: str = "") -> None:
    """Raise `InputError` where a value exceeds a limit; `where` is the file, key or option."""
    most = limit(name)
    if value > most:
        raise InputError(
            f"{where}: {_number(value)} {unit}; at most {_number(most)} are allowed"
            f"{hint and f': {hint}'} ({VARIABLE}={name}=N sets another limit)"
        )


def check_count(value: object, where: str, most: int) -> None:
    """Raise `InputError` unless a value is a whole number from 1 to the largest one; `where` names its key."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        joined = f"{where} {value!r}" if where.startswith("--") else f"{where} = {value!r}"
        raise InputError(f"{joined}: must be 1 to {most}")


def check_picture_size(path: Path, width: int, height: int) -> None:
    """Raise `InputError` where a picture has more pixels, or a longer side, than allowed."""
    check_limit("picture_side", max(width, height), f"{path}: {width} x {height} px", "px along a side")
    check_limit("picture_pixels", width * height, f"{path}: {width} x {height} px", "px")


@lru_cache(maxsize=4)
def _limits(text: str) -> dict[str, int]:
    """Return all limits, those that a text replaces among them."""
    found = dict(DEFAULTS)
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = (piece.strip() for piece in part.partition("="))
        if name not in DEFAULTS:
            raise InputError(
                f"{VARIABLE}: {name}: unknown limit; allowed: {', '.join(DEFAULTS)}{suggestion(name, DEFAULTS)}"
            )
        try:
            number = float(value)
        except ValueError:
            number = 0.0
        if not 1 <= number < 2**63:
            raise InputError(f"{VARIABLE}: {name} = {value or repr(value)}: must be a number from 1 on")
        found[name] = int(number)
    return found


def _number(value: float) -> str:
    """Return a number in digits, or with an exponent where it is beyond counting."""
    return f"{value:.0f}" if value < 1e15 else f"{value:.3g}"


def user_cache() -> Path | None:
    """Return the user's cache folder of this package; None for a user without a home, as in some containers."""
    import platformdirs

    try:
        return Path(platformdirs.user_cache_dir("simtest"))
    except RuntimeError:
        return None
