"""Writing TOML values that read back the same."""

import json
from collections.abc import Mapping
from typing import Any


def toml_value(value: Any) -> str:
    """Give a value as TOML: text quoted, tables and lists inline."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    if isinstance(value, str):
        # A JSON string is a TOML basic string.
        return json.dumps(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def toml_tables(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Give tables by name as the text of a TOML file, a line for each key."""
    parts = []
    for name, table in tables.items():
        lines = [f"{key} = {toml_value(value)}\n" for key, value in table.items()]
        parts.append(f"[{name}]\n{''.join(lines)}")
    return "\n".join(parts)
