"""Prints which method to use, and where it breaks, at the end of `simtest validate`."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simtest.cli.manners import MANNERS
from simtest.cli.printing import MOST_ROWS, print_rest, read_guide

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 80
_WIDTHS = (16, 17, 15, 10)  # of all columns but the last


def print_guide(run: Path, console: "Console | None" = None) -> None:
    """Print the guide of a run folder as a table, without colours or frames where nobody looks on at a terminal.

    Parameters
    ----------
    run : Path
        Folder with guide.json, whose rows the page shows too.
    console : rich.console.Console, optional
        Where to; default the standard output, as wide as the terminal, else `WIDTH` columns.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if console is None:
        console = Console(emoji=False, highlight=False)
        if not console.is_terminal:
            console = Console(emoji=False, highlight=False, width=WIDTH)
    guide = read_guide(run)
    if guide is None:
        console.print(
            f"{run / 'guide.json'}: missing or not readable, so the methods cannot be compared", soft_wrap=True
        )
        return
    rows = guide["rows"]
    if not rows:
        console.print("No true highlight: there is nothing to compare the methods by.")
        return
    kept = rows if MANNERS.verbose else rows[:MOST_ROWS]
    room = max(console.width, WIDTH) - sum(_WIDTHS) - len(_WIDTHS)

    def table(show_header: bool) -> Table:
        made = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), show_header=show_header)
        for head, width in zip(guide["heads"], (*_WIDTHS, room), strict=True):
            made.add_column(head, width=width, overflow="fold", header_style="bold")
        return made

    console.print(table(True))
    for circumstances, group in itertools.groupby(kept, lambda row: row["circumstances"]):
        if circumstances:
            console.print(f"[bold]{escape(circumstances)}[/bold]")
        # A table of its own for each kind of light, noise and relief, all with the same columns.
        part = table(False)
        for row in group:
            tied = f"tied: {', '.join(row['ties'])}" if row["ties"] else ""
            best = "\n".join(text for text in (row["best"] or "none", tied, row.get("unranked")) if text)
            part.add_row(*map(escape, (row["surface"], best, *_figures(row))))
            for guest in row.get("guests", ()):
                own = f"{guest['estimator']}\n({guest['standing']})"
                part.add_row(*map(escape, ("", own, *_figures(guest))))
        console.print(part)
    print_rest(len(rows) - len(kept), "as the page shows them", console.print)
    for sentence in filter(None, (guide["shared"], guide.get("seen"))):
        console.print(escape(sentence))


def _figures(row: "dict[str, Any]") -> tuple[str, str, str]:
    """Return the cells on error, answers and breaks of a row, each part on a line of its own."""
    answered = "\n".join((row["answered"], *filter(None, row["unanswered"].split(", "))))
    return row["error"].replace(" (", "\n("), answered, row["breaks"]
