"""Intervals of means, shares and medians of values in groups, the independent units; quantiles; root mean squares.

The group is the frame, or in a dataset the anatomy: highlights of one frame share its noise, its light and its surface.
Strata are what was chosen and not drawn, such as the settings of an experiment or the cases of a benchmark: the spread
between them is no chance. `studies/intervals.py` prints how often these intervals hold what they are of.
"""

import math
from statistics import NormalDist
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, IntArray

Interval = tuple[float | None, float | None]

_Freedom = TypeVar("_Freedom", float, Array)

CONFIDENCE = 0.95

NORMAL_QUANTILE = 1.959963984540054
"""What a normal variable stays below in 97.5 of 100."""

LEAST_GROUPS = 5
"""Groups that an interval of a median needs: the least and the largest of fewer do not hold it in 90 of 100."""

NO_VALUES: Array = np.empty(0)

_ROUNDING = 1e-6


def mean_interval(
    values: Array, groups: IntArray | None = None, strata: IntArray | None = None, counts: Array | None = None,
    others: Array = NO_VALUES,
) -> Interval:  # fmt: skip
    """Compute the 95 % interval of a mean of values, or of a ratio of sums.

    It is Student's, with the jackknife's deviation (`deviation_of_mean`) and the degrees of freedom of `freedom_of`,
    and reaches farther on the side to which the values are skewed (`reach`).

    Parameters
    ----------
    values : ndarray, shape (N,)
        What the mean is over.
    groups, strata : ndarray, shape (N,), optional
        Number of the group and of the stratum of each value; by default each is a group, and all are one stratum.
    counts : ndarray, shape (N,), optional
        How many values each one is the sum of, 0 or more; default 1.
    others : ndarray
        Further values that the mean is over, without spread.

    Returns
    -------
    (float or None, float or None)
        None where a single group holds values. Where each group has a stratum of its own, the spread between these has
        to do.
    """
    totals, counts, kinds = summed(values, groups, strata, counts)
    if np.count_nonzero(counts) < 2:
        return None, None
    mean = float((totals.sum() + others.sum()) / (counts.sum() + len(others)))
    deviation, skewness = _moments(totals, counts, kinds, others)
    below, above = reach(student_quantile(freedom_of(counts, kinds)), skewness)
    return mean - deviation * float(below), mean + deviation * float(above)


def share_interval(
    hits: Array, groups: IntArray | None = None, strata: IntArray | None = None, counts: Array | None = None
) -> tuple[float, float]:
    """Compute the 95 % interval of a share: Clopper and Pearson's of fewer values, as those of a group are alike.

    It is that of Korn and Graubard [Survey Methodology 24, 1998, 193], exact where each value is a group. Parameters as
    of `mean_interval`, the values 0 or 1, or with `counts` sums of these.
    """
    from scipy.special import betaincinv

    totals, counts, kinds = summed(hits, groups, strata, counts)
    effect, most = _design_effect(totals, counts, kinds)
    # Groups that hold the rarer kind tell how alike the values of a group are; two more are taken to be all alike.
    telling = min(np.count_nonzero(totals > 0), np.count_nonzero(totals < counts))
    n = float(counts.sum()) * (telling + 2) / (telling * effect + 2 * most)
    k, tail = n * float(totals.sum() / counts.sum()), (1 - CONFIDENCE) / 2
    low = float(betaincinv(k, n - k + 1, tail)) if k > _ROUNDING else 0.0
    return low, float(betaincinv(k + 1, n - k, 1 - tail)) if n - k > _ROUNDING else 1.0


