"""Reading TOML into models: key paths, `--set key=value`, and errors of one line."""

import copy
import difflib
import itertools
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticCustomError

from simtest.errors import InputError
from simtest.runtime.resources import shown

Model = TypeVar("Model", bound=BaseModel)

MAX_TOML_BYTES = 1_000_000


class Spec(BaseModel):
    """Base of all specification models: frozen, no unknown keys, no NaN or infinity, no text where a number belongs."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    @model_validator(mode="before")
    @classmethod
    def _not_coerced(cls, data: Any) -> Any:
        """Refuse what pydantic would turn into a number or a truth value: "50", true, 1."""
        for name, value in data.items() if isinstance(data, Mapping) else ():
            field: Any = cls.model_fields.get(name)
            kinds = _leaf_types(field.annotation) if field else frozenset()
            wrong, numeric = "", bool(kinds) and kinds <= {int, float, NoneType}
            if numeric and any(isinstance(leaf, str | bytes | bool) for leaf in _leaves(value)):
                wrong = "numbers" if isinstance(value, list | tuple) else "a number"
            elif kinds == {bool} and not isinstance(value, bool):
                wrong = "true or false"
            if wrong:
                raise PydanticCustomError("coerced", "must be {wrong}", {"field": name, "got": value, "wrong": wrong})
        return data


@cache
def _leaf_types(annotation: Any) -> frozenset[Any]:
    """Give the types at the leaves of an annotation such as ``tuple[float, float] | None``."""
    if get_origin(annotation) is Annotated:
        return _leaf_types(get_args(annotation)[0])
    parts = [part for part in get_args(annotation) if part is not ...]
    return frozenset({annotation}) if not parts else frozenset().union(*map(_leaf_types, parts))


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, list | tuple):
        for item in value:
            yield from _leaves(item)
    else:
        yield value


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
        return _loads(read_text(path, "TOML"))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{shown(path)}: not valid TOML: {error}") from error


def read_text(path: Path, kind: str) -> str:
    """Read a text file of moderate size.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        What it should be, for messages: "TOML", "camera".

    Returns
    -------
    str

    Raises
    ------
    InputError
        If the file is missing, too large or not UTF-8.
    """
    name = shown(path)
    try:
        size = path.stat().st_size
        # A device or a pipe has no size and might never end.
        if not path.is_file():
            raise InputError(f"{name}: is {'a folder' if path.is_dir() else 'no plain file'}; a {kind} file is needed")
        if size > MAX_TOML_BYTES:
            raise InputError(f"{name}: {size} bytes; a {kind} file of at most {MAX_TOML_BYTES} is allowed")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: not a text file in UTF-8 (byte {error.start})") from error


def _loads(text: str) -> dict[str, Any]:
    """Parse TOML; what the parser cannot hold (nesting, digits) is a `TOMLDecodeError` too."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply") from None
    except ValueError:
        # Python refuses to read integers of more than 4300 digits.
        raise tomllib.TOMLDecodeError("a number has too many digits") from None


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
            raise InputError(f"--set {shown(setting)}: must be key=value, for example surface.distance_mm=12")
        try:
            table = _loads(f"value = {value}")
        except tomllib.TOMLDecodeError:
            table = {}
        # More keys than one: the value held a line break, so it is text.
        parsed[path.strip()] = table["value"] if list(table) == ["value"] else value
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
    where = shown(where)
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
            raise InputError(f"{where}: {shown(path)}: {shown('.'.join(parents))} is a plain value, not a table")
    return result


def _step(node: Any, part: str, following: str, path: str, where: str) -> Any:
    """Go down one part of a key path; what is missing is made, a list where the following part is its first index."""
    if isinstance(node, dict):
        if part not in node and following.isdecimal() and following != "0":
            raise InputError(f"{where}: {shown(path)}: index {shown(following)} is not allowed; the first item is 0")
        return node.setdefault(part, [{}] if following == "0" else {})
    if isinstance(node, list):
        if part.isdecimal() and len(part) < 10 and int(part) < len(node):
            return node[int(part)]
        held = f"items 0 to {len(node) - 1}" if node else "no items"
        raise InputError(f"{where}: {shown(path)}: index {shown(part)} is not allowed; the list has {held}")
    raise InputError(f"{where}: {shown(path)}: {shown(part)} is below a plain value, not a table")


def place(path: Path, settings: Mapping[str, Any]) -> str:
    """Name a file for messages, and say where some of its values are replaced."""
    return f"{path} with replaced values" if settings else str(path)


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
        # A list whose item is wrong is also reported as too short: once is enough.
        places = [e["loc"] for e in errors]
        errors = [
            e for e in errors
            if not (e["type"] == "too_short" and any(p != e["loc"] and p[: len(e["loc"])] == e["loc"] for p in places))
        ]  # fmt: skip
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise InputError(f"{shown(where)}: {_describe(errors[0], model, data)}{more}") from None


