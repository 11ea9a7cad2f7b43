"""Compare the tables of measured figures with what their commands print.

Convention: above a table stands the command that makes it, run from the checkout's root:

    <!-- made by: simtest validate rig --out $OUT/rig && python -m studies.run_tables rig $OUT/rig; minutes: 0.2 -->

`$OUT` is an empty folder, the same for all tables; a part between `&&` that several tables name runs once. `minutes`
are those of the processor. Every row of the table must be printed: the numbers of its first cell as they stand, the
others within one unit in their last digit, which another processor can cause. More stands in the comment:

- `within: 5 %` allows so much in place of one unit, where that is more;
- `part` allows further numbers in a printed row, as columns that the page leaves out.

With `--write` a row that differs takes the numbers of the printed row in the place of its own, words and form as they
are; a table of a `part` is left to its reader.
"""

import math
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from studies.manual.blocks import ROOT, manual_pages
from studies.manual.runner import copy_checkout, shell

MADE_BY = re.compile(
    r"<!-- made by: (?P<command>.*?); minutes: (?P<minutes>[\d.]+)"
    r"(?:; within: (?P<within>\d+) %)?(?P<part>; part)? -->",
    re.DOTALL,
)
NUMBER = re.compile(r"(?<![\w.])[+-]?(?:\d{1,3}(?:,\d{3})+(?!\d)|\d+)(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)")
CHEAP = 0.34
"""Minutes of a table that CI makes."""

ROUNDING = 1e-13
"""What is left of exact zeros differs between processors by less."""


@dataclass(frozen=True)
class Table:
    """A table of figures, with the command that makes it.

    `place`: its page, and the line of its comment; `command`: what prints it; `minutes`: of the processor, about;
    `within`: share by which its numbers may differ, where that is more than one unit in the last digit; `part`:
    whether a printed row may hold further numbers; `rows`: the cells of its body.
    """

    place: str
    command: str
    minutes: float
    within: float
    part: bool
    rows: tuple[tuple[str, ...], ...]


def tables_of(path: Path) -> Iterator[Table]:
    """Yield the tables of a page that name their command."""
    text = path.read_text(encoding="utf-8")
    page = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
    for found in MADE_BY.finditer(text):
        line = text[: found.start()].count("\n") + 1
        body = re.match(r"\s*((?:\|.*\n?)+)", text[found.end() :])
        if body is None:
            raise ValueError(f"{page}:{line}: no table stands below the comment")
        rows = tuple(tuple(row.strip().strip("|").split("|")) for row in body[1].splitlines()[2:])
        command, within = " ".join(found["command"].split()), int(found["within"] or 0) / 100
        yield Table(f"{page}:{line}", command, float(found["minutes"]), within, found["part"] is not None, rows)


def differences(table: Table, printed: str) -> list[str]:
    """Return a line for each row of a table that is not printed, with what is printed in its place."""
    return [
        f"{' | '.join(cell.strip() for cell in cells)}: {', '.join(wrong)}"
        for cells, _, wrong in _nearest(table, printed)
        if wrong
    ]


def renewed(table: Table, printed: str, text: str) -> str:
    """Return the text of a page, the rows of its table that differ with the numbers that are printed."""
    for cells, row, wrong in _nearest(table, printed):
        if wrong and row and not table.part:
            line = f"|{'|'.join(cells)}|"
            words = NUMBER.split(line)
            text = text.replace(line, "".join(word + number for word, number in zip(words, [*row, ""], strict=True)))
    return text


def _nearest(table: Table, printed: str) -> Iterator[tuple[tuple[str, ...], list[str] | None, list[str]]]:
    """Yield each row with numbers, those of the printed row that is nearest to it, and in what they differ."""
    left = [numbers for line in printed.splitlines() if (numbers := NUMBER.findall(line))]
    for cells in table.rows:
        shown, first = NUMBER.findall(" | ".join(cells)), len(NUMBER.findall(cells[0]))
        fitting = [
            (_wrong(shown, row, first, table), i) for i, row in enumerate(left) if _fits(shown, row, first, table)
        ]
        if shown and fitting:
            wrong, nearest = min(fitting, key=lambda each: len(each[0]))
            yield cells, left.pop(nearest), wrong
        elif shown:
            yield cells, None, ["no such row is printed"]


def _fits(shown: Sequence[str], row: Sequence[str], first: int, table: Table) -> bool:
    """Return whether a printed row may be a row of the table: as many numbers, and those of the first cell."""
    enough = len(row) >= len(shown) if table.part else len(row) == len(shown)
    return enough and list(map(_value, shown[:first])) == list(map(_value, row[:first]))


def _wrong(shown: Sequence[str], row: Sequence[str], first: int, table: Table) -> list[str]:
    """Return the numbers of a row that are not printed; with `part` the printed ones may hold others between."""
    if not table.part:
        pairs = zip(shown[first:], row[first:], strict=True)
        return [f"{each} is {given}" for each, given in pairs if not _is_near(each, given, table.within)]
    wrong, start = [], first
    for each in shown[first:]:
        at = next((k for k in range(start, len(row)) if _is_near(each, row[k], table.within)), None)
        wrong += [f"{each} is not printed"] if at is None else []
        start = start if at is None else at + 1
    return wrong


def _is_near(shown: str, printed: str, within: float) -> bool:
    """Return whether a printed number is the one shown, within one unit in its last digit or a share of it."""
    mantissa, _, power = shown.partition("e")
    unit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    # A hundredth for the rounding of the decimals.
    allowed = max(1.01 * unit, within * math.fabs(_value(shown)), ROUNDING)
    return math.fabs(_value(shown) - _value(printed)) <= allowed


def _value(number: str) -> float:
    return float(number.replace(",", ""))


def check_figures(pages: Sequence[Path] | None, cheap: bool, timeout_s: float, write: bool = False) -> int:
    """Make the tables of the pages anew, print and `write` what differs; return 1 if anything does, or none is made."""
    tables = [(page, table) for page in pages or manual_pages() for table in tables_of(page)]
    failed = 0
    with tempfile.TemporaryDirectory(prefix="manual-") as folder:
        # Data that is not ours lies beside the checkout.
        scratch, data = Path(folder) / ROOT.name, ROOT.parent / "shared"
        (scratch / "out").mkdir(parents=True)
        copy_checkout(scratch)
        if data.is_dir():
            (Path(folder) / data.name).symlink_to(data)
        printed: dict[str, tuple[bool, str]] = {}
        for page, table in tables:
            if cheap and table.minutes > CHEAP:
                print(f"left out          {table.place}: {table.minutes:g} minutes")
                continue
            started = time.monotonic()
            for part in table.command.split(" && "):
                if part not in printed:
                    printed[part] = shell(f"OUT={scratch / 'out'}; {part}", scratch, timeout_s)
            runs = [printed[part] for part in table.command.split(" && ")]
            broken = [text[-1000:] for succeeded, text in runs if not succeeded]
            made = "\n".join(text for _, text in runs)
            found = broken or differences(table, made)
            if write and found and not broken:
                page.write_text(renewed(table, made, page.read_text(encoding="utf-8")), encoding="utf-8")
            print(f"{'DIFFERS' if found else 'ok':>8} {time.monotonic() - started:6.1f} s {table.place}", flush=True)
            print("".join(f"         {line}\n" for line in found), end="", flush=True)
            failed += bool(found)
    print(f"{failed} of {len(tables)} tables differ" if failed else "as shown")
    return 1 if failed else 0
