"""Rules that hold among the columns of a run's results, whatever its errors are.

Each counts the rows that break it. Formulas are written anew in NumPy and polars, so that a column that was computed
otherwise does not agree with the other columns. Columns that a table lacks break no rule.
"""

from collections.abc import Callable

import numpy as np
import polars as pl
from scipy import stats

from simtest.nightly.quantities import ANSWERED, IS_TRUE, REGION_DEG
from simtest.nightly.records import CELL
from simtest.runtime.arrays import Array, Mask
from simtest.validation.columns import BUDGET_COLUMNS, SCHEMA
from simtest.validation.statistics import motion_rows

ANGLE_DEG = 1e-5
"""Rounding of an angle between two unit normals that are kept in double precision, with room."""

SHARE = 1e-6
"""The same of a ratio of sums."""

ZERO_DEG = 1e-9
"""No estimate from a picture of single precision is so near to the truth."""

FEW = 5
"""Answers of a cell, at least, of which not all may have the same axis ratio."""

MOTION_RATE = 0.04
"""Chance that one of the two signs of a highlight is wrong, at most: 2 % each (docs/howto/pictures.md)."""

ALPHA = 1e-4
"""Chance that signs at this rate break the rule. Measured rates lie far below it, and this level lets three highlights,
all wrong, break it."""


def broken_rules(rows: pl.DataFrame) -> dict[str, int]:
    """Count the rows that break a rule of `RULES`, by its name; rules that hold are left out."""
    missing = [pl.lit(None, dtype).alias(name) for name, dtype in SCHEMA.items() if name not in rows.columns]
    table = rows.with_columns(missing)
    return {name: int(mark.sum()) for name, check in RULES.items() if (mark := check(table)).any()}


def _vectors(table: pl.DataFrame, name: str) -> Array:
    return table.select(f"{name}_{axis}" for axis in "xyz").to_numpy().astype(float)


def _number(table: pl.DataFrame, name: str) -> Array:
    return table[name].cast(pl.Float64).to_numpy()


def _mask(table: pl.DataFrame, condition: pl.Expr) -> Mask:
    return np.asarray(table.select(condition.fill_null(False).alias("mark"))["mark"].to_numpy(), dtype=bool)


def _errors(table: pl.DataFrame) -> Mask:
    normal, truth = _vectors(table, "normal"), _vectors(table, "truth")
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(normal, truth), axis=1), (normal * truth).sum(axis=1)))
    # The truth that is stored is the fine surface's.
    fine = _number(table, "error_fine_deg")
    off = np.abs(fine - angle) > ANGLE_DEG
    stated = pl.when(pl.col("target") == "base").then("error_base_deg").otherwise("error_fine_deg")
    other = (pl.col("error_deg") - stated).abs() > ANGLE_DEG
    best = pl.col("error_oracle_deg") > pl.col("error_deg") + ANGLE_DEG
    return np.asarray(_mask(table, ANSWERED) & (off | _mask(table, other) | _mask(table, best)))


def _numbers(table: pl.DataFrame) -> Mask:
    return _mask(table, IS_TRUE & (pl.col("status") == "ok") & ~pl.col("error_deg").is_finite().fill_null(False))


def _zero(table: pl.DataFrame) -> Mask:
    return _mask(table, ANSWERED & (pl.col("error_deg").abs() < ZERO_DEG))


def _regions(table: pl.DataFrame) -> Mask:
    """Mark squared Mahalanobis distances that are not those of the covariance, of estimates of the fine surface."""
    normal, truth = _vectors(table, "normal"), _vectors(table, "truth")
    c11, c12, c22 = (_number(table, f"cov_{name}") for name in ("11", "12", "22"))
    first, second = _tangents(normal)
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v = (first * truth).sum(axis=1), (second * truth).sum(axis=1)
        sine = np.hypot(u, v)
        scale = np.where(sine > 0, np.arctan2(sine, (normal * truth).sum(axis=1)) / sine, 1.0)
        u, v = u * scale, v * scale
        determinant = c11 * c22 - c12**2
        distance = (c22 * u * u - 2 * c12 * u * v + c11 * v * v) / determinant
        stated = _number(table, "mahalanobis2")
        # A thin region loses digits in its determinant.
        loss = c11 * c22 / np.abs(determinant)
        apart = np.abs(distance - stated) > SHARE * (1 + loss) * np.maximum(np.abs(stated), SHARE)
    return np.asarray(_mask(table, ANSWERED & (pl.col("target") == "fine")) & (determinant > 0) & apart)


def _tangents(normal: Array) -> tuple[Array, Array]:
    """Return the tangent basis of unit normals [Duff et al. 2017]."""
    x, y, z = normal.T
    sign = np.where(z < 0, -1.0, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        a = -1.0 / (sign + z)
    b = x * y * a
    return (
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1),
        np.stack([b, sign + y * y * a, -y], axis=1),
    )


