"""What a key of a scene means, from the schema's own descriptions: for axes and captions."""

from collections.abc import Iterator
from functools import cache
from typing import Any

from simtest.spec.scene import Scene

UNITS = {"deg": "deg", "mm": "mm", "px": "px", "per_mm": "1/mm"}
"""Unit by the end of a key's name."""


def describe_key(path: str) -> str:
    """Give the description of a scene's key, such as "sensor.noise_sigma"; empty where there is none.

    Where several types of a table have the key, that of the first one in the schema.
    """
    schema = _schema()
    for node in _walk(schema, schema, path.split(".")):
        if description := node.get("description"):
            return str(description)
    return ""


def name_key(path: str) -> str:
    """Give a key's name in words, with its unit: "tilt (deg)" for "surface.tilt_deg"."""
    words = path.rsplit(".", 1)[-1]
    for end, unit in sorted(UNITS.items(), key=lambda item: -len(item[0])):
        if words.endswith(f"_{end}"):
            return f"{words.removesuffix(f'_{end}').replace('_', ' ')} ({unit})"
    return words.replace("_", " ")


@cache
def _schema() -> dict[str, Any]:
    return Scene.model_json_schema()


def _walk(node: dict[str, Any], schema: dict[str, Any], path: list[str]) -> Iterator[dict[str, Any]]:
    """Give the nodes at a path, through references, unions and arrays."""
    for way in ("oneOf", "anyOf", "allOf"):
        for option in node.get(way, ()):
            yield from _walk(option, schema, path)
    if reference := node.get("$ref"):
        yield from _walk(schema["$defs"][reference.rsplit("/", 1)[-1]], schema, path)
    if not path:
        yield node
        return
    if path[0].isdigit():
        for items in (node.get("items"), *node.get("prefixItems", ())):
            if isinstance(items, dict):
                yield from _walk(items, schema, path[1:])
    elif child := node.get("properties", {}).get(path[0]):
        yield from _walk(child, schema, path[1:])
