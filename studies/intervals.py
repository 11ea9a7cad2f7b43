"""How often the intervals that the package prints hold what they are of, where highlights of a frame are alike.

``python -m studies.intervals --draws 2000`` draws 5, 10 and 40 frames of 1, 5 and 20 highlights, with normal and with
exponential errors, the deviation that a frame's highlights share being 0 to 2 times that of each alone. It prints, in
per cent of the draws, how often each interval holds its true value, how often a pair of equal methods is called
unequal, and the median width of the intervals of shares and medians over that of an exact one (of one highlight a
frame, which are independent: Clopper and Pearson's, and that between two values in order).
"""

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import polars as pl
from scipy import stats

from simtest.dataset.scoring.dense.score import joined_figures
from simtest.nightly.contrasts import paired, unit_sums, unpaired
from simtest.nightly.quantities import Quantity
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.statistics import Interval, mean_interval, median_interval, share_interval

FRAMES, HIGHLIGHTS, EFFECTS = (5, 10, 40), (1, 5, 20), (0.0, 0.5, 1.0, 2.0)

SHARES = (0.95, 0.8)
"""True shares, such as that of the regions that hold the true normal."""

NULL_PAIR = "equal pair"

MEANS = ("mean", NULL_PAIR, "other pair", "dense mean", "dense median", "nightly equal pair", "nightly other pair",
         "nightly unpaired")  # fmt: skip
"""Intervals of means and kin. In the other pair one method alone has an error that a frame's highlights share."""

SHARES_AND_MEDIANS = ("share 95 %", "share 80 %", "median")

_LIFT = 20.0
"""Added where means are taken for those of angles, which are not negative."""

_MANY = 200_000
"""Values that tell the true medians and shares."""


@dataclass(frozen=True)
class Cell:
    """What is drawn: so many frames of so many highlights, the frame's deviation over that of each highlight."""

    skewed: bool
    frames: int
    highlights: int
    effect: float

    @property
    def few(self) -> bool:
        """Whether the frames are so few that bounds are wider."""
        return self.frames == min(FRAMES)

    def errors(self, rng: np.random.Generator, frames: int, effect: float) -> Array:
        """Draw errors of mean 0, shape (frames, highlights)."""
        draw, mean = (rng.standard_exponential, 1) if self.skewed else (rng.standard_normal, 0)
        return np.asarray(effect * (draw((frames, 1)) - mean) + draw((frames, self.highlights)) - mean)


@dataclass
class Measured:
    """How often an interval held in so many draws, and the median of its width over that of the exact one."""

    held: int = 0
    draws: int = 0
    width: float = np.nan

    @property
    def share(self) -> float:
        """Share of the draws."""
        return self.held / self.draws


def every_cell() -> Iterator[Cell]:
    """Yield all cells."""
    yield from itertools.starmap(Cell, itertools.product((False, True), FRAMES, HIGHLIGHTS, EFFECTS))


