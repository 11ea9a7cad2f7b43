"""The page of keys: every key of every kind of file, from the models that read them."""

from typing import Any

from pydantic import BaseModel

from simtest.spec import CalibrationSpec, CameraSpec, Dataset, Experiment, Profile, Scene
from simtest.spec.recipes import PaperScene

MODELS: dict[str, tuple[str, type[BaseModel]]] = {
    "scene": ("A scene: what is rendered. [Scenes](../howto/scenes.md) explains it.", Scene),
    "experiment": ("Groups of settings. [Experiments](../howto/experiments.md) explains it.", Experiment),
    "dataset": ("A recipe of labelled frames. [Datasets](../howto/datasets.md) explains it.", Dataset),
    "camera": ("A camera. [Cameras](../howto/cameras.md) explains it.", CameraSpec),
    "calibration": ("A camera and what else is known of its pictures. "
                    "[Cameras](../howto/cameras.md) explains it.", CalibrationSpec),
    "profile": ("What a nightly run consists of. [Nightly reports](../howto/nightly.md) explains it.", Profile),
    "published": ("A scene of the published protocol: the texture of the specular term on a plane, seen slanted by a "
                  "camera that is not at the light; nothing is rendered.", PaperScene),
}  # fmt: skip
"""Kinds of files as `simtest schema` names them, and scenes of the published protocol."""

OPENING = """---
orphan: true
---

# Keys of the files

Every key of every kind of file, with its type, range and default; `simtest schema KIND` prints the same as JSON,
except for `published`. A key that is not listed here is refused. On the command line, `--set surface.radius_mm=5` sets
the key `radius_mm` of the table `surface`. A key without a default must be given.

"""

BOUNDS = {"minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}"}


def keys_page() -> str:
    """Return the page as Markdown."""
    text, written = OPENING, set()
    for kind, (line, model) in MODELS.items():
        schema = model.model_json_schema()
        text += f"## File: {kind}\n\n{line}\n\n{_table(schema)}"
        for name, own in schema.get("$defs", {}).items():
            # Kinds share models (a camera is part of a scene): each stands once, below the first.
            if name not in written and "properties" in own:
                written.add(name)
                text += f"### {name}\n\n{_sentence(own.get('description', ''))}{_table(own)}"
    return text


def _sentence(text: str) -> str:
    return f"{_escaped(text)}\n\n" if text else ""


def _table(schema: dict[str, Any]) -> str:
    rows = ["| key | meaning | type | default |", "|---|---|---|---|"]
    required = schema.get("required", [])
    for key, own in schema.get("properties", {}).items():
        default = "" if key in required else _default(own)
        rows.append(f"| `{key}` | {_escaped(own.get('description', ''))} | {_type(own)} | {default} |")
    return "\n".join(rows) + "\n\n"


def _default(own: dict[str, Any]) -> str:
    value = own.get("default")
    # The defaults of a table are those of its own keys.
    if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict)):
        return "its own"
    return "none" if value is None else f"`{_plain(value)}`"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return f"[{', '.join(_plain(each) for each in value)}]"
    return str(value)


def _type(own: dict[str, Any]) -> str:
    """Return a key's type in words, with its bounds, and links to the tables that it may hold."""
    if "$ref" in own:
        name = own["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    for many in ("anyOf", "oneOf"):
        if many in own:
            kinds = [_type(each) for each in own[many] if each.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    if "const" in own:
        return f"`{own['const']}`"
    if "enum" in own:
        return ", ".join(f"`{each}`" for each in own["enum"])
    if own.get("type") == "array":
        return _array(own)
    if own.get("type") == "object":
        values = own.get("additionalProperties")
        return f"table of {_type(values)}" if isinstance(values, dict) and values else "table"
    bounds = ", ".join(shape.format(_plain(own[name])) for name, shape in BOUNDS.items() if name in own)
    return _escaped(own.get("type", "any value") + (f" {bounds}" if bounds else ""))


def _array(own: dict[str, Any]) -> str:
    if "prefixItems" in own:
        kinds = [_type(each) for each in own["prefixItems"]]
        same = len(set(kinds)) == 1
        return f"list of {len(kinds)}: {kinds[0]}" if same else f"list of {', '.join(kinds)}"
    return f"list of {_type(own['items'])}" if own.get("items") else "list"


def _escaped(text: str) -> str:
    for sign in ("\\", "|", "*", "<", "$", "[", "]"):
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split())
