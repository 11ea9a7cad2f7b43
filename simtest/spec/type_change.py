"""What becomes of a table when a setting replaces its type, or one key by another that excludes it."""

import copy
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from simtest.spec.json_schema import nodes_at
from simtest.spec.toml_files import apply_settings

RIVALS = {
    "camera.fov_deg": ("fx", "fy"), "camera.fx": ("fov_deg", "fov_of"), "camera.fy": ("fov_deg", "fov_of"),
    "sensor.exposure.full_scale": ("percentile", "average"), "sensor.exposure.percentile": ("full_scale", "average"),
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
    it is refused by its name. Keys that both types have stay. In the same way a key replaces its `RIVALS`.

    Parameters
    ----------
    model : type
        Of the tables.
    data : mapping
        The tables.
    settings : mapping
        Values by key path.
    where : str
        Name of the file, for messages.
    """
    result = apply_settings(_without_rivals(data, settings), settings, where)
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
    schema = model.model_json_schema()
    tagged = (node for node in nodes_at(schema, path) if kind in node.get("discriminator", {}).get("mapping", {}))
    if next(tagged, None) is None:
        return None
    return {key for node in nodes_at(schema, [*path, kind]) for key in node.get("properties", {})}
