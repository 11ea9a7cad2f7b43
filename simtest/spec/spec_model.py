"""Base of all specification models: strict validation, ranges they share, and errors of one line."""

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Self, TypeGuard, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from simtest.errors import InputError
from simtest.runtime.boundary import close_names, shown, suggestion
from simtest.spec.toml_files import apply_settings, read_toml, source_name

Model = TypeVar("Model", bound=BaseModel)

Name = Annotated[str, Field(min_length=1, max_length=80, pattern=r"^[A-Za-z0-9_-]+$")]
"""Of an experiment, dataset or profile: fit for a file name."""

Share = Annotated[float, Field(ge=0, le=1)]


def unsaid_at(default: object) -> dict[str, Any]:
    """Return what a key's Field takes that came later: a model with the default is written as it was before."""
    return {"exclude_if": lambda value: value == default}


UNSAID: dict[str, Any] = {"exclude_if": lambda value: not value}
"""The same where the default is 0, none or empty."""

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]

Millimetres = Annotated[float, Field(ge=1e-3, le=1e6)]

Curvature = Annotated[float, Field(ge=-10, le=10)]


class Spec(BaseModel):
    """Base of all specification models: frozen, no unknown keys, no NaN or infinity, no text where a number belongs."""

    exclusive: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Keys of which one at most may differ from its default."""

    directions: ClassVar[tuple[str, ...]] = ()
    """Keys of vectors that must have a length."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False, defer_build=True)

    @model_validator(mode="before")
    @classmethod
    def _not_coerced(cls, data: Any) -> Any:
        """Refuse what pydantic would turn into a number or a truth value: "50", true, 1."""
        for name, value in data.items() if isinstance(data, Mapping) else ():
            # Unknown keys are refused later, with a suggestion.
            field: Any = cls.model_fields.get(name)
            kinds = _leaf_types(field.annotation) if field else frozenset()
            words = [kind for kind in kinds if isinstance(kind, str)]
            wrong, numeric = "", not kinds.isdisjoint({int, float}) and kinds.isdisjoint({str, bool, object, Any})
            if numeric and any(isinstance(leaf, str | bytes | bool) and leaf not in words for leaf in _leaves(value)):
                wrong = "numbers" if isinstance(value, list | tuple) else " or ".join(["a number", *map(repr, words)])
            elif kinds == {bool} and not isinstance(value, bool):
                wrong = "true or false"
            if wrong:
                raise PydanticCustomError("coerced", "must be {wrong}", {"field": name, "got": value, "wrong": wrong})
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        fields = type(self).model_fields
        for keys in self.exclusive:
            given = [key for key in keys if getattr(self, key) != fields[key].default]
            if len(given) > 1:
                raise ValueError(f"{' and '.join(given)} exclude each other; give one of them")
        for key in self.directions:
            if not any(getattr(self, key)):
                raise ValueError(f"{key} = {list(getattr(self, key))}: must have a length")
        return self


def with_preset(data: Mapping[str, Any], preset: Mapping[str, Any]) -> dict[str, Any]:
    """Return a model's keys with a preset's where none are given.

    A table that both give is the preset's with the given keys replaced, unless the two are of different types.
    """
    filled = {**preset, **data}
    for name, value in preset.items():
        given = data.get(name)
        if isinstance(value, Mapping) and isinstance(given, Mapping):
            alike = given.get("type", value.get("type")) == value.get("type")
            filled[name] = {**value, **given} if alike else given
    return filled


@cache
def _leaf_types(annotation: Any) -> frozenset[Any]:
    """Return the types at the leaves of an annotation such as ``tuple[float, float] | None``."""
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


def load(model: type[Model], path: Path, settings: Mapping[str, Any] | None = None) -> Model:
    """Read a TOML file as a model that has a `Name`, by default that of the file.

    Values of `settings` replace those of the file, by key path.
    """
    data = apply_settings(read_toml(path), settings or {}, str(path))
    data.setdefault("name", re.sub("[^A-Za-z0-9_-]+", "-", path.stem)[:80])
    return validate(model, data, source_name(path, settings))


