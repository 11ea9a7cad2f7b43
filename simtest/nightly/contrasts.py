"""One-sided tests of "worse by more than the margin", of many cells at once: a studentised mean with Student's tail.

Resampling cannot reach the levels that a family of hundreds of tests asks for (1e-5 and less) with the ten or twenty
units of a setting: signs of ten differences have 2^10 patterns. Student's tail can, and docs/measured/gate.md
has its measured error rates. A unit is a realisation, a scene or a pose, whatever number of highlights it shows: a mean
of rows is a ratio of sums over units, and its variance is that of the units' residuals about it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.nightly.quantities import Quantity
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import reach, student_quantile

UNIT = ("cell", "quantity", "realisation")
"""Number of the cell and name of the quantity, a test each, and the number of the unit."""

MIN_UNITS = 5
"""Where each cell has as many units, cells are pooled by their own standard errors."""

MIN_CELLS = 10
"""Where not, but there are as many cells, the cells themselves are the sample."""

MOST_SHARE = 2.0
"""A difference over the mean of both runs is no larger."""

_ROUNDING = 1e-26
"""Squares of residuals that are a smaller share of those of the values are rounding: the values are all alike."""


@dataclass(frozen=True)
class Outcomes:
    """Results of the tests of one quantity in N cells, in its harm, shape (N,); NaN where a test cannot be made."""

    n: IntArray  # units; of the smaller run where they are not paired
    baseline: Array  # mean
    tonight: Array
    difference: Array  # tonight less the baseline
    low: Array  # its 95 % interval
    high: Array
    margin: Array  # its harmless size
    worse: Array  # p-value of "no worse than by the margin"
    better: Array  # p-value of "no better than by the margin"
    within: Mask  # whether no pair differs by more than the margin
    deviation: Array  # standard error of the difference
    freedom: Array  # its degrees of freedom; 0 where there is no standard error

    def __getitem__(self, cells: slice | list[int]) -> "Outcomes":
        return Outcomes(**{name: values[cells] for name, values in vars(self).items()})


def unit_sums(values: pl.DataFrame) -> pl.DataFrame:
    """Add up rows by unit, in the order of the units: equal inputs have equal sums to the last bit.

    `values` holds `UNIT`, and `value` of one run, or `baseline` and `tonight`: a row a pair. Returns `UNIT`, `n` (its
    rows), `x` (sum of the values, or of the baseline's), and of pairs `d` (sum of the differences) and `largest`, the
    largest difference of a row.
    """
    if "value" in values.columns:
        terms = {"x": pl.col("value").sum()}
    else:
        d = pl.col("tonight") - pl.col("baseline")
        terms = {"x": pl.col("baseline").sum(), "d": d.sum(), "largest": d.abs().max()}
    return values.group_by(UNIT, maintain_order=True).agg(n=pl.len().cast(pl.Float64), **terms)


class _Units:
    """The units of one quantity in N cells: `cells` by number, `totals` by cell; `sums` have invented units as well.

    `invented` are the values of two units as shares of the quantity's span, by name of the sums: each cell gets them
    where the quantity has a span, with as many rows as its units have on average.
    """

    def __init__(self, units: pl.DataFrame, span: float, **invented: tuple[float, float]) -> None:
        names = ("n", *invented)
        numbers, self.cell = np.unique(units["cell"].to_numpy(), return_inverse=True)
        self.sums = {name: units[name].to_numpy() for name in names}
        self.real = np.bincount(self.cell, minlength=len(numbers)).astype(float)
        # Added up one by one, so that equal units have equal sums to the last bit, wherever they lie in memory.
        self.totals = {name: self._add(values) for name, values in self.sums.items()}
        if span:
            size = self.totals["n"] / self.real
            for i in (0, 1):
                added = {"n": size, **{name: shares[i] * span * size for name, shares in invented.items()}}
                self.cell = np.concatenate([self.cell, np.arange(len(numbers))])
                self.sums = {name: np.concatenate([self.sums[name], added[name]]) for name in names}

    def shown(self, name: str) -> Array:
        """Return the mean of a sum over the rows, without invented units."""
        return self.totals[name] / self.totals["n"]

    def mean(self, value: Array) -> tuple[Array, Array, Array]:
        """Return the mean over the rows of what units sum up to, its variance and its third central moment."""
        count, rows = self._add(np.ones(len(value))), self._add(self.sums["n"])
        mean = self._add(value) / rows
        rest = value - mean[self.cell] * self.sums["n"]
        squares = self._add(rest**2)
        squares = np.where(squares > _ROUNDING * self._add(value**2), squares, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = squares / (count * (count - 1)) / (rows / count) ** 2
        return mean, variance, self._add(rest**3) / rows**3

    def _add(self, value: Array) -> Array:
        return np.asarray(np.bincount(self.cell, value, len(self.real)), dtype=float)


def margin_of(quantity: Quantity, baseline: Array) -> Array:
    """Return the margins at some baselines: the larger of the relative and the absolute one."""
    return np.maximum(quantity.relative * baseline, quantity.absolute)


def _margins(quantity: Quantity) -> list[tuple[float, float]]:
    """Return the parts of the margin as (share, shift), each of which must be exceeded: the larger p-value counts."""
    return [(quantity.relative, 0.0), (0.0, quantity.absolute)] if quantity.relative else [(0.0, quantity.absolute)]


def _tail(estimate: Array, deviation: Array, freedom: Array) -> Array:
    """Return the chance of so large an estimate where its mean is 0; NaN without a degree of freedom.

    Without variance the chance is 0 above 0, 1 below it, and a half at 0.
    """
    from scipy.special import stdtr

    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(
            deviation > 0, estimate / deviation, np.where(estimate > 0, np.inf, np.where(estimate < 0, -np.inf, 0.0))
        )
    usable = freedom >= 1
    return np.where(usable, stdtr(np.where(usable, freedom, 1.0), -statistic), np.nan)


def _half_width(deviation: Array | float, freedom: Array) -> Array:
    """Return half of the 95 % interval's width; NaN without a degree of freedom."""
    usable = freedom >= 1
    return np.where(usable, student_quantile(np.where(usable, freedom, 1.0)) * deviation, np.nan)


def _interval(centre: Array, deviation: Array, third: Array, freedom: Array) -> tuple[Array, Array]:
    """Return the ends of the 95 % interval of an estimate with a third central moment."""
    with np.errstate(divide="ignore", invalid="ignore"):
        skewness = np.where(deviation > 0, third / deviation**3, 0.0)
    below, above = reach(_half_width(1.0, freedom), skewness)
    return centre - below * deviation, centre + above * deviation


def paired(units: pl.DataFrame, quantity: Quantity) -> Outcomes:
    """Test pairs, by the `unit_sums` of one quantity; the outcomes are in the order of the cells' numbers."""
    # Of the invented units one harms tonight alone, one harmed before alone.
    held = _Units(units, quantity.span, x=(0.0, 1.0), d=(1.0, -1.0))
    baseline, difference, freedom = held.shown("x"), held.shown("d"), held.real - 1
    margin = margin_of(quantity, baseline)
    centre, variance, third = held.mean(held.sums["d"])
    p = []
    for sign in (1.0, -1.0):
        parts = []
        for share, shift in _margins(quantity):
            mean, spread, _ = held.mean(sign * held.sums["d"] - share * held.sums["x"])
            parts.append(_tail(mean - shift, np.sqrt(spread), freedom))
        p.append(np.max(parts, axis=0))
    deviation = np.sqrt(variance)
    largest = units.group_by("cell").agg(pl.col("largest").max()).sort("cell")["largest"].to_numpy()
    return Outcomes(
        held.real.astype(np.int64), baseline, baseline + difference, difference,
        *_interval(centre, deviation, third, freedom), margin, p[0], p[1], largest <= margin, deviation, freedom,
    )  # fmt: skip


class _Arm(NamedTuple):
    """One run's means in N cells: `shown` as they are, `mean` with the invented units."""

    units: Array
    shown: Array
    mean: Array
    variance: Array
    third: Array


def unpaired(before: pl.DataFrame, after: pl.DataFrame, quantity: Quantity) -> Outcomes:
    """Test two runs of different seeds, versions or numbers of units by Welch's statistic.

    `before` and `after` are `unit_sums` of one quantity, of the same cells. `within` of the outcomes is false: there
    are no pairs.
    """
    # Of the invented units one harms and one does not [Agresti and Caffo 2000].
    arms = [_Units(table, quantity.span, x=(1.0, 0.0)) for table in (before, after)]
    x, y = (_Arm(arm.real, arm.shown("x"), *arm.mean(arm.sums["x"])) for arm in arms)

    def test(first: _Arm, second: _Arm, parts: Sequence[tuple[float, float, float]]) -> Array:
        """Compute the p-value of a times the first mean being above b times the second by no more than the shift."""
        found = [_tail(a * first.mean - b * second.mean - shift, *_welch(first, second, a, b)) for a, b, shift in parts]
        return np.asarray(np.max(found, axis=0))

    # The share is the baseline's, whichever arm that is.
    worse = test(y, x, [(1.0, 1 + share, shift) for share, shift in _margins(quantity)])
    better = test(x, y, [(1 - share, 1.0, shift) for share, shift in _margins(quantity)])
    deviation, freedom = _welch(x, y, 1.0, 1.0)
    margin = margin_of(quantity, x.shown)
    return Outcomes(
        np.minimum(x.units, y.units).astype(np.int64), x.shown, y.shown, y.shown - x.shown,
        *_interval(y.mean - x.mean, deviation, y.third - x.third, freedom), margin, worse, better,
        np.zeros(len(margin), dtype=bool), deviation, freedom,
    )  # fmt: skip


def _welch(first: _Arm, second: _Arm, a: float, b: float) -> tuple[Array, Array]:
    """Compute the standard error of a times one mean less b times the other, and its degrees of freedom."""
    v, w = a**2 * first.variance, b**2 * second.variance
    least = np.minimum(first.units, second.units) - 1
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = (v + w) ** 2 / (v**2 / (first.units - 1) + w**2 / (second.units - 1))
    # Without variance in both there is no ratio of variances; with one unit in one there is no variance.
    freedom = np.where(np.isfinite(freedom) & (v + w > 0), freedom, least)
    return np.sqrt(v + w), np.where(least >= 1, freedom, 0.0)


def pooled(found: Outcomes, quantity: Quantity) -> Outcomes:
    """Test many cells at once, with outcomes of shape (1,): what is too small to show in one setting shows in many.

    Each cell contributes one number, its difference over the mean of the two runs' figures: symmetric about 0 where
    nothing changed, and never beyond 2, however heavy the errors' tails. A sum of many such shares cannot hang on one.
    Of relative quantities the baseline is 1, the margin the relative one, which is the absolute margin where a mean is
    so small that this is the larger. p-values are NaN where the cells are too few, with too few units.
    """
    shares, deviations = found.difference, found.deviation
    margin = quantity.relative or quantity.absolute
    if quantity.relative:
        scale = np.maximum((found.baseline + found.tonight) / 2, quantity.scale_floor)
        shares, deviations = shares / scale, deviations / scale
    span = MOST_SHARE if quantity.relative and quantity.span else quantity.span
    mean, deviation, freedom = _mean_of_cells(shares, deviations, found, span)
    half = _half_width(deviation, freedom)
    baseline = np.ones(1) if quantity.relative else np.array([found.baseline.mean()])
    return Outcomes(
        np.array([int(found.n.sum())]), baseline, baseline + mean, mean, mean - half, mean + half,
        np.array([margin]), _tail(mean - margin, deviation, freedom), _tail(-mean - margin, deviation, freedom),
        np.array([bool(found.within.all())]), deviation, freedom,
    )  # fmt: skip


def _mean_of_cells(shares: Array, deviations: Array, found: Outcomes, span: float) -> tuple[Array, Array, Array]:
    """Compute the mean over cells, its standard error and degrees of freedom, each of shape (1,)."""
    count = len(shares)
    mean = np.array([shares.mean()])
    # The cells' own standard errors, with Welch and Satterthwaite's degrees of freedom.
    if (found.n >= MIN_UNITS).all():
        variances = deviations**2 / count**2
        whole = variances.sum()
        freedom = whole**2 / np.sum(variances**2 / found.freedom) if whole > 0 else float(found.freedom.min())
        return mean, np.array([np.sqrt(whole)]), np.array([freedom])
    if count < MIN_CELLS:
        return mean, np.array([np.nan]), np.zeros(1)
    # The cells as the sample, with two invented units, as in each cell.
    residuals = shares - mean
    if span:
        extra = span * float(np.mean(1 / found.n))
        residuals = np.append(residuals, [extra, -extra])
    deviation = np.sqrt(np.sum(residuals**2) / (count - 1) / count)
    return mean, np.array([deviation]), np.array([count - 1.0])


def holm(p: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> Array:
    """Correct p-values for the size of their family by Holm's step-down procedure [H79], section 2 and 4.

    Rejecting those of at most alpha keeps the chance of any false rejection at alpha, under arbitrary dependence. The
    weights are each test's share of alpha, positive; only their ratios count. Ours, since scipy has no Holm correction
    and that of statsmodels has no weights.
    """
    own = np.asarray(p, dtype=float)
    share = np.ones_like(own) if weights is None else np.asarray(weights, dtype=float)
    order = np.argsort(own / share, kind="stable")
    # Weight that is left at each step: the test's own and that of all less significant ones.
    left = np.cumsum(share[order][::-1])[::-1]
    stepped = np.maximum.accumulate(own[order] * left / share[order])
    corrected = np.empty_like(own)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected
