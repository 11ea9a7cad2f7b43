"""Keys of a scene: setting values at their paths, short names for them, and what they mean.

A setting that replaces a table's type, or a key by another that excludes it, drops what no longer fits. A key's last
name is enough where only one key of the scene ends so: ``radius_mm`` for ``surface.radius_mm``.
"""

import copy
import inspect
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Literal

from pydantic import BaseModel

from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.spec.spec_model import is_model, places, types_of, validate
from simtest.spec.toml_files import apply_settings

RIVALS = {
    "camera.fov_deg": ("fx", "fy"), "camera.fx": ("fov_deg", "fov_of"), "camera.fy": ("fov_deg", "fov_of"),
    "sensor.exposure.full_scale": ("percentile", "average", "centre"),
    "sensor.exposure.percentile": ("full_scale", "average", "centre"),
    "sensor.exposure.average": ("full_scale", "percentile"),
    "known.distance_mm": ("distance_error",), "known.distance_error": ("distance_mm",),
    "rig.preset": ("lights",),
    "rig.lights": ("preset", "count", "radius_mm", "azimuth_deg", "axial_mm", "power", "each"),
}  # fmt: skip
"""Keys of a scene, each with those beside it that it excludes, and which it replaces where it is set."""


def replace_values(
    model: type[BaseModel], data: Mapping[str, Any], settings: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """Replace values at key paths as `apply_settings` does, and drop what a table's new type does not have.

    Setting ``reflectance.type`` to another type leaves no key of the former one behind, unless it is set as well: then
    it is refused by its name. Keys that both types have stay. In the same way a key replaces its `RIVALS`. `model` is
    the type of the tables, `where` the name of their file.
    """
    result = apply_settings(_without_rivals(data, settings), settings, where)
    _warn_of_crop(data.get("camera"), result.get("camera"), settings, where)
    for path, value in settings.items():
        *parents, last = path.split(".")
        if last != "type" or not isinstance(value, str):
            continue
        before, table = _at(data, parents), _at(result, parents)
        if not isinstance(before, Mapping) or not isinstance(table, dict) or before.get("type", value) == value:
            continue
        allowed = _keys(model, parents, value)
        if allowed is None:
            # An unknown type is refused with the rest.
            continue
        head = ".".join(parents)
        given = {key.removeprefix(f"{head}.").partition(".")[0] for key in settings if key.startswith(f"{head}.")}
        for key in set(before) - allowed - given:
            table.pop(key, None)
    return result


def _warn_of_crop(before: Any, after: Any, settings: Mapping[str, Any], where: str) -> None:
    """Warn where a setting of the picture's size alone changes the field of view, since the table states fx."""
    across: Literal["width", "height"] = "width" if "camera.width" in settings else "height"
    if f"camera.{across}" not in settings or {"camera", "camera.fx", "camera.fy", "camera.fov_deg"} & settings.keys():
        return
    if not isinstance(before, Mapping) or "fx" not in before:
        return
    # Imported here: the readers of files need no lenses.
    from simtest.geometry.camera import field_of_view
    from simtest.spec.camera import SceneCamera

    try:
        old, new = (field_of_view(validate(SceneCamera, table, where).model(), across) for table in (before, after))
    except InputError:
        # Malformed tables are refused with the rest.
        return
    if not math.isclose(old, new, rel_tol=1e-3):
        setting = f"camera.fov_deg={old:.4g}" + " and camera.fov_of=height" * (across == "height")
        told = f"the field of view across the {across} changes from {old:.4g} to {new:.4g} deg, since fx and fy stay"
        # Of this place, whoever asks: the same scene is read several times.
        warnings.warn(f"{where}: camera.{across}: {told}; to keep it set {setting}", stacklevel=1)


def _without_rivals(data: Mapping[str, Any], settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return tables without the keys that a setting's key excludes."""
    tables = copy.deepcopy(dict(data))
    for rival in (rival for path in settings for rival in rivals(path)):
        *parents, key = rival.split(".")
        if isinstance(table := _at(tables, parents), dict):
            table.pop(key, None)
    return tables


def rivals(path: str) -> list[str]:
    """Return the key paths that a set one excludes."""
    return [f"{path.rpartition('.')[0]}.{key}" for key in RIVALS.get(path, ())]


def _at(data: Any, path: list[str]) -> Any:
    """Return what stands at a key path; None where nothing does."""
    for part in path:
        try:
            data = data[int(part)] if isinstance(data, list) else data[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return data


def _keys(model: type[BaseModel], path: list[str], kind: str) -> set[str] | None:
    """Return the keys of a type of the tagged union at a path; None where there is no such type."""
    if not any(kind in types_of(place) for place, _ in places(model, path)):
        return None
    return {key for place, _ in places(model, [*path, kind]) if is_model(place) for key in place.model_fields}


CLOSE = 3
"""Names that are suggested for one that does not exist."""


def full_keys(models: Sequence[BaseModel], given: Mapping[str, Any], others: Sequence[str] = ()) -> dict[str, Any]:
    """Return values by full key path, of values by the last name of a key or its full path.

    `models` hold the keys that may be meant: a scene, or those of an experiment. Keys that the scene's file states come
    before those that it leaves at their defaults, and keys of tables before those of lists of tables. A mistyped name
    may mean one of `others`, which the caller takes itself.
    """
    found = [each for model in models for each in _paths(model)]
    stated = dict.fromkeys(path for path, is_stated in found if is_stated)
    rest = dict.fromkeys(path for path, is_stated in found if not is_stated and path not in stated)
    return {_path_of(name, list(stated), list(rest), others): value for name, value in given.items()}


def _path_of(name: str, stated: Sequence[str], rest: Sequence[str], others: Sequence[str]) -> str:
    for paths in (stated, rest):
        if name in paths:
            return name
        ending = [path for path in paths if path.rsplit(".", 1)[-1] == name]
        single = [path for path in ending if not any(part.isdigit() for part in path.split("."))]
        if len(ending) == 1 or len(single) == 1:
            return (single or ending)[0]
        if ending:
            one = f'settings={{"{ending[0]}": ...}}'
            raise InputError(f"{name}: {len(ending)} keys end so: {', '.join(ending)}; name one by {one}")
    known = dict.fromkeys(path.rsplit(".", 1)[-1] for path in (*others, *stated, *rest))
    meant = suggestion(name, known, CLOSE) or "; `simtest schema scene` lists the keys"
    raise InputError(f"{name}: no key of this scene or experiment ends so{meant}")


def _paths(model: BaseModel, before: str = "", stated: bool = True) -> Iterator[tuple[str, bool]]:
    """Yield the paths of a model's keys, through its tables and lists of tables, and whether its file states each."""
    for name in type(model).model_fields:
        path, value, own = before + name, getattr(model, name), stated and name in model.model_fields_set
        yield path, own
        if isinstance(value, BaseModel):
            yield from _paths(value, f"{path}.", own)
        elif isinstance(value, list | tuple):
            for i, each in enumerate(value):
                if isinstance(each, BaseModel):
                    yield from _paths(each, f"{path}.{i}.", own)


UNITS = {"deg": "deg", "mm": "mm", "px": "px", "per_mm": "1/mm"}
"""Unit by the end of a key's name."""


@cache
def describe_key(path: str) -> str:
    """Return the description of a scene's key, such as "sensor.noise_sigma"; empty if there is none.

    If several types of a table have the key, the first one counts.
    """
    # Imported here: a scene is read by this module's help.
    from simtest.spec.scene import Scene

    texts = (
        inspect.getdoc(place) if is_model(place) else field and field.description
        for place, field in places(Scene, path.split("."))
    )
    return next((text for text in texts if text), "")


def name_key(path: str) -> str:
    """Return a key's name in words, with its unit: "tilt (deg)" for "surface.tilt_deg"."""
    words = path.rsplit(".", 1)[-1]
    for end, unit in sorted(UNITS.items(), key=lambda item: -len(item[0])):
        if words.endswith(f"_{end}"):
            return f"{words.removesuffix(f'_{end}').replace('_', ' ')} ({unit})"
    return words.replace("_", " ")