def validate(model: type[Model], data: Mapping[str, Any], where: str) -> Model:
    """Validate nested tables against a model; `where` is the name of their file.

    An `InputError` has one line with file, key path, value, what is allowed, and the number of further errors.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        # A list with a wrong item is reported as too short as well: once is enough.
        paths = [e["loc"] for e in errors]
        errors = [
            e for e in errors
            if not (e["type"] == "too_short" and any(p != e["loc"] and p[: len(e["loc"])] == e["loc"] for p in paths))
        ]  # fmt: skip
        errors = sorted(errors, key=lambda e: _is_missing_by_typo(e, errors))
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise InputError(f"{where}: {_describe(errors[0], model, data)}{more}") from None


def _is_missing_by_typo(error: Any, errors: list[Any]) -> bool:
    """Return whether a key is missing beside an unknown one of a similar name, which is then the error to tell."""
    *table, key = error["loc"] or ("",)
    beside = (e["loc"] for e in errors if e["type"] == "extra_forbidden")
    return error["type"] == "missing" and any(
        list(location[:-1]) == table and close_names(location[-1], [key], alike=0.5) for location in beside
    )


def _describe(error: Any, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    """Return one of pydantic's errors as text: key path, value, and what is allowed."""
    kind, value = error["type"], error.get("input")
    location = [str(part) or "''" for part in _without_tags(error["loc"], data, kind == "missing")]
    # our own error, which names the field itself
    if kind == "coerced":
        return f"{'.'.join([*location, error['ctx']['field']])} = {shown(error['ctx']['got'])}: {error['msg']}"
    # keys
    path = ".".join(location) or "(top level)"
    if kind == "extra_forbidden":
        return f"{path} = {shown(value)}: unknown key{_allowed_keys(error['loc'], model)}"
    if kind == "missing":
        return f"{path}: missing; it must be given"
    # types of tagged unions
    if kind == "union_tag_not_found":
        return f"{path}.type: missing; allowed: {_allowed_types(error['loc'], model)}"
    if kind == "union_tag_invalid":
        allowed = _allowed_types(error["loc"], model, value["type"])
        return f"{path}.type = {shown(value['type'])}: unknown; allowed: {allowed}"
    # validators of our models, then the ranges of fields
    if kind == "value_error":
        text = "" if isinstance(value, Mapping) else f" = {shown(value)}"
        return f"{path}{text}: {error['ctx']['error']}" if location else str(error["ctx"]["error"])
    return f"{path} = {shown(value)}: must {_demand(error)}"


def _demand(error: Any) -> str:
    """Return what a value must be or hold, in the words of TOML."""
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


def _without_tags(location: tuple[Any, ...], data: Any, missing: bool) -> list[Any]:
    """Drop what pydantic puts into the location for each union: the type of a tagged one, a name of its own else.

    `missing` says that the last part is a key that is not there.
    """
    path: list[Any] = []
    tagged: Any = None
    for i, part in enumerate(location):
        # The tag comes first; after it the same word is a key (type = "gamma" has a key gamma).
        if isinstance(data, Mapping) and data is not tagged and part == data.get("type"):
            tagged = data
            continue
        try:
            data = data[part]
        except (KeyError, IndexError, TypeError):
            # Of a plain union, such as a number or a table, no user knows the name.
            if not (missing and i == len(location) - 1):
                continue
            data = None
        path.append(part)
    return path


def _allowed_keys(location: tuple[Any, ...], model: type[BaseModel]) -> str:
    """List the keys that are allowed instead of an unknown one, the closest first."""
    known = list(next((place.model_fields for place, _ in places(model, location[:-1]) if is_model(place)), ()))
    close = close_names(location[-1], known, alike=0.5)
    ordered = close + [k for k in known if k not in close]
    return f"; allowed: {', '.join(ordered)}{suggestion(location[-1], known)}" if ordered else ""


def _allowed_types(location: tuple[Any, ...], model: type[BaseModel], given: object = None) -> str:
    """List the types that a tagged union allows, and the one that may be meant."""
    known = next((found for place, _ in places(model, location) if (found := types_of(place))), [])
    return ", ".join(known) + ("" if given is None else suggestion(given, known))


def places(kind: Any, path: Sequence[Any], field: FieldInfo | None = None) -> Iterator[tuple[Any, Any]]:
    """Yield the types at a path of keys and indices below a type, each with the field whose type it is, if any.

    An index is a number or text. The type of a tagged union may stand in between; without it the places in all its
    members are yielded. The members of a union come before the union.
    """
    parts, rest = get_args(kind), path[1:]
    if is_model(kind) and path:
        if child := kind.model_fields.get(path[0]):
            yield from places(child.annotation, rest, child)
        if path[0] == _type_of(kind):
            yield from places(kind, rest, field)
    elif get_origin(kind) is dict and path:
        yield from places(parts[1], rest)
    elif get_origin(kind) in (tuple, list) and path:
        for part in parts if str(path[0]).isdigit() else ():
            yield from places(part, rest)
    elif get_origin(kind) is Annotated:
        yield from places(parts[0], path, field)
    else:
        for part in parts if get_origin(kind) in (Union, UnionType) else ():
            yield from places(part, path, field)
    if not path:
        yield kind, field


def is_model(kind: Any) -> TypeGuard[type[BaseModel]]:
    """Return whether a type is a model."""
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def types_of(kind: Any) -> list[str]:
    """Return the types of a union's members that have one, in order."""
    return sorted(name for part in get_args(kind) if (name := _type_of(part))) if not is_model(kind) else []


def _type_of(kind: Any) -> str | None:
    """Return what a model's key `type` must hold; None where it has none."""
    field = kind.model_fields.get("type") if is_model(kind) else None
    return None if field is None else str(get_args(field.annotation)[0])
