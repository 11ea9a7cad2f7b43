"""Compare what two versions of the code made of the same commands: `python -m studies.same_results BEFORE AFTER`.

BEFORE and AFTER hold the same folders: runs of `simtest validate`, datasets, renders, reconstructions, the reports of
`simtest nightly`. Tables must hold equal values, types and order of rows and columns; JSON equal values, provenance and
times aside; pictures, shards, PLY and CSV files equal bytes. Not compared are pages, what the nightly's code costs, and
its files that are named by the time or tell of the costs.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

BYTES = (".png", ".exr", ".tar", ".ply", ".csv", ".toml")
NOT_COMPARED = (
    "run",
    "provenance",
    "environment",
    "origin",
    "digest",
    "duration_s",
    "started",
    "id",
    "fingerprint",
    "command",
)
"""Keys of JSON files that say where and when: they differ between versions by design."""

NOT_COMPARED_PARTS = ("figures", "history", "verdict.json", "run.json")
"""Folders and files that are not compared."""

RENAMED = {"light_aside": "light_offset"}
"""Flags by their old names."""


def stripped(value: Any) -> Any:
    """Return a JSON value without the keys that are not compared, with flags by their new names."""
    if isinstance(value, dict):
        kept = {key: stripped(item) for key, item in value.items() if key not in NOT_COMPARED}
        # A picture's path depends on the folder that it was rendered into.
        return kept | ({"image": Path(kept["image"]).name} if isinstance(kept.get("image"), str) else {})
    if isinstance(value, list):
        return [stripped(item) for item in value]
    return RENAMED.get(value, value) if isinstance(value, str) else value


def renamed(table: pl.DataFrame) -> pl.DataFrame:
    """Return a table whose flags have their new names, without the costs of code."""
    if "kind" in table.columns:
        table = table.filter(pl.col("kind") != "cost")
    if "flags" not in table.columns or table.schema["flags"] != pl.String:
        return table
    return table.with_columns(pl.col("flags").str.replace_many(list(RENAMED), list(RENAMED.values())))


def table_difference(before: Path, after: Path) -> str | None:
    """Return how two tables differ, or None."""
    first, second = renamed(pl.read_parquet(before)), renamed(pl.read_parquet(after))
    if first.schema != second.schema:
        names = set(first.schema.items()) ^ set(second.schema.items())
        return f"schemas differ: {sorted(str(name) for name in names) or 'in the order of columns'}"
    if first.equals(second, null_equal=True):
        return None
    if first.height != second.height:
        return f"{first.height} rows, then {second.height}"
    unequal = [name for name in first.columns if not first[name].equals(second[name], null_equal=True)]
    return f"unequal values in {', '.join(unequal)}"


def arrays_difference(before: Path, after: Path) -> str | None:
    """Return how two NPZ files differ, or None."""
    with np.load(before) as first, np.load(after) as second:
        if set(first.files) != set(second.files):
            return f"arrays differ: {sorted(set(first.files) ^ set(second.files))}"
        unequal = [name for name in first.files if not _equal(first[name], second[name])]
    return f"unequal arrays {', '.join(unequal)}" if unequal else None


def _equal(first: np.ndarray, second: np.ndarray) -> bool:
    if first.dtype.kind in "US" and first.ndim == 0:
        # Descriptions are JSON texts.
        try:
            return bool(stripped(json.loads(str(first))) == stripped(json.loads(str(second))))
        except ValueError:
            return str(first) == str(second)
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()


def json_difference(before: Path, after: Path) -> str | None:
    """Return how two JSON files differ, or None."""
    first, second = (stripped(json.loads(path.read_text(encoding="utf-8"))) for path in (before, after))
    if first == second:
        return None
    if isinstance(first, dict) and isinstance(second, dict):
        keys = [key for key in first.keys() | second.keys() if first.get(key) != second.get(key)]
        return f"unequal under {', '.join(sorted(keys))}"
    return "unequal"


def difference(before: Path, after: Path) -> str | None:
    """Return how two files of one name differ, or None."""
    if not after.is_file():
        return "missing"
    if before.suffix == ".parquet":
        return table_difference(before, after)
    if before.suffix == ".npz":
        return arrays_difference(before, after)
    if before.suffix == ".json":
        return json_difference(before, after)
    return None if before.read_bytes() == after.read_bytes() else "unequal bytes"


def compared(before: Path) -> Iterator[Path]:
    """Yield the files that are compared, by their paths below the folder."""
    for path in sorted(before.rglob("*")):
        if path.suffix in (*BYTES, ".parquet", ".npz", ".json") and not set(path.parts) & set(NOT_COMPARED_PARTS):
            yield path.relative_to(before)


def main() -> int:
    """Print each file that differs, and how many are equal; return 1 where any differs."""
    before, after = (Path(argument) for argument in sys.argv[1:3])
    found = {name: difference(before / name, after / name) for name in compared(before)}
    for name, how in found.items():
        if how:
            print(f"{name}: {how}")
    unequal = sum(how is not None for how in found.values())
    print(f"{len(found) - unequal} of {len(found)} files equal")
    return int(unequal > 0)


if __name__ == "__main__":
    sys.exit(main())