def _budget(table: pl.DataFrame) -> Mask:
    squares = pl.sum_horizontal(pl.col(name).fill_null(0.0) ** 2 for name in BUDGET_COLUMNS)
    stated = pl.any_horizontal(pl.col(BUDGET_COLUMNS).is_not_null())
    return _mask(table, ANSWERED & stated & ((squares.sqrt() - REGION_DEG).abs() > SHARE * REGION_DEG))


def _axis_ratio_law(table: pl.DataFrame) -> Mask:
    first, second = (1 + pl.col("kd_min")).abs(), (1 + pl.col("kd_max")).abs()
    law = pl.min_horizontal(first, second) / pl.max_horizontal(first, second)
    return _mask(table, IS_TRUE & ((law - pl.col("axis_ratio_law")).abs() > SHARE))


def _axis_ratios(table: pl.DataFrame) -> Mask:
    own = pl.when(ANSWERED).then("axis_ratio")
    # A scene without noise gives one ratio in all its realisations; so does a column that was filled with a constant.
    # Highlights that are round within their noise have the ratio 1, all of them.
    alike = ((own.n_unique() - own.is_null().any()).over(CELL) == 1) & (own < 1)
    many = (own.drop_nulls().len().over(CELL) >= FEW) & (pl.col("noise_sigma") > 0)
    outside = (own < 0) | (own > 1 + SHARE)
    return _mask(table, own.is_not_null() & (outside | (alike & many)))


def _gains(table: pl.DataFrame) -> Mask:
    low, high = 1 + pl.col("kd_min"), 1 + pl.col("kd_max")
    swapped = low.abs() > high.abs()
    smaller, larger = pl.when(swapped).then(high).otherwise(low), pl.when(swapped).then(low).otherwise(high)
    off = pl.max_horizontal((pl.col("gain_1") / smaller - 1).abs(), (pl.col("gain_2") / larger - 1).abs())
    stated = pl.col("gain_error")
    apart = off.is_finite() & ((off - stated).abs() > SHARE * pl.max_horizontal(off, pl.lit(1.0)))
    return _mask(table, ANSWERED & (apart | (pl.col("gain_oracle_error") > stated * (1 + SHARE) + SHARE)))


def _seeds(table: pl.DataFrame) -> Mask:
    frame = pl.struct("experiment", "setting", "realisation")
    return _mask(table, pl.col("seed").is_not_null() & (frame.n_unique().over("seed") > 1))


def _repeated(table: pl.DataFrame) -> Mask:
    """Mark noisy answers that are another frame's to the last bit."""
    noisy = ANSWERED & (pl.col("noise_sigma") > 0) & pl.col("normal_x").is_not_null()
    frame = pl.struct("setting", "realisation")
    key = ("experiment", "estimator", "normal_x", "normal_y", "normal_z", "error_deg")
    marked = table.select(*key, "setting", "realisation", noisy=noisy.fill_null(False))
    several = pl.when("noisy").then(frame).drop_nulls().n_unique().over(*key, "noisy") > 1
    return _mask(marked, pl.col("noisy") & several)


def _highlights(table: pl.DataFrame) -> Mask:
    """Mark true highlights that not every estimator of their setting has a row of, and those that have two rows."""
    setting = ("experiment", "label", "surface", "setting")
    key = (*setting, "realisation", "true_id")
    present = pl.col("estimator").n_unique().over(key) < pl.col("estimator").filter(IS_TRUE).n_unique().over(setting)
    twice = pl.len().over(*key, "estimator") > 1
    return _mask(table, IS_TRUE & (present | twice))


def _wrong_signs(table: pl.DataFrame) -> Mask:
    """Mark the wrong signs among those that motion told of a highlight where there are more than the method reports."""
    signs = [pl.col(f"motion_sign_{i}").fill_null(0) for i in (1, 2)]
    judged = motion_rows(table)
    if judged.is_empty():
        return np.zeros(0, dtype=bool)
    told = judged.filter((signs[0] != 0) | (signs[1] != 0))
    # The unit is the highlight, since its two signs hang together.
    wrong = _mask(told, pl.any_horizontal(sign * pl.col(f"motion_gain_{i}") < 0 for i, sign in enumerate(signs, 1)))
    silent = told.is_empty()
    return np.ones(1, dtype=bool) if silent else wrong & (wrong.sum() > stats.binom.isf(ALPHA, len(wrong), MOTION_RATE))


RULES: dict[str, Callable[[pl.DataFrame], Mask]] = {
    "error_deg, error_fine_deg and error_oracle_deg are those of the normals": _errors,
    "answers have errors that are finite numbers": _numbers,
    "no answer is exact": _zero,
    "mahalanobis2 is that of normal, truth and covariance": _regions,
    "the budget's parts add up to the covariance": _budget,
    "axis_ratio_law is that of kd_min and kd_max": _axis_ratio_law,
    "axis ratios lie in 0 to 1, and differ": _axis_ratios,
    "gain_error is that of gains and curvatures": _gains,
    "each frame has a seed of its own": _seeds,
    "no noisy answer repeats another of its experiment": _repeated,
    "all estimators of a frame have the same highlights, each once": _highlights,
    "signs that motion tells are right at the rate that it reports": _wrong_signs,
}
"""What marks the rows that break a rule, by what it says."""
