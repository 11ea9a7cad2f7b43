"""Descriptions of a scene's keys, from the schema itself: for axes and captions."""

from functools import cache
from typing import Any

from simtest.spec.json_schema import nodes_at
from simtest.spec.scene import Scene

UNITS = {"deg": "deg", "mm": "mm", "px": "px", "per_mm": "1/mm"}
"""Unit by the end of a key's name."""


@cache
def describe_key(path: str) -> str:
    """Return the description of a scene's key, such as "sensor.noise_sigma"; empty if there is none.

    If several types of a table have the key, the first one in the schema counts.
    """
    nodes = nodes_at(_schema(), path.split("."))
    return next((str(node["description"]) for node in nodes if node.get("description")), "")


@cache
def _schema() -> dict[str, Any]:
    """Return the scene's schema; making it takes a quarter of a second."""
    return Scene.model_json_schema()


def name_key(path: str) -> str:
    """Return a key's name in words, with its unit: "tilt (deg)" for "surface.tilt_deg"."""
    words = path.rsplit(".", 1)[-1]
    for end, unit in sorted(UNITS.items(), key=lambda item: -len(item[0])):
        if words.endswith(f"_{end}"):
            return f"{words.removesuffix(f'_{end}').replace('_', ' ')} ({unit})"
    return words.replace("_", " ")