def median_interval(values: Array, groups: IntArray | None = None, strata: IntArray | None = None) -> Interval:
    """Compute the 95 % interval of a median from that of the share below it [Woodruff, J. Am. Stat. Assoc. 47, 635].

    Parameters as of `mean_interval`. None with fewer than `LEAST_GROUPS` groups.
    """
    n = len(values)
    if not n or len(values if groups is None else np.unique(groups)) < LEAST_GROUPS:
        return None, None
    ordered = np.sort(values)

    def half(at: float, kinds: IntArray | None) -> float:
        # Half a value counts as below one that is equal.
        below = np.where(values == at, 0.5, values < at)
        effect, _ = _design_effect(*summed(below, groups, kinds, None))
        # One more value than there are: so that of six independent ones and more 95 to 97 % hold the median.
        return NORMAL_QUANTILE / 2 * math.sqrt(effect / (effect + n))

    def quantile(share: float) -> float:
        return float(np.interp(n * share - 0.5, np.arange(n), ordered))

    middle = float(np.median(values))
    if strata is None or np.ptp(strata) == 0:
        reached = half(middle, None)
        return quantile(0.5 - reached), quantile(0.5 + reached)
    # Where the median lies between two strata, the share below it does not vary, but that below the ends does.
    without = half(middle, None)
    low, high = (max(half(at, strata) for at in (middle, quantile(0.5 + side * without))) for side in (-1, 1))
    return quantile(0.5 - low), quantile(0.5 + high)


def summed(
    values: Array, groups: IntArray | None, strata: IntArray | None, counts: Array | None
) -> tuple[Array, Array, IntArray]:
    """Return sum and number of each group's values, and its stratum, numbered from 0."""
    totals = np.asarray(values, dtype=float)
    numbers = np.ones(len(values)) if counts is None else np.asarray(counts, dtype=float)
    kinds = np.zeros(len(values), dtype=int) if strata is None else np.unique(strata, return_inverse=True)[1]
    if groups is not None:
        _, first, own = np.unique(groups, return_index=True, return_inverse=True)
        totals, numbers = (np.asarray(np.bincount(own, each), dtype=float) for each in (totals, numbers))
        kinds = kinds[first]
    if len(kinds) and len(kinds) == kinds.max() + 1:
        # One group a stratum: no spread within any is seen, so that between them has to do.
        kinds = np.zeros_like(kinds)
    return totals, numbers, kinds


def deviation_of_mean(totals: Array, counts: Array, strata: IntArray, others: Array = NO_VALUES) -> float:
    """Compute the standard deviation of the mean of all values by the jackknife over groups.

    It leaves out one group of a stratum at a time, and the others of the stratum weigh more instead [Rao and Wu, J. Am.
    Stat. Assoc. 83, 1988, 231]. So it holds where the number of values varies from group to group. Groups that are
    alone in their stratum are taken to spread as the others do.

    Parameters
    ----------
    totals, counts : ndarray, shape (F,)
        Sum and number of the values of each group; 0 of a group without any.
    strata : ndarray of int, shape (F,)
        Number of the stratum of each, from 0.
    others : ndarray
        Further values that the mean is over, without spread. Where they differ from the mean of the groups', the number
        of values in each group moves the mean of all.
    """
    return _moments(totals, counts, strata, others)[0]


def _moments(totals: Array, counts: Array, strata: IntArray, others: Array) -> tuple[float, float]:
    """Return the mean's standard deviation and its skewness, by the jackknife."""
    size, fixed = np.bincount(strata)[strata], float(others.sum())
    mean = float((totals.sum() + fixed) / (counts.sum() + len(others)))
    off = (_without_each(totals, strata) + fixed) / (_without_each(counts, strata) + len(others)) - mean
    deviation = math.sqrt(float(np.sum((1 - 1 / size) * off**2)))
    if not deviation:
        return 0.0, 0.0
    third = -float(np.sum((1 - 1 / size) ** 3 * off**3))
    return deviation * math.sqrt(len(totals) / np.count_nonzero(size > 1)), third / deviation**3


def _without_each(values: Array, strata: IntArray) -> Array:
    """Return the sum of all values without each one; the others of its stratum weigh more."""
    size, own = np.bincount(strata)[strata], np.bincount(strata, values)[strata]
    # A value that is alone in its stratum stays: it shows no spread.
    return np.asarray(values.sum() + np.where(size > 1, (own - size * values) / np.maximum(size - 1, 1), 0.0))


