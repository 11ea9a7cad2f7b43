"""Compare what the manual shows as printed with what its commands print.

Convention: a `text` block shows the output of the `sh` or `python` block before it, if no heading and no other block
lies between. A `console` block below the line `<!-- session -->` shows commands, after `$ `, and their output; they may
fail. Each line of an output must be printed, in this order and without others between:

- `...`, alone on a line, stands for any lines;
- the line `<!-- may vary: PIECE; PIECE -->` above the block lists pieces of it (a path, a version, a time) in whose
  place anything may be printed;
- the piece `last digits` lets every number with a decimal point differ by one unit in its last digit, which another
  processor can cause.

Spaces at the ends of lines, blank lines and lines of progress (`simtest: 3/20 ... (12 s)`) are ignored.
"""

import difflib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from studies.manual.blocks import Block

HEADING = re.compile(r"^#+ ", re.MULTILINE)
MAY_VARY = re.compile(r"<!-- may vary: (.*?) -->", re.DOTALL)
LAST_DIGITS = "last digits"
REST = "..."
PROGRESS = re.compile(r"simtest: \d+/\d+ .*\(\d.*\)")
NUMBER = re.compile(r"(?<![\w.])[+-]?\d+\.\d+(?![\w.]*\d)")
STYLE = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


@dataclass(frozen=True)
class Shown:
    """An output as a page shows it.

    `block`: the `text` block; `pieces`: pieces of it in whose place anything may be printed; `last_digits`: whether
    numbers may differ by one unit in their last digit.
    """

    block: Block
    pieces: tuple[str, ...] = ()
    last_digits: bool = False


def with_outputs(blocks: Sequence[Block]) -> Iterator[tuple[Block, Shown | None]]:
    """Yield each block that runs, with its output where the page shows it."""
    for block, following in pairwise([*blocks, None]):
        if block is not None and block.is_session:
            printed = [line for line in block.code.splitlines() if not line.startswith("$ ")]
            yield block, _shown(replace(block, code="\n".join(printed)))
        elif block is not None and block.runs:
            shows = following is not None and following.language == "text" and not HEADING.search(following.above)
            yield block, _shown(following) if shows and following is not None else None


def _shown(block: Block) -> Shown:
    marks = MAY_VARY.findall(block.above)
    pieces = [piece.strip() for mark in marks for piece in " ".join(mark.split()).split(";") if piece.strip()]
    return Shown(block, tuple(piece for piece in pieces if piece != LAST_DIGITS), LAST_DIGITS in pieces)


def difference(shown: Shown, printed: str) -> str | None:
    """Return how a printed output differs from the one shown, as a unified diff; None where it is as shown.

    A piece that may vary but does not stand in the block is a difference too.
    """
    missing = [piece for piece in shown.pieces if piece not in shown.block.code]
    if missing:
        return f"may vary: {missing[0]!r} does not stand in the block"
    expected, given = _lines(shown.block.code), _lines(STYLE.sub("", printed))
    if _follows(expected, given, shown):
        return None
    return "\n".join(difflib.unified_diff(expected, given, "shown", "printed", lineterm=""))


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.splitlines() if line.strip() and not PROGRESS.fullmatch(line.rstrip())]


def _follows(expected: list[str], given: list[str], shown: Shown) -> bool:
    """Return whether the lines given are those expected, with any lines in place of `...`."""
    if not expected:
        return not given
    if expected[0] == REST:
        return any(_follows(expected[1:], given[start:], shown) for start in range(len(given) + 1))
    return bool(given) and _is_line(expected[0], given[0], shown) and _follows(expected[1:], given[1:], shown)


def _is_line(expected: str, given: str, shown: Shown) -> bool:
    """Return whether a line is as expected, but for the pieces and digits that may vary."""
    # The longest piece first: it may hold another one, and numbers.
    pieces = [re.escape(piece) for piece in sorted(shown.pieces, key=len, reverse=True)]
    varying = [*pieces, f"(?P<number>{NUMBER.pattern})"] if shown.last_digits else pieces
    pattern, numbers, end = "", [], 0
    for match in re.finditer("|".join(varying), expected) if varying else ():
        number = match.groupdict().get("number")
        numbers += [number] if number else []
        pattern += re.escape(expected[end : match.start()]) + (f"({NUMBER.pattern})" if number else ".*?")
        end = match.end()
    found = re.fullmatch(pattern + re.escape(expected[end:]), given)
    return found is not None and all(map(_is_near, numbers, found.groups()))


def _is_near(expected: str, given: str) -> bool:
    """Return whether two numbers have as many decimals and differ by at most one unit in the last one."""
    decimals = len(expected.partition(".")[2])
    unit = 10.0**-decimals
    return len(given.partition(".")[2]) == decimals and math.fabs(float(expected) - float(given)) < 1.5 * unit
