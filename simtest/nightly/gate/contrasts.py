"""One-sided tests of "worse by more than the margin", of many cells at once: a studentised mean with Student's tail.

Resampling cannot reach the levels that a family of hundreds of tests asks for (1e-5 and less) with the ten or twenty
units of a setting: signs of ten differences have 2^10 patterns. Student's tail can, and docs/gallery/gate_measured.md
has its measured error rates. A mean of rows is a ratio of sums over units; its variance is that of the units' residuals
about it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl
from scipy import stats

from simtest.nightly.gate.pairing_units import GROUP
from simtest.nightly.gate.quantities import Quantity
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import CONFIDENCE, reach


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


def margin_of(quantity: Quantity, baseline: Array) -> Array:
    """Return the margins at some baselines: the larger of the relative and the absolute one."""
    return np.maximum(quantity.relative * baseline, quantity.absolute)


def tail(estimate: Array, deviation: Array, freedom: Array) -> Array:
    """Return the chance of so large an estimate where its mean is 0; NaN without a degree of freedom.

    Without variance the chance is 0 above 0, 1 below it, and a half at 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = np.where(
            deviation > 0, estimate / deviation, np.where(estimate > 0, np.inf, np.where(estimate < 0, -np.inf, 0.0))
        )
    usable = freedom >= 1
    return np.where(usable, stats.t.sf(statistic, np.where(usable, freedom, 1.0)), np.nan)


def half_width(deviation: Array | float, freedom: Array) -> Array:
    """Return half of the 95 % interval's width; NaN without a degree of freedom."""
    usable = freedom >= 1
    quantile = stats.t.ppf((1 + CONFIDENCE) / 2, np.where(usable, freedom, 1.0))
    return np.where(usable, quantile * deviation, np.nan)


def _margins(quantity: Quantity) -> list[tuple[float, float]]:
    """Return the parts of the margin as (share, shift), each of which must be exceeded."""
    return [(quantity.relative, 0.0), (0.0, quantity.absolute)] if quantity.relative else [(0.0, quantity.absolute)]


def paired(sums: pl.DataFrame, quantity: Quantity) -> Outcomes:
    """Test pairs, by their sums of one quantity; see `simtest.nightly.gate.pairing_units.paired_sums`."""
    s = {name: sums[name].to_numpy().astype(float) for name in sums.columns if name not in ("cell", "quantity")}
    units, rows = s["units"], s["rows"]
    baseline, difference = s["x"] / rows, s["d"] / rows
    margin = margin_of(quantity, baseline)
    # Two invented units, one that harms tonight alone and one that harmed before alone.
    m = dict(s)
    if quantity.span:
        size = rows / units
        most = quantity.span * size
        m |= {"units": units + 2, "rows": rows + 2 * size, "x": s["x"] + most, "nn": s["nn"] + 2 * size**2}
        m |= {"dd": s["dd"] + 2 * most**2, "xx": s["xx"] + most**2, "dx": s["dx"] - most**2}
        m |= {"xn": s["xn"] + most * size, "ddn": s["ddn"] + 2 * most**2 * size, "nnn": s["nnn"] + 2 * size**3}

    def contrast(share: float, shift: float, sign: float) -> tuple[Array, Array]:
        """Compute mean and standard error of sign d - share x - shift."""
        mean = (sign * m["d"] - share * m["x"]) / m["rows"] - shift
        # The residual of a unit is sign d - share x - c n.
        c = mean + shift
        squares = (
            m["dd"] + share**2 * m["xx"] + c**2 * m["nn"]
            - 2 * (sign * share * m["dx"] + sign * c * m["dn"] - share * c * m["xn"])
        )  # fmt: skip
        count = m["units"]
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = np.maximum(squares, 0.0) / (count * (count - 1)) / (m["rows"] / count) ** 2
        return mean, np.sqrt(variance)

    # Worse (sign 1) and better (-1); the larger p-value of both parts of the margin counts.
    freedom = units - 1
    p = [
        np.max([tail(*contrast(share, shift, sign), freedom) for share, shift in _margins(quantity)], axis=0)
        for sign in (1.0, -1.0)
    ]
    centre, deviation = contrast(0.0, 0.0, 1.0)
    below, above = reach(half_width(1.0, freedom), _skewness(_third(m, centre, "d"), deviation))
    return Outcomes(
        units.astype(np.int64), baseline, baseline + difference, difference, centre - below * deviation,
        centre + above * deviation, margin, p[0], p[1], s["largest"] <= margin, deviation, freedom,
    )  # fmt: skip


