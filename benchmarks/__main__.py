"""Run the benchmarks: `python -m benchmarks [NAME]...`; exits 1 where a figure misses its limit."""

import importlib
import sys

from rich.console import Console
from rich.table import Table

from benchmarks.measuring import Figure

NAMES = ("estimators", "published", "rendering", "colour", "dataset")
"""Modules of this package with a function `figures()`."""

ON_REQUEST = (
    "history",
    "detection",
    "dataset_png",
    "dataset_memory",
    "dataset_kills",
    "coverage",
    "gate",
    "nightly_page",
)
"""The same, run where they are named: they measure no speed, and take minutes."""


def main(names: list[str]) -> int:
    """Run some benchmarks, all by default, and print their figures."""
    unknown = [name for name in names if name not in NAMES + ON_REQUEST]
    if unknown:
        print(f"benchmark {unknown[0]!r}: unknown; must be one of {', '.join(NAMES + ON_REQUEST)}", file=sys.stderr)
        return 2
    figures: list[Figure] = []
    for name in names or NAMES:
        figures += importlib.import_module(f"benchmarks.{name}").figures()
    table = Table("figure", "measured", "limit", "", "times")
    for figure in figures:
        limit = "" if figure.limit is None else f"{'>=' if figure.at_least else '<='} {figure.limit:g} {figure.unit}"
        verdict = "" if figure.limit is None else "met" if figure.met else "MISSED"
        table.add_row(figure.name, f"{figure.value:.3g} {figure.unit}", limit, verdict, figure.about)
    Console(width=150).print(table)
    return 0 if all(figure.met for figure in figures) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
