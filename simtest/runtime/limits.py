"""Limits of inputs, in one place: beyond them an input is refused before time or memory is spent on it.

The environment variable SIMTEST_LIMITS replaces limits by name: ``SIMTEST_LIMITS="picture_pixels=1e8,mesh_faces=1e7"``.
The ranges of single values (a width, an exponent) stand in the schemas and are fixed.
"""

import os
import stat
from functools import lru_cache
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.resources import kind_of, leads_nowhere, shown, suggestion

VARIABLE = "SIMTEST_LIMITS"

DEFAULTS = {
    # files, bytes
    "text_bytes": 1_000_000,  # TOML, YAML, XML, JSON
    "record_bytes": 20_000_000,  # JSON that a run has written
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
    """Raise `InputError` where a value exceeds a limit.

    Parameters
    ----------
    name : str
        Of the limit.
    value : float
        To be compared.
    where : object
        File, key or option, for the message.
    unit : str
        What is counted.
    hint : str
        What can be done instead.
    """
    most = limit(name)
    if value > most:
        raise InputError(
            f"{shown(where)}: {_number(value)} {unit}; at most {_number(most)} are allowed"
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


def check_file(path: Path, name: str | None, wanted: str, hint: str = "") -> int:
    """Check that a path is a plain file within a limit, without opening it, and return its size in bytes.

    Parameters
    ----------
    path : Path
        To be read next. A pipe or a device has no size and might never end.
    name : str or None
        Of the limit, bytes, if there is one.
    wanted : str
        What the file should be, for messages, such as "a picture".
    hint : str
        What can be done with a file that is too large.

    Raises
    ------
    InputError
        If there is no such file, it is a folder, a pipe or a device, or it is larger.
    """
    where = shown(path)
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InputError(f"{where}: no such file{leads_nowhere(path)}; must be {wanted}") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{where}: cannot be read ({reason})") from error
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{where}: is {kind_of(path)}; must be {wanted}")
    if name is not None:
        check_limit(name, found.st_size, path, "bytes", hint)
    return found.st_size


@lru_cache(maxsize=4)
def _limits(text: str) -> dict[str, int]:
    """Return all limits, those that a text replaces among them."""
    found = dict(DEFAULTS)
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = (piece.strip() for piece in part.partition("="))
        if name not in DEFAULTS:
            raise InputError(
                f"{VARIABLE}: {shown(name)}: unknown limit; allowed: {', '.join(DEFAULTS)}{suggestion(name, DEFAULTS)}"
            )
        try:
            number = float(value)
        except ValueError:
            number = 0.0
        if not 1 <= number < 2**63:
            raise InputError(f"{VARIABLE}: {name} = {shown(value)}: must be a number from 1 on")
        found[name] = int(number)
    return found


def _number(value: float) -> str:
    """Return a number in digits, or with an exponent where it is beyond counting."""
    return f"{value:.0f}" if value < 1e15 else f"{value:.3g}"
