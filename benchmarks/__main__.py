"""Run the benchmarks: `python -m benchmarks [NAME]...`; exits 1 where a figure misses its limit."""

import importlib
import sys

from benchmarks.measuring import Figure, print_figures

NAMES = ("rendering", "dataset")
"""Modules of this package with a function `figures()`."""

ON_REQUEST = ("transfers", "growth", "cost")
"""The same, run where they are named: they take minutes, or need what is not always there."""


def main(names: list[str]) -> int:
    """Run some benchmarks, all by default, and print their figures."""
    unknown = [name for name in names if name not in NAMES + ON_REQUEST]
    if unknown:
        print(f"benchmark {unknown[0]!r}: unknown; must be one of {', '.join(NAMES + ON_REQUEST)}", file=sys.stderr)
        return 2
    figures: list[Figure] = []
    for name in names or NAMES:
        figures += importlib.import_module(f"benchmarks.{name}").figures()
    return print_figures(figures)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
