"""Reading TOML into models: key paths, `--set key=value`, and errors of one line."""

import copy
import difflib
import itertools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from simtest.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

MAX_TOML_BYTES = 1_000_000


class Spec(BaseModel):
    """Base of all specification models: frozen, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    dict

    Raises
    ------
    InputError
        If the file is missing, too large, not UTF-8 or not TOML.
    """
    try:
        if path.stat().st_size > MAX_TOML_BYTES:
            raise InputError(f"{path}: {path.stat().st_size} bytes; a TOML file of at most {MAX_TOML_BYTES} is allowed")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file in UTF-8 (byte {error.start})") from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error


def parse_settings(settings: list[str]) -> dict[str, Any]:
    """Parse `key=value` pairs of a command line; a value is TOML, or else plain text.

    Parameters
    ----------
    settings : list of str
        Such as ``["surface.radius_mm=10", "surface.path=colon.ply"]``.

    Returns
    -------
    dict
        Value by key path.

    Raises
    ------
    InputError
        If a pair has no ``=`` or an empty key.
    """
    parsed: dict[str, Any] = {}
    for setting in settings:
        path, equals, value = setting.partition("=")
        if not equals or not path.strip():
            raise InputError(f"--set {setting}: must be key=value, for example surface.distance_mm=12")
        try:
            parsed[path.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed[path.strip()] = value
    return parsed


def apply_settings(data: Mapping[str, Any], settings: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a copy of nested data with values replaced at key paths such as ``rig.lights.0.position_mm``.

    Parameters
    ----------
    data : mapping
        Nested tables, as read from TOML.
    settings : mapping
        Value by key path.
    where : str
        Name of the file, for messages.

    Returns
    -------
    dict

    Raises
    ------
    InputError
        If a path leads through something that is no table or beyond the end of a list.
    """
    result: dict[str, Any] = copy.deepcopy(dict(data))
    for path, value in settings.items():
        parts = path.split(".")
        last, parents = parts[-1], parts[:-1]
        node: Any = result
        for part, following in itertools.pairwise(parts):
            node = _step(node, part, following, path, where)
        if isinstance(node, list):
            _step(node, last, "", path, where)
            node[int(last)] = value
        elif isinstance(node, dict):
            node[last] = value
        else:
            raise InputError(f"{where}: {path}: {'.'.join(parents)} is a plain value, not a table")
    return result


def _step(node: Any, part: str, following: str, path: str, where: str) -> Any:
    """Go down one part of a key path; what is missing is made, a list where the following part is its first index."""
    if isinstance(node, dict):
        return node.setdefault(part, [{}] if following == "0" else {})
    if isinstance(node, list):
        if part.isdigit() and int(part) < len(node):
            return node[int(part)]
        raise InputError(f"{where}: {path}: index {part} is not allowed; the list has items 0 to {len(node) - 1}")
    raise InputError(f"{where}: {path}: {part} is below a plain value, not a table")


def validate(model: type[Model], data: Mapping[str, Any], where: str) -> Model:
    """Validate data against a model; an error is one line with file, key path, value and what is allowed.

    Parameters
    ----------
    model : type
        A pydantic model.
    data : mapping
        Nested tables.
    where : str
        Name of the file, for messages.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        If the data do not fit; further errors are counted at the end of the line.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise InputError(f"{where}: {_describe(errors[0], model, data)}{more}") from None


def _describe(error: Any, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    location = [str(part) for part in _without_tags(error["loc"], data)]
    path = ".".join(location) or "(top level)"
    kind, value = error["type"], error.get("input")
    if kind == "extra_forbidden":
        return f"{path} = {_short(value)}: unknown key{_suggest(error['loc'], model)}"
    if kind == "missing":
        return f"{path}: missing; it must be given"
    if kind == "value_error":
        return f"{path} = {_short(value)}: {error['ctx']['error']}" if location else str(error["ctx"]["error"])
    message = error["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return f"{path} = {_short(value)}: must be {message}"


def _without_tags(location: tuple[Any, ...], data: Any) -> list[Any]:
    """Drop the tags that pydantic puts into the location for each tagged union."""
    path: list[Any] = []
    for part in location:
        if isinstance(data, Mapping) and part not in data and part == data.get("type"):
            continue
        path.append(part)
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            data = None
    return path


def _suggest(location: tuple[Any, ...], model: type[BaseModel]) -> str:
    """List the keys that are allowed where an unknown one was found, the closest first."""
    schema = model.model_json_schema()
    node: Any = schema
    for part in location[:-1]:
        node = _descend(node, part, schema)
        if node is None:
            return ""
    known = list(_resolve(node, schema).get("properties", {}))
    close = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
    ordered = close + [k for k in known if k not in close]
    return f"; allowed: {', '.join(ordered)}" if ordered else ""


def _resolve(node: Any, schema: Any) -> Any:
    while isinstance(node, dict) and "$ref" in node:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
    return node if isinstance(node, dict) else {}


def _descend(node: Any, part: Any, schema: Any) -> Any:
    node = _resolve(node, schema)
    if isinstance(part, int):
        return node.get("items")
    if part in node.get("properties", {}):
        return node["properties"][part]
    mapping = node.get("discriminator", {}).get("mapping", {})
    return {"$ref": mapping[part]} if part in mapping else None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