def _describe(error: Any, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    location = [shown(part, 60) for part in _without_tags(error["loc"], data)]
    kind, value = error["type"], error.get("input")
    if kind == "coerced":
        return f"{'.'.join([*location, error['ctx']['field']])} = {_short(error['ctx']['got'])}: {error['msg']}"
    path = ".".join(location) or "(top level)"
    if kind == "extra_forbidden":
        return f"{path} = {_short(value)}: unknown key{_suggest(error['loc'], model)}"
    if kind == "missing":
        return f"{path}: missing; it must be given"
    if kind == "union_tag_not_found":
        return f"{path}.type: missing; allowed: {_tags(error['loc'], model)}"
    if kind == "union_tag_invalid":
        return f"{path}.type = {_short(value['type'])}: unknown; allowed: {_tags(error['loc'], model)}"
    if kind == "value_error":
        shown_value = "" if isinstance(value, Mapping) else f" = {_short(value)}"
        return f"{path}{shown_value}: {error['ctx']['error']}" if location else str(error["ctx"]["error"])
    return f"{path} = {_short(value)}: must {_demand(error)}"


def _demand(error: Any) -> str:
    """Say what a value must be or hold, in the words of TOML."""
    kind, limits = error["type"], error.get("ctx", {})
    if kind in ("model_type", "model_attributes_type", "dict_type"):
        return "be a table"
    if kind in ("tuple_type", "list_type"):
        return "be a list"
    if kind in ("too_short", "too_long", "string_too_short", "string_too_long"):
        bound, count = ("least", limits.get("min_length")) if "short" in kind else ("most", limits.get("max_length"))
        return f"have at {bound} {count} {'character' if 'string' in kind else 'item'}{'s'[: count != 1]}"
    if kind == "string_pattern_mismatch":
        return f"match the pattern {limits['pattern']}"
    return f"be {error['msg'].removeprefix('Input should be ')}"


def _without_tags(location: tuple[Any, ...], data: Any) -> list[Any]:
    """Drop the tags that pydantic puts into the location for each tagged union."""
    path: list[Any] = []
    tagged: Any = None
    for part in location:
        # The tag comes first; after it the same word is a key (type = "gamma" has a key gamma).
        if isinstance(data, Mapping) and data is not tagged and part == data.get("type"):
            tagged = data
            continue
        path.append(part)
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            data = None
    return path


def _suggest(location: tuple[Any, ...], model: type[BaseModel]) -> str:
    """List the keys that are allowed where an unknown one was found, the closest first."""
    known = list(_node(location[:-1], model).get("properties", {}))
    close = difflib.get_close_matches(str(location[-1]), known, n=1, cutoff=0.5)
    ordered = close + [k for k in known if k not in close]
    return f"; allowed: {', '.join(ordered)}" if ordered else ""


def _tags(location: tuple[Any, ...], model: type[BaseModel]) -> str:
    """List the types that a tagged union allows."""
    return ", ".join(_node(location, model).get("discriminator", {}).get("mapping", {}))


def _node(location: tuple[Any, ...], model: type[BaseModel]) -> Any:
    """Give the part of a model's JSON schema at a location; empty where it has none."""
    schema = model.model_json_schema()
    node: Any = schema
    for part in location:
        node = _descend(node, part, schema)
    return _resolve(node, schema)


def _resolve(node: Any, schema: Any) -> Any:
    while isinstance(node, dict) and "$ref" in node:
        node = schema["$defs"][node["$ref"].rsplit("/", 1)[1]]
    if isinstance(node, dict) and "anyOf" in node:
        # An optional table: the other choice is null.
        tables = [choice for choice in node["anyOf"] if choice.get("type") != "null"]
        return _resolve(tables[0], schema) if len(tables) == 1 else {}
    return node if isinstance(node, dict) else {}


def _descend(node: Any, part: Any, schema: Any) -> Any:
    node = _resolve(node, schema)
    if isinstance(part, int):
        return node.get("items")
    if isinstance(node.get("additionalProperties"), dict):
        return node["additionalProperties"]
    if part in node.get("properties", {}):
        return node["properties"][part]
    mapping = node.get("discriminator", {}).get("mapping", {})
    return {"$ref": mapping[part]} if part in mapping else None


def _short(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:
        # Python refuses to write integers of more than 4300 digits.
        text = "a number of too many digits"
    return text if len(text) <= 80 else text[:77] + "..."
