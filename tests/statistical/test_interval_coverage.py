"""Coverage of the intervals that the package prints, where highlights of a frame are alike.

Frames of 1, 5 and 20 highlights are drawn, with normal and with exponential errors, the deviation that a frame's
highlights share being 0 to 2 times that of each alone. Bounds are those of the coverage itself. A cell fails where its
share of so many draws lies outside of them by more than chance, at the level `ALPHA` for all cells and intervals
together (Bonferroni). All cells of a kind together are held to the bounds themselves.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import polars as pl
import pytest
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

LIFT = 20.0
"""Added where means are taken for those of angles, which are not negative."""

MANY = 200_000
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
    """How often an interval held its true value in so many draws."""

    held: int = 0
    draws: int = 0

    @property
    def share(self) -> float:
        """Share of the draws."""
        return self.held / self.draws


def measure(cell: Cell, draws: int, groups: IntArray | None = None) -> dict[str, Measured]:
    """Return how often each interval holds its true value, by its name; the cell is the seed.

    `groups` in place of the number of each highlight's frame is a negative control.
    """
    rng = np.random.default_rng([cell.skewed, cell.frames, cell.highlights, int(10 * cell.effect)])
    own = np.repeat(np.arange(cell.frames), cell.highlights) if groups is None else groups
    many = cell.errors(rng, MANY // cell.highlights, cell.effect)
    middle, of_frames = float(np.median(many)), float(np.median(np.median(many, axis=1)))
    limits = np.quantile(many, SHARES)
    found: dict[str, Measured] = {name: Measured() for name in (*MEANS, *SHARES_AND_MEDIANS)}

    def note(name: str, interval: Interval, true: float) -> None:
        low, high = interval
        assert low is not None
        assert high is not None
        found[name].held += low <= true <= high
        found[name].draws += 1

    drawn = []
    for _ in range(draws):
        frames = cell.errors(rng, cell.frames, cell.effect)
        errors = frames.ravel()
        equal, other = (cell.errors(rng, cell.frames, effect).ravel() for effect in (cell.effect, 0.0))
        drawn.append((errors, equal, other))
        note("mean", mean_interval(errors, own), 0.0)
        note(NULL_PAIR, mean_interval(errors - equal, own), 0.0)
        note("other pair", mean_interval(errors - other, own), 0.0)
        note("median", median_interval(errors, own), middle)
        for share, limit in zip(SHARES, limits, strict=True):
            note(f"share {100 * share:.0f} %", share_interval(errors < limit, own), share)
        rows = [{"n": len(f), "n_unanswered": 0, "mean": LIFT + f.mean(), "median": np.median(f)} for f in frames]
        told = joined_figures(rows, np.arange(cell.frames), np.zeros(cell.frames, dtype=int))["ci95"]
        note("dense mean", told["mean"], LIFT)
        note("dense median", told["median"], of_frames)
    for name, low, high in nightly_ends(np.array(drawn), own):
        found[name].held += int(np.count_nonzero((low <= 0) & (high >= 0)))
        found[name].draws += len(low)
    return found


def nightly_ends(drawn: Array, own: IntArray) -> Iterator[tuple[str, Array, Array]]:
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


ALPHA = 0.01

SOME = [
    Cell(skewed, frames, highlights, effect)
    for skewed, frames in itertools.product((False, True), (5, 10, 40))
    for highlights, effect in ((1, 0.0), (20, 2.0))
]
"""The corners: one highlight a frame, and twenty that are nearly all alike."""


def bounds(name: str, cell: Cell) -> tuple[float, float]:
    if name in SHARES_AND_MEDIANS:
        return (0.90 if cell.few else 0.93), 1.0
    return (0.91, 0.98) if cell.few else (0.93, 0.97)


def outside(found, level):
    """Return the cells and intervals whose coverage lies outside of its bounds by more than chance."""
    beyond = []
    for cell, intervals in found.items():
        for name, each in intervals.items():
            low, high = bounds(name, cell)
            below = stats.binom.cdf(each.held, each.draws, low)
            above = stats.binom.sf(each.held - 1, each.draws, high)
            if min(below, above) < level:
                beyond.append((cell, name, each.share))
    return beyond


def check(found):
    level = ALPHA / sum(map(len, found.values()))
    assert not outside(found, level)
    for few in (True, False):
        own = [intervals for cell, intervals in found.items() if cell.few == few]
        cell = next(cell for cell in found if cell.few == few)
        for name in (*MEANS, *SHARES_AND_MEDIANS):
            low, high = bounds(name, cell)
            assert low <= np.mean([intervals[name].share for intervals in own]) <= high, name
        unequal = 1 - np.mean([intervals[NULL_PAIR].share for intervals in own])
        assert unequal <= 0.07


def test_intervals_hold_what_they_are_of_at_the_corners():
    check({cell: measure(cell, 250) for cell in SOME})


@pytest.mark.slow
def test_intervals_hold_what_they_are_of():
    cells = itertools.starmap(Cell, itertools.product((False, True), FRAMES, HIGHLIGHTS, EFFECTS))
    check({cell: measure(cell, 1000) for cell in cells})


def test_highlights_taken_as_independent_hold_far_too_little():
    """The negative control: of 20 highlights of a frame, each taken as a frame of its own."""
    cell = Cell(skewed=False, frames=10, highlights=20, effect=2.0)
    found = measure(cell, 100, groups=np.arange(200))
    for name in ("mean", NULL_PAIR, "share 95 %", "share 80 %", "median", "nightly equal pair"):
        assert found[name].share < 0.6, name
    # The dense figures are of frames whatever is taken for one here.
    assert {name for _, name, _ in outside({cell: found}, ALPHA)} >= {"mean", NULL_PAIR, "nightly unpaired", "median"}


def test_students_interval_holds_too_little_of_few_skewed_errors():
    """The second control: without the correction for skewness of ten exponential errors 90 % are held."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(4000):
        values = rng.standard_exponential(10)
        held += abs(values.mean() - 1) <= stats.t.ppf(0.975, 9) * values.std(ddof=1) / np.sqrt(10)
    assert stats.binom.cdf(held, 4000, 0.93) < ALPHA