def measure(cell: Cell, draws: int, groups: IntArray | None = None) -> dict[str, Measured]:
    """Return how often each interval holds its true value, by its name; the cell is the seed.

    `groups` in place of the number of each highlight's frame is a negative control.
    """
    rng = np.random.default_rng([cell.skewed, cell.frames, cell.highlights, int(10 * cell.effect)])
    own = np.repeat(np.arange(cell.frames), cell.highlights) if groups is None else groups
    many = cell.errors(rng, _MANY // cell.highlights, cell.effect)
    middle, of_frames = float(np.median(many)), float(np.median(np.median(many, axis=1)))
    limits = np.quantile(many, SHARES)
    found: dict[str, Measured] = {name: Measured() for name in (*MEANS, *SHARES_AND_MEDIANS)}
    widths: dict[str, list[float]] = {name: [] for name in SHARES_AND_MEDIANS}

    def note(name: str, interval: Interval, true: float, exact: tuple[float, float] | None = None) -> None:
        low, high = interval
        assert low is not None
        assert high is not None
        found[name].held += low <= true <= high
        found[name].draws += 1
        if exact is not None and exact[1] > exact[0]:
            widths[name].append((high - low) / (exact[1] - exact[0]))

    drawn = []
    for _ in range(draws):
        frames = cell.errors(rng, cell.frames, cell.effect)
        errors, equal, other = (
            each.ravel() for each in (frames, *(cell.errors(rng, cell.frames, effect) for effect in (cell.effect, 0.0)))
        )
        drawn.append((errors, equal, other))
        note("mean", mean_interval(errors, own), 0.0)
        note(NULL_PAIR, mean_interval(errors - equal, own), 0.0)
        note("other pair", mean_interval(errors - other, own), 0.0)
        note("median", median_interval(errors, own), middle, _exact_median(frames[:, 0]))
        for share, limit in zip(SHARES, limits, strict=True):
            exact = _exact_share(int(np.count_nonzero(frames[:, 0] < limit)), cell.frames)
            note(f"share {100 * share:.0f} %", share_interval(errors < limit, own), share, exact)
        rows = [{"n": len(f), "n_unanswered": 0, "mean": _LIFT + f.mean(), "median": np.median(f)} for f in frames]
        told = joined_figures(rows, np.arange(cell.frames), np.zeros(cell.frames, dtype=int))["ci95"]
        note("dense mean", told["mean"], _LIFT)
        note("dense median", told["median"], of_frames)
    for name, low, high in _nightly(np.array(drawn), own):
        found[name].held += int(np.count_nonzero((low <= 0) & (high >= 0)))
        found[name].draws += len(low)
    for name, ratios in widths.items():
        found[name].width = float(np.median(ratios)) if ratios else np.nan
    return found


@cache
def _exact_share(hits: int, n: int) -> tuple[float, float]:
    interval = stats.binomtest(hits, n).proportion_ci(method="exact")
    return float(interval.low), float(interval.high)


@cache
def _outer(n: int) -> int:
    """Return the place in order of the value below which the median lies in at most 2.5 % of draws."""
    # Of five values the least and the largest hold it in 94 % alone.
    return max(int(stats.binom.ppf(0.025, n, 0.5)), 1)


def _exact_median(values: Array) -> tuple[float, float]:
    """Return the two of independent values in order between which their median lies."""
    ordered, k = np.sort(values), _outer(len(values))
    return float(ordered[k - 1]), float(ordered[-k])


def _nightly(drawn: Array, own: IntArray) -> Iterator[tuple[str, Array, Array]]:
    """Yield the ends of the nightly run's intervals of differences of errors, shape (draws, 3, N); a draw is a cell."""
    draws, _, count = drawn.shape
    keys = {"cell": np.repeat(np.arange(draws), count), "quantity": "mean_deg", "realisation": np.tile(own, draws)}
    quantity, (errors, equal, other) = Quantity("deg", 0.02, 0.002), drawn.swapaxes(0, 1).reshape(3, -1)
    for name, values in (("nightly equal pair", equal), ("nightly other pair", other)):
        found = paired(unit_sums(pl.DataFrame({**keys, "baseline": errors, "tonight": values})), quantity)
        yield name, found.low, found.high
    before, after = (unit_sums(pl.DataFrame({**keys, "value": values})) for values in (errors, equal))
    found = unpaired(before, after, quantity)
    yield "nightly unpaired", found.low, found.high


def main() -> None:
    """Print the table, and the extremes of its columns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--draws", type=int, default=2000, help="of each cell (default 2000)")
    draws = parser.parse_args().draws
    names = (*MEANS, *SHARES_AND_MEDIANS)
    print(f"| errors | frames | highlights | effect | {' | '.join(names)} | equal pair called unequal |")
    print("|---" * (len(names) + 5) + "|")
    table: dict[Cell, dict[str, Measured]] = {}
    for cell in every_cell():
        found = table[cell] = measure(cell, draws)
        shown = [
            f"{100 * each.share:.1f}" + ("" if np.isnan(each.width) else f" ({each.width:.2f})")
            for each in found.values()
        ]
        kind, unequal = "skewed" if cell.skewed else "normal", 100 * (1 - found[NULL_PAIR].share)
        print(f"| {kind} | {cell.frames} | {cell.highlights} | {cell.effect:g} | {' | '.join(shown)} | {unequal:.1f} |",
              flush=True)  # fmt: skip
    for few, head in ((True, "5 frames"), (False, "10 and 40 frames")):
        own = [found for cell, found in table.items() if cell.few == few]
        print(f"\n{head}:")
        for name in names:
            shares = [100 * found[name].share for found in own]
            print(f"- {name}: {min(shares):.1f} to {max(shares):.1f} %, {np.mean(shares):.1f} % in the mean")


if __name__ == "__main__":
    main()
