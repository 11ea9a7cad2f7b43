"""Ranks methods on the highlights that both of two answered; what one refuses or misses stands in columns of its own.

Frames are the independent units, as everywhere (`simtest.validation.paired`).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from simtest.runtime.statistics import Interval
from simtest.validation.paired import LEAST_FRAMES, Distinct, difference_interval
from simtest.validation.statistics import units

MATTERS_DEG = 0.01
"""A smaller difference between two methods decides nothing, ..."""

MATTERS_SHARE = 0.05
"""... nor one below this share of the better method's mean error."""


@dataclass(frozen=True)
class Pair:
    """Two methods over the highlights that both answered; errors in deg."""

    first: str
    second: str
    n: int  # highlights that both answered
    only_first: int  # highlights that one alone answered
    only_second: int
    mean_first: float | None  # over the n
    mean_second: float | None
    interval_deg: Interval  # 95 % interval of the first one's mean less the second one's
    first_nearer: int  # highlights where the first is nearer to the truth
    few: bool  # whether the frames that both answered are too few to rank by

    @property
    def difference_deg(self) -> float | None:
        """Mean error of the first less that of the second."""
        return None if self.mean_first is None or self.mean_second is None else self.mean_first - self.mean_second

    @property
    def ahead(self) -> str | None:
        """The one whose mean error is smaller by enough to matter, be it by chance."""
        if self.mean_first is None or self.mean_second is None:
            return None
        low, high = sorted((self.mean_first, self.mean_second))
        if high - low < max(MATTERS_DEG, MATTERS_SHARE * low):
            return None
        return self.first if self.mean_first < self.mean_second else self.second

    @property
    def better(self) -> str | None:
        """The one whose mean error is smaller by enough to matter, and by more than chance."""
        low, high = self.interval_deg
        return None if low is None or high is None or low <= 0 <= high else self.ahead

    def other(self, name: str) -> str:
        """Return the name of the other one."""
        return self.second if name == self.first else self.first


def compare(distinct: Distinct, names: Sequence[str]) -> list[Pair]:
    """Compare each two methods, by their errors side by side."""
    frames, settings = units(distinct.wide)
    certain = distinct.wide["setting"].is_in(list(distinct.copied)).to_numpy()
    errors = {name: distinct.wide[f"of {name}"].to_numpy().astype(float) for name in names}
    made = []
    for first, second in combinations(names, 2):
        answered, other = np.isfinite(errors[first]), np.isfinite(errors[second])
        both = answered & other
        a, b = errors[first][both], errors[second][both]
        mean_a, mean_b = (float(values.mean()) if len(values) else None for values in (a, b))
        interval = difference_interval(a - b, frames[both], settings[both], certain[both])
        few = not len(a) or 0 < len(np.unique(frames[both & ~certain])) < LEAST_FRAMES
        only = int(np.sum(answered & ~other)), int(np.sum(other & ~answered))
        made.append(Pair(first, second, len(a), *only, mean_a, mean_b, interval, int(np.sum(a < b)), few))
    return made


def best_of(pairs: Sequence[Pair], names: Sequence[str]) -> str:
    """Return the method that the fewest of the others are better than; of several, that the fewest are ahead of.

    Of several still, it is the first.
    """
    own = [pair for pair in pairs if pair.first in names and pair.second in names]
    worse = Counter(pair.other(pair.better) for pair in own if pair.better)
    behind = Counter(pair.other(pair.ahead) for pair in own if pair.ahead)
    return min(names, key=lambda name: (worse[name], behind[name]))
