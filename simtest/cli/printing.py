"""What commands print: one JSON document, or tables and lines."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from simtest.cli.manners import MANNERS

MOST_ROWS = 20
"""A longer table is cut, or replaced by a summary, unless --verbose is given."""

TABLE_WIDTH = 125


def print_json(value: Any) -> None:
    """Print a value as one JSON document; records and arrays as in files, and null for NaN and infinity."""
    from simtest.runtime.files import as_json

    text = json.dumps(value, default=lambda item: str(item) if hasattr(item, "__fspath__") else as_json(item))
    print(json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2, allow_nan=False))


def print_run(folder: Path, **told: Any) -> None:
    """Print a run as one JSON document: its files, what guide.json and summary.json hold, and what else is told."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    files = {"page": folder / "index.html", "results": folder / "results.parquet"}
    print_json({**files, **told, "guide": read_guide(folder), **summary})


def read_guide(folder: Path) -> dict[str, Any] | None:
    """Read which method to use, and where each breaks, from a run's guide.json; None where there is none."""
    try:
        guide: dict[str, Any] = json.loads((folder / "guide.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return guide


def print_files(files: Iterable[object], as_json: bool, **told: Any) -> None:
    """Print the files that a command has written: a line each, or as JSON with what else is told."""
    if as_json:
        print_json({**told, "files": [str(file) for file in files]})
    else:
        for file in files:
            print(file)


def print_lines(lines: Sequence[str]) -> None:
    """Print lines, at most `MOST_ROWS` of them unless --verbose is given."""
    kept = lines if MANNERS.verbose else lines[:MOST_ROWS]
    for line in kept:
        print(line)
    print_rest(len(lines) - len(kept))


def print_rest(count: int, rest: str = "", tell: Callable[[str], object] = print) -> None:
    """Report through `tell` how many rows are left out, if any, and where else they can be read."""
    if count:
        tell(f"and {count} more; --verbose prints them all{rest and f', {rest}'}")


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None, rest: str = "", width: int = 0
) -> None:
    """Print a table.

    Parameters
    ----------
    columns : sequence of str
        Headings.
    rows : sequence of sequences of str
        At most `MOST_ROWS` of them are printed, all with --verbose.
    title : str, optional
        Above the table.
    rest : str
        Where the rows that are left out can be read.
    width : int
        Least number of columns of the terminal; narrower, cells would be cut off. Default `TABLE_WIDTH`.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    class Lines(Console):
        def on_broken_pipe(self) -> None:
            # A reader that has gone is answered in one place.
            raise BrokenPipeError

    # Without the names of emojis, which take as long to load as the table to print.
    console = Lines(emoji=False)
    console.width = max(console.width, width or TABLE_WIDTH)
    table = Table(*columns, title=title, title_justify="left")
    kept = rows if MANNERS.verbose else rows[:MOST_ROWS]
    for row in kept:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)
    print_rest(len(rows) - len(kept), rest)


def counted(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{number} {one if number == 1 else many or one + 's'}"
