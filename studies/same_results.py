"""Compare what two versions of the code made of the same commands.

    python -m studies.same_results BEFORE AFTER [--tolerance T] [--words]

BEFORE and AFTER hold the same folders: runs of `simtest validate`, datasets, renders, reconstructions, the reports of
`simtest nightly`. Both must hold the same files, one at least. Tables must have equal values, types and order of rows
and columns; JSON equal values of equal types; pages and other texts equal characters; arrays equal bytes and types; all
other files equal bytes. What says where and when the files were made is left out by its place, as the tables below list
it, and nothing else is. With a tolerance, floats in tables, JSON, NPY and NPZ may differ by so much, and the largest
difference is printed; counts, texts and truth values may not. With --words, pages are compared by the words that a
reader sees.
"""

import argparse
import html
import json
import math
import re
import sys
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

NOT_COMPARED = {
    ".lock": "says which process has the folder",
    ".part": "is what a stopped run left of a file",
    ".log": "says when what happened",
}
"""Suffixes of files that are not compared, and why; a suffix that stands neither here nor in `COMPARE` is an error."""

ORIGIN = (
    "commit", "version", "versions", "python", "processor", "system", "llvm", "fingerprint", "source", "source_hash",
    "started", "duration_s", "experiments_s", "command",
)  # fmt: skip
"""Keys of a record of origin that say where, when and by which code."""

LEFT_OUT: dict[str, tuple[str, ...]] = {
    "*.json": tuple(f"{top}/{key}" for top in ("run", "provenance", "environment", "origin") for key in ORIGIN),
    # The record of a nightly run; each of its files is compared itself.
    "run.json": ("id", "files", *ORIGIN),
    "verdict.json": ("run/id", "costs", *(f"baseline/{key}" for key in ("id", *ORIGIN))),
    # The card names the version; it is compared itself.
    "manifest.json": ("digest", "tables/README.md/sha256"),
}
"""Paths of keys that are left out of JSON files, by the files' names."""

FOLDERS = {"*.json": ("image",)}
"""Paths of keys whose value is a path that hangs on the folder: its name is compared."""

ORIGIN_COLUMNS = ("run_id", "started", "commit", "processor", "versions", "duration_s", "source_hash")
"""Columns of the nightly run's history that say where and when."""

TEXTS: tuple[tuple[str, str], ...] = (
    (r"simtest \d+\.\d+\.\d+", "the version"),
    (r"\d{8}T\d{6}Z-\d+-[0-9a-f]{8}", "a nightly run's name"),
    (r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\+00:00)?)?( UTC)?, commit [^,]*, [\d.]+ \w+( on [^;]*)?", "when, how long"),
    (r"(?<=<title>)([^<]*), \d{4}-\d\d-\d\d \d\d:\d\d UTC", "the title's time"),
    (r'<tr><th[^>]*>(id|versions: simtest|' + "|".join(
        key.replace("_", "_(?:<wbr>)?") for key in ORIGIN) + r')</th><td[^>]*>.*?</td></tr>', "a page's origin"),
    (r"<!-- made of \{.*?\} -->", "hashes of what the page was made of"),
    (r'<script type="application/octet-stream" id="trend-data">[^<]*</script>', "the history, compared as tables"),
    (r' (time|timestamp)="[^"]*"', "when and how long"),
)  # fmt: skip
"""What is left out of texts, and what it is."""

PARTS = ((r"^date=.*", "date"), (r"^commit=.*", "commit"), (r"^\d{8}T\d{6}Z-\d+-[0-9a-f]{8}", "run"))
"""Folders and files that are named by the time or the commit, and what they are called here."""


