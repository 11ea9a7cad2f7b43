"""Intervals of the distance between sets of frames, on planted scenes whose distance is known in closed form."""

import math
from statistics import NormalDist

import numpy as np
import pytest

from simtest.realism.compare import distances
from simtest.reconstruction.statistics import COLUMNS, STATISTICS

SINGLE = {s.columns[0].name for s in STATISTICS if len(s.columns) == 1}
CALLS = 20
"""Of ten statistics with one column each: 200 draws."""

SIGMA = 0.6
"""Of the logarithm of skewed values."""


def normal(rng, distance):
    """Return a scene's value; the spread of a normal distribution is 2 / sqrt(pi) deviations."""
    return distance * 2 / math.sqrt(math.pi) + rng.standard_normal(1)


def skewed(rng, distance):
    """Return a scene's value; the spread of a log-normal distribution is its mean times Gini's coefficient, twice."""
    gini = 2 * NormalDist().cdf(SIGMA / math.sqrt(2)) - 1
    return (1 + 2 * gini * distance) * np.exp(SIGMA * rng.standard_normal(1))


def drawn(kind, distance, count):
    """Return the distances of many pairs of sets of so many scenes a side."""
    rng, found = np.random.default_rng(count), []
    for _ in range(CALLS):
        sides = [{str(i): {name: kind(rng, d) for name in COLUMNS} for i in range(count)} for d in (0.0, distance)]
        found += [d for d in distances(*sides) if d.statistic.columns[0].name in SINGLE]
    return found


@pytest.mark.parametrize("kind", [normal, skewed])
@pytest.mark.parametrize("count", [5, *(pytest.param(n, marks=pytest.mark.ci) for n in (10, 30))])
@pytest.mark.parametrize(("distance", "least"), [(0.0, 0.91), (0.5, 0.91), (1.0, 0.91), (2.5, 0.91)])
def test_the_interval_of_a_distance_holds_it(kind, count, distance, least):
    found = drawn(kind, distance, count)
    share = np.mean([d.interval[0] <= distance <= d.interval[1] for d in found])
    far = np.mean([d.verdict == "far" for d in found])
    width = np.median([d.interval[1] - d.interval[0] for d in found])
    print(f"{kind.__name__} {count} scenes, distance {distance}: covered {share:.0%}, far {far:.1%}, width {width:.2f}")
    assert share >= least
    if distance <= 1:
        # At 1 the interval's lower end decides; its own share is 2.5 %.
        assert far <= (0.05 if distance == 1 else 0.01)


def test_a_clear_difference_is_far():
    assert np.mean([d.verdict == "far" for d in drawn(normal, 4.0, 10)]) > 0.8
    assert np.mean([d.verdict == "far" for d in drawn(normal, 8.0, 5)]) > 0.5