def freedom_of(counts: Array, strata: IntArray) -> int:
    """Return the degrees of freedom of `deviation_of_mean`, fewer where few groups hold most of the values.

    They are (1 - S / F) (sum c^2)^2 / sum c^4, with c the number of values of each of the F groups, and S strata: what
    Satterthwaite's rule gives if each value spreads alike. At least 1.
    """
    weights = counts[np.bincount(strata)[strata] > 1] ** 2
    if not weights.any():
        return 1
    free = 1 - len(np.unique(strata)) / len(strata)
    return max(math.floor(free * float(weights.sum() ** 2 / (weights @ weights)) + _ROUNDING), 1)


def student_quantile(freedom: _Freedom) -> _Freedom:
    """Return what Student's t stays below in 97.5 of 100, of a number or an array of degrees of freedom."""
    from scipy.special import stdtrit

    return stdtrit(freedom, (1 + CONFIDENCE) / 2)


def bootstrap_interval(values: Array | float, samples: Array, groups: int) -> Array:
    """Return 95 % intervals of values, shape (2, ...), from those of resampled groups, shape (R, ...).

    Their quantiles about their median are moved to the value. Few groups resample too narrowly: the deviations are
    widened from a normal to Student's distribution.
    """
    share = (1 + CONFIDENCE) / 2
    wider = student_quantile(groups - 1) / NormalDist().inv_cdf(share) * np.sqrt(groups / (groups - 1))
    low, middle, high = np.quantile(samples, [1 - share, 0.5, share], axis=0)
    return np.stack([values + (low - middle) * wider, values + (high - middle) * wider])


def root_mean_square(values: Array) -> float | None:
    """Return the root mean square of values; None of none."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def weighted_quantile(values: Array, weights: Array, share: float) -> float:
    """Return the value below which a share, above 0, of the weight lies; NaN where no value is known."""
    known = np.isfinite(values) & (weights > 0)
    if not known.any():
        return math.nan
    order = np.argsort(values[known])
    below = np.cumsum(weights[known][order])
    return float(values[known][order][np.searchsorted(below, share * below[-1])])


def reach(t: npt.ArrayLike, skewness: npt.ArrayLike) -> tuple[Array, Array]:
    """Return how many standard deviations an interval reaches below and above a mean: Student's t, or more.

    Of ten exponential errors Student's interval holds the mean in 90 % alone. So an end lies where Hall's transform of
    the studentised error, T + a T^2 / 3 + a^2 T^3 / 27 + a / 6 of a mean with the skewness a, puts it where that is
    farther from the mean [J. R. Stat. Soc. B 54, 1992, 221].
    """
    t, a = np.asarray(t, dtype=float), np.asarray(skewness, dtype=float)
    # The inverse transform cancels where there is no skewness.
    is_skewed = np.abs(a) > _ROUNDING
    a = np.where(is_skewed, a, 1.0)
    ends = (sign * 3 / a * (np.cbrt(1 + a * (sign * t - a / 6)) - 1) for sign in (1, -1))
    below, above = (np.where(is_skewed, np.fmax(t, end), t) for end in ends)
    return below, above


def _design_effect(totals: Array, counts: Array, strata: IntArray) -> tuple[float, float]:
    """Return by how much groups and strata change the variance of a share, and the most that groups may enlarge it.

    That is where the values of each group are all alike; the least is where they are independent within the strata. Few
    groups tell their spread badly: the effect is larger as Student's t is wider.
    """
    n, share = float(counts.sum()), float(totals.sum() / counts.sum())
    most = float(counts @ counts) / n
    if not 0 < share < 1 or np.count_nonzero(counts) < 2:
        return most, most
    alone = n * share * (1 - share)
    sizes, hits = np.bincount(strata, counts), np.bincount(strata, totals)
    least = float(np.sum(hits * (1 - hits / np.maximum(sizes, 1)))) / alone
    wider = student_quantile(freedom_of(counts, strata)) / student_quantile(n - 1)
    effect = (deviation_of_mean(totals, counts, strata) * n * wider) ** 2 / alone
    return min(max(effect, least), most), most
