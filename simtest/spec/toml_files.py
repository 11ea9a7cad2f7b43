"""TOML in and out: files, `--set key=value`, values at key paths, and tables that read back the same."""

import copy
import itertools
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime.boundary import shown
from simtest.runtime.files import require_plain

MAX_DEPTH = 32
"""Tables and lists within each other, and parts of a key path; the deepest key of a scene has 6."""


_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_DEEP_KEY = re.compile(rf"(?:^|[\[{{,])[ \t]*{_PART}(?:[ \t]*\.[ \t]*{_PART}){{{MAX_DEPTH}}}", re.MULTILINE)
"""A dotted key of more parts than `MAX_DEPTH`: the parser's memory grows with the square of their number."""


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raise `InputError` if it is missing, too large, not UTF-8 or not TOML."""
    try:
        return _loads(read_text(path, "TOML"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error


def read_text(path: Path, kind: str, limit: str = "text_bytes") -> str:
    """Read a text file of moderate size; `kind` is what it should be, for messages, such as "TOML".

    `limit` names the limit of its size.
    """
    name = str(path)
    require_plain(path, limit, f"a {kind} file")
    try:
        # Editors on Windows begin a file with a mark of its encoding.
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: not a text file in UTF-8 (byte {error.start})") from error


def _loads(text: str) -> dict[str, Any]:
    """Parse TOML; limits (nesting, digits) raise `TOMLDecodeError` too."""
    if _DEEP_KEY.search(text):
        raise tomllib.TOMLDecodeError(f"nested too deeply; at most {MAX_DEPTH} levels are allowed")
    try:
        parsed = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply") from None
    except ValueError:
        # Python refuses to read integers of more than 4300 digits.
        raise tomllib.TOMLDecodeError("a number has too many digits") from None
    # Tables deeper than Python's own stack cannot be copied, shown or validated.
    level: list[Any] = [parsed]
    for _ in range(MAX_DEPTH):
        inner = [value for item in level for value in (item.values() if isinstance(item, dict) else item)]
        level = [value for value in inner if isinstance(value, dict | list)]
        if not level:
            return parsed
    raise tomllib.TOMLDecodeError(f"nested too deeply; at most {MAX_DEPTH} levels are allowed")


# Settings by key path ------------------------------------------------------------------------------------------------


def parse_settings(settings: list[str]) -> dict[str, Any]:
    """Parse the `key=value` pairs of a command line, such as "surface.radius_mm=10", to values by key path.

    A value is TOML, or else plain text. Raises `InputError` for a pair without ``=`` or with an empty key.
    """
    parsed = {}
    for setting in settings:
        path, equals, value = setting.partition("=")
        if not equals or not path.strip():
            raise InputError(f"--set {setting}: must be key=value, for example surface.distance_mm=12")
        try:
            table = _loads(f"value = {value}")
        except tomllib.TOMLDecodeError:
            table = {}
        # More than one key means that the value held a line break, so it is text.
        parsed[path.strip()] = table["value"] if list(table) == ["value"] else value
    return parsed


def as_settings(settings: object) -> dict[str, Any]:
    """Return values by key path that a caller from Python gave; raise `InputError` where they are no such table."""
    if settings is None:
        return {}
    if not isinstance(settings, Mapping) or not all(isinstance(key, str) for key in settings):
        raise InputError(f"settings = {shown(settings)}: must be values by key path")
    return dict(settings)


def apply_settings(data: Mapping[str, Any], settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a copy of nested tables with values replaced at key paths such as ``rig.lights.0.position_mm``.

    Raises
    ------
    InputError
        If a path leads through something that is no table or beyond the end of a list; `where` names the file.
    """
    where = str(where)
    result = copy.deepcopy(dict(data))
    for path, value in settings.items():
        parts = path.split(".")
        if len(parts) > MAX_DEPTH:
            raise InputError(f"{where}: {path}: {len(parts)} parts; a key path has {MAX_DEPTH} at most")
        last, parents = parts[-1], parts[:-1]
        node: Any = result
        # Down to the table or list that holds the value ...
        for part, following in itertools.pairwise(parts):
            node = _step(node, part, following, path, where)
        # ... which is replaced there; in a list only an item that exists.
        if isinstance(node, list):
            _step(node, last, "", path, where)
            node[int(last)] = value
        elif isinstance(node, dict):
            node[last] = value
        else:
            raise InputError(f"{where}: {path}: {'.'.join(parents)} is a plain value, not a table")
    return result


def _step(node: Any, part: str, following: str, path: str, where: str) -> Any:
    """Descend one part of a key path; create what is missing, a list if the following part is its first index."""
    if isinstance(node, dict):
        if part not in node and following.isdecimal() and following != "0":
            raise InputError(f"{where}: {path}: index {following} is not allowed; the first item is 0")
        return node.setdefault(part, [{}] if following == "0" else {})
    if isinstance(node, list):
        if part.isdecimal() and len(part) < 10 and int(part) < len(node):
            return node[int(part)]
        held = f"items 0 to {len(node) - 1}" if node else "no items"
        raise InputError(f"{where}: {path}: index {part} is not allowed; the list has {held}")
    raise InputError(f"{where}: {path}: {part} is below a plain value, not a table")


def source_name(path: Path, settings: Mapping[str, Any] | None) -> str:
    """Return a file's name for messages, which mentions whether some of its values are replaced."""
    return f"{path} with replaced values" if settings else str(path)


# Writing -------------------------------------------------------------------------------------------------------------


def toml_value(value: Any) -> str:
    """Return a value as TOML: text quoted, tables and lists inline."""
    if isinstance(value, Mapping):
        # TOML has no null: what is None is left out.
        given = {key: item for key, item in value.items() if item is not None}
        return "{" + ", ".join(f"{key} = {toml_value(item)}" for key, item in given.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    if isinstance(value, str):
        # A JSON string is a TOML basic string, but for surrogates and the one control character that JSON lets stand.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower() if isinstance(value, bool) else str(value)


def toml_tables(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Return tables by name as the text of a TOML file, one line per key."""
    parts = []
    for name, table in tables.items():
        lines = [f"{key} = {toml_value(value)}\n" for key, value in table.items() if value is not None]
        parts.append(f"[{name}]\n{''.join(lines)}")
    return "\n".join(parts)
