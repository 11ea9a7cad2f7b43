"""How processor time grows with triangles, pixels, highlights and rows: exponents of power laws.

`python -m benchmarks growth` prints the table of docs/measured/performance.md. Each piece of work is done at five sizes
or more, which span a factor of 16 or more. The sizes take turns, so that a slow spell of the machine hits all of them
alike. The exponent is the slope of log time over log size. A piece that has a fixed cost grows slowly at small sizes
and only then as it must, so the exponent over the upper half of the sizes is given too, and the larger of both must
keep the limit.
"""

import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.growth_pieces import Piece, pieces
from benchmarks.measuring import Figure, print_markdown

ROUNDS = 3
LIMIT = 1.05
STUDENT = {3: 12.71, 4: 4.303, 5: 3.182, 6: 2.776, 7: 2.571, 8: 2.447}
"""97.5 % points of Student's t for a line through so many points."""


@dataclass(frozen=True)
class Growth:
    """Exponent of a power law, with the half width of its interval at 95 %."""

    exponent: float
    half_width: float


def exponent(sizes: Sequence[float], times: Sequence[float]) -> Growth:
    """Fit log time over log size by a line.

    `sizes`, `times`: at least three of each, above 0.
    """
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(times, float))
    x -= x.mean()
    slope = float(x @ y / (x @ x))
    left = y - y.mean() - slope * x
    spread = math.sqrt(float(left @ left) / (len(x) - 2) / float(x @ x))
    return Growth(slope, STUDENT[len(x)] * spread)


def measure(works: Mapping[float, Callable[[], object]], rounds: int) -> list[float]:
    """Return the median processor time of each size's work, s, measured in turns after one call each."""
    times: dict[float, list[float]] = {size: [] for size in works}
    for work in works.values():
        work()
    for _ in range(rounds):
        for size, work in works.items():
            # A short piece is repeated: the clock of the processor ticks too coarsely for it.
            start, count = time.process_time(), 0
            while count == 0 or time.process_time() - start < 0.05:
                work()
                count += 1
            times[size].append((time.process_time() - start) / count)
    return [statistics.median(own) for own in times.values()]


@dataclass(frozen=True)
class Grown:
    """A piece of work that was measured at all its sizes: processor times, s, and exponents.

    `whole`, `upper`: over all sizes, and over the largest three.
    """

    piece: Piece
    sizes: list[float]
    times: list[float]
    whole: Growth
    upper: Growth

    @property
    def row(self) -> list[str]:
        """Return the row of the manual's table."""
        sizes, times = ((f"{ends[0]:,.4g}", f"{ends[-1]:,.4g}") for ends in (self.sizes, [1e3 * s for s in self.times]))
        whole = f"{self.whole.exponent:.2f} ± {self.whole.half_width:.2f}"
        return [self.piece.name, self.piece.axis, " to ".join(sizes), " to ".join(times), whole,
                f"{self.upper.exponent:.2f}"]  # fmt: skip

    @property
    def figure(self) -> Figure:
        """The larger of both exponents beside its limit."""
        value = max(self.whole.exponent, self.upper.exponent)
        _, _, sizes, times, whole, upper = self.row
        about = f"{sizes} {self.piece.axis}: {times} ms; {whole} over all sizes, {upper} over the largest three"
        return Figure(f"{self.piece.name}, {self.piece.axis}", value, LIMIT, unit="", about=about)


HEAD = ["work", "of", "from, to", "ms of processor", "exponent, all sizes", "largest three"]


def figures() -> list[Figure]:
    """Measure all pieces, and print the manual's table."""
    grown = []
    for piece in pieces():
        grown.append(grow(piece))
        # It takes long.
        print(f"growth: {grown[-1].figure.name}: {grown[-1].figure.value:.2f}", file=sys.stderr, flush=True)
    print_markdown([HEAD, *(one.row for one in grown)])
    return [one.figure for one in grown]


def grow(piece: Piece, rounds: int = ROUNDS) -> Grown:
    """Measure one piece of work at all its sizes, and fit its exponents."""
    with piece.opened() as works:
        sizes = list(works)
        if len(sizes) < 5 or max(sizes) < 16 * min(sizes):
            raise ValueError(f"{piece.name}: needs five sizes and a factor of 16, got {sizes}")
        times = measure(works, rounds)
    return Grown(piece, sizes, times, exponent(sizes, times), exponent(sizes[-3:], times[-3:]))
