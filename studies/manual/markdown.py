"""Markdown of the generated pages."""

import re
from collections.abc import Iterable, Sequence


def code(names: str) -> str:
    """Return names, separated by ", ", as code."""
    return ", ".join(f"`{name}`" for name in names.split(", "))


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of Markdown."""
    lines = [heads, ["---"] * len(heads), *([_cell(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    """Return a cell on one line, its signs taken as they are where they are no code."""
    parts = " ".join(text.split()).split("`")
    parts[::2] = [re.sub(r"([|*$<])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)