def flat(value: Any, path: str = "") -> dict[str, Any]:
    """Return the values of a JSON document by their full paths; empty tables and lists are values."""
    if not isinstance(value, dict | list) or not value:
        return {path: value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {key: leaf for name, item in items for key, leaf in flat(item, f"{path}/{name}").items()}


class Rules:
    """How far results may differ, and how far they did."""

    def __init__(self, tolerance: float = 0.0, words: bool = False) -> None:
        self.tolerance, self.words, self.largest = tolerance, words, 0.0

    def close(self, first: Any, second: Any) -> bool:
        """Return whether floats, alone or in arrays of one shape, are equal within the tolerance."""
        # NaN and infinity have no distance from themselves.
        with np.errstate(invalid="ignore"):
            gap = np.abs(np.asarray(first, dtype=float) - np.asarray(second, dtype=float))
        gap = np.where(np.equal(first, second) | (np.isnan(first) & np.isnan(second)), 0.0, gap)
        if not bool((gap <= self.tolerance).all()):
            return False
        self.largest = max(self.largest, float(gap.max(initial=0.0)))
        return True


def document(text: str, name: str) -> dict[str, str]:
    """Return what is compared of a JSON document: values as text, so that 1, 1.0 and true differ, by their paths."""
    left_out = [f"/{path}" for pattern, paths in LEFT_OUT.items() if fnmatch(name, pattern) for path in paths]
    named = [f"/{path}" for pattern, paths in FOLDERS.items() if fnmatch(name, pattern) for path in paths]
    kept = {}
    for path, value in flat(json.loads(text)).items():
        if not any(path == key or path.startswith(f"{key}/") for key in left_out):
            own = Path(value).name if path in named and isinstance(value, str) else value
            kept[path] = without_origin(json.dumps(own))
    return kept


def without_origin(text: str) -> str:
    """Return a text without what says where and when it was made."""
    for pattern, what in TEXTS:
        text = re.sub(pattern, f"({what})", text, flags=re.DOTALL)
    return text


def table(path: Path) -> pl.DataFrame:
    """Return a table without the costs of code and, in the history, without where and when."""
    found = pl.read_parquet(path, hive_partitioning=False)
    if {"kind", "quantity", "value"} <= set(found.columns):
        found = found.filter(pl.col("kind") != "cost")
    return found.drop(ORIGIN_COLUMNS) if set(ORIGIN_COLUMNS) <= set(found.columns) else found


def _same_columns(first: pl.Series, second: pl.Series, rules: Rules) -> bool:
    if first.equals(second, null_equal=True):
        return True
    if rules.tolerance == 0 or not first.dtype.is_float() or not first.is_null().equals(second.is_null()):
        return False
    return rules.close(first.drop_nulls().to_numpy(), second.drop_nulls().to_numpy())


def table_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return how two tables differ, or None."""
    first, second = table(before), table(after)
    if list(first.schema.items()) != list(second.schema.items()):
        names = set(first.schema.items()) ^ set(second.schema.items())
        return f"schemas differ: {sorted(str(name) for name in names) or 'in the order of columns'}"
    if first.height != second.height:
        return f"{first.height} rows, then {second.height}"
    unequal = [name for name in first.columns if not _same_columns(first[name], second[name], rules)]
    return f"unequal values in {', '.join(unequal)}" if unequal else None


def _equal(first: np.ndarray, second: np.ndarray, rules: Rules) -> bool:
    if first.dtype != second.dtype or first.shape != second.shape:
        return False
    if rules.tolerance > 0 and first.dtype.kind == "f":
        return rules.close(first, second)
    return first.tobytes() == second.tobytes()


def arrays_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return how two NPZ files differ, or None."""
    with np.load(before) as first, np.load(after) as second:
        if set(first.files) != set(second.files):
            return f"arrays differ: {sorted(set(first.files) ^ set(second.files))}"
        unequal = [name for name in first.files if not _equal(first[name], second[name], rules)]
    return f"unequal arrays {', '.join(unequal)}" if unequal else None


def _same_values(first: str | None, second: str | None, rules: Rules) -> bool:
    if first == second or rules.tolerance == 0 or first is None or second is None:
        return first == second
    values = json.loads(first), json.loads(second)
    return all(isinstance(value, float) and math.isfinite(value) for value in values) and rules.close(*values)


def array_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return that two NPY files differ, or None."""
    return None if _equal(np.load(before), np.load(after), rules) else "unequal arrays"


def json_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return how two JSON files differ, or None."""
    first, second = (document(path.read_text(encoding="utf-8"), path.name) for path in (before, after))
    unequal = sorted(key for key in first.keys() | second.keys()
                     if not _same_values(first.get(key), second.get(key), rules))  # fmt: skip
    return f"unequal at {', '.join(unequal[:5])}{' ...' * (len(unequal) > 5)}" if unequal else None


def words(page: str) -> list[str]:
    """Return the words of a page that a reader sees, a line each."""
    shown = re.sub(r"<!--.*?-->|<(script|style|svg)\b.*?</\1>|<[^>]*>", " ", page, flags=re.DOTALL)
    return html.unescape(shown).split()


def text_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return how two texts differ, or None."""
    texts = [without_origin(path.read_text(encoding="utf-8")) for path in (before, after)]
    by_words = rules.words and before.suffix == ".html"
    first, second = (words(text) if by_words else text.splitlines() for text in texts)
    unequal = [number + 1 for number, pair in enumerate(zip(first, second, strict=False)) if pair[0] != pair[1]]
    if not unequal and len(first) == len(second):
        return None
    if by_words:
        start = unequal[0] - 1 if unequal else min(len(first), len(second))
        said = [" ".join(each[start : start + 8]) for each in (first, second)]
        return f"{len(unequal)} words differ, first '{said[0]}', then '{said[1]}'"
    return f"unequal from line {unequal[0] if unequal else min(len(first), len(second)) + 1} on"


def bytes_difference(before: Path, after: Path, rules: Rules) -> str | None:
    """Return that two files' bytes differ, or None."""
    return None if before.read_bytes() == after.read_bytes() else "unequal bytes"


COMPARE: dict[str, Callable[[Path, Path, Rules], str | None]] = {
    ".parquet": table_difference,
    ".npz": arrays_difference,
    ".npy": array_difference,
    ".json": json_difference,
    **dict.fromkeys((".html", ".md", ".xml", ".svg"), text_difference),
    **dict.fromkeys(
        (".png", ".jpg", ".exr", ".tar", ".ply", ".csv", ".toml", ".txt", ".jsonl", ".mat", ".avi"),
        bytes_difference,
    ),
}
"""How files are compared, by their suffixes."""


def files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder that are compared, by their paths below it without times and commits."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or Path(f"_{path.name}").suffix in NOT_COMPARED:
            continue
        parts = list(path.relative_to(folder).parts)
        for pattern, word in PARTS:
            parts = [re.sub(pattern, word, part) for part in parts]
        name = "/".join(parts)
        # Several nightly runs lie in one folder; their order is that of their times.
        while name in found:
            name = f"{name} (next)"
        found[name] = path
    return found


def differences(before: Path, after: Path, rules: Rules | None = None) -> dict[str, str | None]:
    """Return how each file of two folders differs, by its name; None where it does not."""
    rules = rules or Rules()
    first, second = files(before), files(after)
    found: dict[str, str | None] = {}
    for name in sorted(first.keys() | second.keys()):
        if name not in first or name not in second:
            found[name] = f"there only {'before' if name in first else 'afterwards'}"
        elif compare := COMPARE.get(first[name].suffix):
            found[name] = compare(first[name], second[name], rules)
        else:
            found[name] = f"a file of the suffix {first[name].suffix!r}, of which studies/same_results.py knows nothing"
    return found


def main(arguments: list[str]) -> int:
    """Print each file that differs, and how many are equal; return 1 where any differs, 2 where there is none."""
    parser = argparse.ArgumentParser(description="Compare what two versions of the code made of the same commands.")
    parser.add_argument("before", type=Path, metavar="BEFORE")
    parser.add_argument("after", type=Path, metavar="AFTER")
    parser.add_argument("--tolerance", type=float, default=0.0, help="largest difference of two floats; default 0")
    parser.add_argument("--words", action="store_true", help="of pages, the words that a reader sees alone")
    given = parser.parse_args(arguments)
    before, after, rules = given.before, given.after, Rules(given.tolerance, given.words)
    for folder in (before, after):
        if not folder.is_dir():
            print(f"{folder}: no such folder", file=sys.stderr)
            return 2
    found = differences(before, after, rules)
    for name, how in found.items():
        if how:
            print(f"{name}: {how}")
    unequal = sum(how is not None for how in found.values())
    print(f"{len(found) - unequal} of {len(found)} files equal")
    if rules.tolerance > 0:
        print(f"largest difference of equal files' floats: {rules.largest:.3g}")
    for suffix, why in NOT_COMPARED.items():
        print(f"not compared: {suffix}, which {why}")
    return 2 if not found else int(unequal > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