def unpaired(before: pl.DataFrame, after: pl.DataFrame, quantity: Quantity) -> Outcomes:
    """Test two runs of different seeds, versions or numbers of units by Welch's statistic.

    `before` and `after` are `simtest.nightly.gate.pairing_units.sums` of one quantity, of the same cells in the same
    order. `within` of the outcomes is false: there are no pairs.
    """
    x, y = (_Arm.of(table, quantity.span) for table in (before, after))
    margin = margin_of(quantity, x.shown)

    def test(worse: _Arm, better: _Arm, share_of: _Arm) -> Array:
        """Compute the p-value of the first arm's mean being above the second's by no more than the margin."""
        found = []
        for share, shift in _margins(quantity):
            # The share is the baseline's, whichever arm that is.
            a, b = (1 - share if arm is share_of and arm is worse else 1.0 for arm in (worse, better))
            b = 1 + share if better is share_of else b
            found.append(tail(a * worse.mean - b * better.mean - shift, *_welch(worse, better, a, b)))
        return np.asarray(np.max(found, axis=0))

    deviation, freedom = _welch(x, y, 1.0, 1.0)
    below, above = reach(half_width(1.0, freedom), _skewness(y.third - x.third, deviation))
    centre = y.mean - x.mean
    return Outcomes(
        np.minimum(x.units, y.units).astype(np.int64), x.shown, y.shown, y.shown - x.shown,
        centre - below * deviation, centre + above * deviation, margin, test(y, x, x), test(x, y, x),
        np.zeros(len(margin), dtype=bool), deviation, freedom,
    )  # fmt: skip


@dataclass(frozen=True)
class _Arm:
    """One run's means in N cells: `shown` as they are, `mean` with the invented units."""

    units: Array
    shown: Array
    mean: Array
    variance: Array
    third: Array  # third central moment of the mean
    freedom: Array

    @classmethod
    def of(cls, table: pl.DataFrame, span: float) -> "_Arm":
        m = {
            name: values.to_numpy().astype(float) for name, values in table.select(pl.exclude(GROUP)).to_dict().items()
        }
        units, rows, x, xx, nn, xn = (m[name] for name in ("units", "rows", "x", "xx", "nn", "xn"))
        shown, seen = x / rows, units
        if span:
            # One that harms and one that does not [Agresti and Caffo 2000].
            size = rows / units
            most = span * size
            x, xx, nn, xn = x + most, xx + most**2, nn + 2 * size**2, xn + most * size
            rows, units = rows + 2 * size, units + 2
            m |= {"units": units, "rows": rows, "nnn": m["nnn"] + 2 * size**3}
            m |= {"xxx": m["xxx"] + most**3, "xxn": m["xxn"] + most**2 * size, "xnn": m["xnn"] + most * size**2}
        mean = x / rows
        # Of the units' residuals about the mean
        with np.errstate(divide="ignore", invalid="ignore"):
            squares = np.maximum(xx - 2 * mean * xn + mean**2 * nn, 0.0)
            # A constant's squares cancel to rounding.
            squares = np.where(squares > 1e-13 * xx, squares, 0.0)
            variance = squares / (units * (units - 1)) / (rows / units) ** 2
        return cls(seen, shown, mean, variance, _third(m, mean, "x"), seen - 1)


def _third(m: Mapping[str, Array], mean: Array, of: str) -> Array:
    """Return the third central moment of a mean of rows."""
    cubes = (
        m[of * 3] - 3 * mean * m[f"{of}{of}n"] + 3 * mean**2 * m[f"{of}nn"] - mean**3 * m["nnn"]
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(cubes / m["rows"] ** 3)


def _skewness(third: Array, deviation: Array) -> Array:
    """Return the skewness of an estimate; 0 where it has no variance."""
    return np.where(deviation > 0, third / np.where(deviation > 0, deviation, 1.0) ** 3, 0.0)


def _welch(first: _Arm, second: _Arm, a: float, b: float) -> tuple[Array, Array]:
    """Compute the standard error of a times one mean less b times the other, and its degrees of freedom."""
    v, w = a**2 * first.variance, b**2 * second.variance
    least = np.minimum(first.freedom, second.freedom)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = (v + w) ** 2 / (v**2 / first.freedom + w**2 / second.freedom)
    # Without variance in both there is no ratio of variances; with one unit in one there is no variance.
    freedom = np.where(np.isfinite(freedom) & (v + w > 0), freedom, least)
    return np.sqrt(v + w), np.where(least >= 1, freedom, 0.0)
