"""What the benchmarks share: a measured figure with its limit."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Figure:
    """A measured figure beside what the project promises.

    `name`: what was measured; `value`: the figure; `limit`: what it must keep to; None where it is shown alone;
    `at_least`: whether the limit is a lower one; `unit`: "x" for a ratio; `about`: the times behind it.
    """

    name: str
    value: float
    limit: float | None = None
    at_least: bool = False
    unit: str = "x"
    about: str = ""

    @property
    def met(self) -> bool:
        """Whether the figure keeps to its limit."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def print_figures(figures: Sequence[Figure]) -> int:
    """Print figures beside their limits; return 1 where one misses its limit, else 0."""
    table = Table("figure", "measured", "limit", "", "times")
    for figure in figures:
        limit = "" if figure.limit is None else f"{'>=' if figure.at_least else '<='} {figure.limit:g} {figure.unit}"
        verdict = "" if figure.limit is None else "met" if figure.met else "MISSED"
        table.add_row(figure.name, f"{figure.value:.3g} {figure.unit}", limit, verdict, figure.about)
    Console(width=150).print(table)
    return 0 if all(figure.met for figure in figures) else 1


def print_markdown(rows: Sequence[Sequence[str]]) -> None:
    """Print a table as the manual holds it; the first row is its head."""
    head, *body = rows
    for row in (head, ["---"] * len(head), *body):
        print("| " + " | ".join(row) + " |")
    print()
