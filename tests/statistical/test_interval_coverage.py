"""Coverage of the intervals that the package prints, where highlights of a frame are alike; levels are stated.

Bounds are those of the coverage itself. A cell fails where its share of so many draws lies outside of them by more than
chance, at the level `ALPHA` for all cells and intervals together (Bonferroni). All cells of a kind together are held to
the bounds themselves.
"""

from itertools import product

import numpy as np
import pytest
from scipy import stats

from studies.intervals import MEANS, NULL_PAIR, SHARES_AND_MEDIANS, Cell, every_cell, measure

ALPHA = 0.01

SOME = [
    Cell(skewed, frames, highlights, effect)
    for skewed, frames in product((False, True), (5, 10, 40))
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
    check({cell: measure(cell, 1000) for cell in every_cell()})


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
