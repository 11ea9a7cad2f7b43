"""How processor time grows with triangles, pixels, highlights, rows and nights: exponents of power laws.

`python -m benchmarks growth` prints the table of docs/performance.md. Each piece of work is done at five sizes or more,
which span a factor of 16 or more. The sizes take turns, so that a slow spell of the machine hits all of them alike. The
exponent is the slope of log time over log size. A piece that has a fixed cost grows slowly at small sizes and only then
as it must, so the exponent over the upper half of the sizes is given too, and the larger of both must keep the limit.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.growth_pieces import Piece, pieces
from benchmarks.measuring import Figure

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

    Parameters
    ----------
    sizes, times : sequence of float
        At least three of each, above 0.
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


def figures() -> list[Figure]:
    """Measure all pieces."""
    return [figure(piece) for piece in pieces()]


def figure(piece: Piece, rounds: int = ROUNDS) -> Figure:
    """Measure one piece of work at all its sizes, and fit its exponents."""
    with piece.opened() as works:
        sizes = list(works)
        if len(sizes) < 5 or max(sizes) < 16 * min(sizes):
            raise ValueError(f"{piece.name}: needs five sizes and a factor of 16, got {sizes}")
        times = measure(works, rounds)
    whole, upper = exponent(sizes, times), exponent(sizes[-3:], times[-3:])
    about = f"{sizes[0]:.3g} to {sizes[-1]:.3g} {piece.axis}: {1e3 * times[0]:.3g} to {1e3 * times[-1]:.3g} ms; "
    about += (
        f"over all sizes {whole.exponent:.2f} ± {whole.half_width:.2f}, over the largest three {upper.exponent:.2f}"
    )
    return Figure(f"{piece.name}, {piece.axis}", max(whole.exponent, upper.exponent), LIMIT, unit="", about=about)
