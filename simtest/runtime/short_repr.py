"""Short texts of values with large arrays inside: what a notebook or a debugger shows of them."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

LONGEST = 280
"""Characters of a text, with the name of the type."""

LONGEST_PART = 60
"""Characters of one field's text."""

FEW = 3
"""Arrays and sequences of no more elements are shown; of longer ones, their size."""


def short_repr(self: object) -> str:
    """Return the type's name with its fields, arrays and nested records shortened; a `__repr__` for records.

    Fields that are None are left out. The text has at most `LONGEST` characters.
    """
    name, parts, used = type(self).__name__, [], 0
    for field, value in _fields(self):
        if value is None:
            continue
        part = f"{field}={clipped(short(value), LONGEST_PART)}"
        used += len(part) + 2
        if len(name) + used > LONGEST - 7:
            parts.append("...")
            break
        parts.append(part)
    return f"{name}({', '.join(parts)})"


def short(value: object) -> str:
    """Return a value as short text: small arrays and sequences by their elements, others by their size."""
    if isinstance(value, np.ndarray):
        if value.ndim <= 1 and value.size <= FEW:
            return vector(value)
        return f"<{' x '.join(map(str, value.shape))} {value.dtype}>"
    if isinstance(value, bool | np.bool_):
        return str(bool(value))
    if isinstance(value, int | np.integer):
        return str(int(value))
    if isinstance(value, float | np.floating):
        return f"{float(value):.4g}"
    if isinstance(value, str):
        return repr(str(value))
    if isinstance(value, Mapping):
        return f"{{{', '.join(map(str, value))}}}"
    if isinstance(value, list | tuple):
        if len(value) <= FEW or (isinstance(value, tuple) and all(isinstance(each, str) for each in value)):
            return f"({', '.join(map(short, value))})"
        return f"<{len(value)} items>"
    if is_dataclass(value) or hasattr(value, "model_fields_set"):
        return f"<{type(value).__name__}>"
    return repr(value)


def vector(values: Any, digits: int = 4) -> str:
    """Return a few numbers in brackets."""
    return f"({', '.join(f'{float(v):.{digits}g}' for v in np.atleast_1d(values))})"


def _fields(value: object) -> Iterator[tuple[str, object]]:
    """Yield the names and values of a data class's or a model's public fields."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.repr]
    else:
        names = list(type(value).model_fields)  # type: ignore[attr-defined]
    for name in names:
        if not name.startswith("_"):
            yield name, getattr(value, name)


def clipped(text: str, length: int) -> str:
    """Return a text, or its beginning with dots where it is longer than `length`."""
    return text if len(text) <= length else text[: length - 3] + "..."
