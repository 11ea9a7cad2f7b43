"""The quantities that the gate tests, each as one number of a row: a harm, of which more is worse, or a level."""

from dataclasses import dataclass

import polars as pl
from scipy import stats

from simtest.conventions import MOTION, ON_INSTRUMENT
from simtest.nightly.gate.limits import Limits
from simtest.nightly.records import CELL
from simtest.runtime.statistics import CONFIDENCE
from simtest.validation.columns import BUDGET_COLUMNS
from simtest.validation.row_kinds import is_false
from simtest.validation.statistics import PENALTY_DEG

COVERED = float(stats.chi2.ppf(CONFIDENCE, 2))
"""Squared Mahalanobis distance of the border of a 95 % region."""

WORST_RATIO = 1.0
"""A larger relative deviation of an axis ratio or a gain counts as this: near a true value of 0 the ratio of the two
means nothing."""

OLDEST_COLUMNS = (
    "specularity", "true_id", "seed", "status", "error_deg", "mahalanobis2", "axis_ratio", "axis_ratio_law",
)  # fmt: skip
"""Columns that every baseline has, beside those that name a row: cell and realisation."""

RESULT_COLUMNS = (
    *OLDEST_COLUMNS, "flags", "target", "visible_id", "error_oracle_deg", "error_base_deg", "error_look_deg",
    "error_law_deg", "cov_11", "cov_22", "gain_error", "gain_oracle_error", "direction_error_deg", "eps_over_d",
    "peak_snr", "distance_mm", "kd_min", "kd_max", "normal_x", "normal_y", "normal_z", *BUDGET_COLUMNS,
)  # fmt: skip
"""Columns that `compare` reads, beside those that name a row: cell and realisation."""

OPTIONAL_COLUMNS: dict[str, pl.DataType] = {
    ON_INSTRUMENT: pl.Boolean(),
    **{f"motion_{kind}_{i}": pl.Float64() for kind in ("sign", "gain") for i in (1, 2)},
}
"""Columns that `compare` reads too, by type: results have them only where a scene has instruments, or further views."""

PENALISED = "mean_penalised_deg"
"""Mean error with `PENALTY_DEG` for unanswered highlights: every true highlight has a value."""


@dataclass(frozen=True)
class Quantity:
    """A compared quantity.

    `span` is the range of a row's harm, where most rows are at one of its ends: two invented units then keep
    small samples, which may all be alike by chance, from showing no variance. It is 0 where rows differ by nature.
    """

    unit: str
    relative: float  # margin as a share of the baseline
    absolute: float  # margin in the unit; the larger of the two counts
    span: float = 0.0
    falls: bool = False  # whether the figure shown is 1 less the harm: coverage is worse where it falls
    level: bool = False  # whether neither side is better: a change either way has to be explained

    @property
    def scale_floor(self) -> float:
        """Baseline at which both margins are equal; 0 where there is no relative one."""
        return self.absolute / self.relative if self.relative else 0.0


def quantities(limits: Limits) -> dict[str, Quantity]:
    """Return the compared quantities by name."""
    error = Quantity("deg", limits.relative, limits.absolute_deg)
    ratio = Quantity("", limits.relative, limits.absolute_ratio)
    share = Quantity("", 0.0, limits.rate, span=1.0)
    level_deg = Quantity("deg", limits.relative, limits.absolute_deg, level=True)
    return {
        "mean_deg": error,
        PENALISED: Quantity("deg", limits.relative, limits.absolute_deg, span=PENALTY_DEG),
        "oracle_deg": error,
        "base_deg": error,
        "look_deg": error,
        "law_deg": level_deg,
        "axis_ratio": ratio,
        "axis_ratio_level": Quantity("", limits.relative, limits.absolute_ratio, level=True),
        "gain_error": ratio,
        "gain_oracle_error": ratio,
        "direction_deg": error,
        "eps_over_d": Quantity("", limits.relative, limits.absolute_eps, level=True),
        "peak_snr": Quantity("", limits.relative, limits.absolute_snr, level=True),
        "region_deg": level_deg,
        "noise_part_deg": level_deg,
        "truth_in_region": Quantity("", 0.0, limits.coverage, level=True),
        "unanswered": share,
        "missed": Quantity("", 0.0, limits.rate, span=1.0, level=True),
        "false": Quantity("a frame", 0.0, limits.rate, span=1.0),
        "coverage95": Quantity("", 0.0, limits.coverage, span=1.0, falls=True),
        "no_region": share,
        "no_axis_ratio": share,
        "no_law": share,
        "flagged": Quantity("", 0.0, limits.rate, span=1.0, level=True),
        "wrong_sign": share,
    }


IS_TRUE = pl.col("true_id").is_not_null()

ANSWERED = IS_TRUE & (pl.col("status") == "ok") & pl.col("error_deg").is_finite().fill_null(False)
"""Rows of true highlights with a normal; a result whose error is no number counts as unanswered."""

RATIO_OFF = (
    pl.when(
        ANSWERED
        & pl.all_horizontal(pl.col("axis_ratio", "axis_ratio_law").is_finite())
        & (pl.col("axis_ratio_law") > 0)
    )
    .then((pl.col("axis_ratio") / pl.col("axis_ratio_law") - 1).abs().clip(upper_bound=WORST_RATIO))
    .otherwise(None)
)
"""Relative deviation of a result's axis ratio from the law."""

REGION_DEG = (pl.col("cov_11") + pl.col("cov_22")).sqrt().degrees()
"""Size of the stated uncertainty: the square root of the covariance's trace, deg."""


def _of_answers(value: pl.Expr) -> pl.Expr:
    return pl.when(ANSWERED & value.is_finite()).then(value)


_LAW = pl.col("error_law_deg")

_SIGNS = [pl.col(f"motion_sign_{i}").fill_null(0) for i in (1, 2)]
_TOLD = sum(((sign != 0).cast(pl.Float64) for sign in _SIGNS), pl.lit(0.0))
_WRONG = sum(
    ((sign * pl.col(f"motion_gain_{i}") < 0).fill_null(False).cast(pl.Float64) for i, sign in enumerate(_SIGNS, 1)),
    pl.lit(0.0),
)

HARMS: dict[str, pl.Expr] = {
    "mean_deg": pl.when(ANSWERED).then(pl.col("error_deg")),
    PENALISED: pl.when(ANSWERED).then(pl.col("error_deg")).when(IS_TRUE).then(PENALTY_DEG),
    "oracle_deg": _of_answers(pl.col("error_oracle_deg")),
    "base_deg": _of_answers(pl.col("error_base_deg")),
    "look_deg": _of_answers(pl.col("error_look_deg")),
    "law_deg": _of_answers(_LAW),
    "axis_ratio": RATIO_OFF,
    "axis_ratio_level": _of_answers(pl.col("axis_ratio")),
    "gain_error": _of_answers(pl.col("gain_error")).clip(upper_bound=WORST_RATIO),
    "gain_oracle_error": _of_answers(pl.col("gain_oracle_error")).clip(upper_bound=WORST_RATIO),
    "direction_deg": _of_answers(pl.col("direction_error_deg")),
    "eps_over_d": pl.when(IS_TRUE & pl.col("eps_over_d").is_finite()).then(pl.col("eps_over_d")),
    "peak_snr": pl.when(IS_TRUE & pl.col("peak_snr").is_finite()).then(pl.col("peak_snr")),
    "region_deg": _of_answers(REGION_DEG),
    "noise_part_deg": _of_answers(pl.col("budget_noise_deg")),
    # Uniform over 0 to 1 where regions are right; near 1 where they are too wide, near 0 where they are too narrow.
    "truth_in_region": _of_answers((-pl.col("mahalanobis2") / 2).exp()),
    "unanswered": pl.when(IS_TRUE).then((~ANSWERED).cast(pl.Float64)),
    "missed": pl.when(IS_TRUE).then((pl.col("status") == "missed").cast(pl.Float64)),
    # Outside too: a distance that is no number or infinite, as in `simtest.validation.statistics.figures`.
    "coverage95": pl.when(ANSWERED & pl.col("mahalanobis2").is_not_null()).then(
        (~(pl.col("mahalanobis2").is_finite() & (pl.col("mahalanobis2") <= COVERED))).cast(pl.Float64)
    ),
    "no_region": pl.when(ANSWERED).then(pl.col("mahalanobis2").is_null().cast(pl.Float64)),
    "no_axis_ratio": pl.when(ANSWERED).then(RATIO_OFF.is_null().cast(pl.Float64)),
    "no_law": pl.when(ANSWERED).then((~_LAW.is_finite().fill_null(False)).cast(pl.Float64)),
    "flagged": pl.when(ANSWERED).then((pl.col("flags").fill_null("") != "").cast(pl.Float64)),
    # Signs of curvatures that motion tells of a highlight: the wrong ones among them.
    "wrong_sign": pl.when(IS_TRUE & (pl.col("estimator") == MOTION) & (_TOLD > 0)).then(_WRONG / _TOLD),
}
"""Value of a row by quantity; null where the row has none. False detections are counted by frames instead."""

WHERE_MIXED = ("no_region", "no_axis_ratio", "no_law", "flagged")
"""Quantities that count what some results have and others lack: compared where both occur."""

SAME_AS = {
    PENALISED: "mean_deg", "oracle_deg": "mean_deg", "base_deg": "mean_deg", "look_deg": "mean_deg",
    "gain_oracle_error": "gain_error", "missed": "unanswered",
}  # fmt: skip
"""Quantities that are another one in most cells, where they would be tested twice."""

KEY = (*CELL, "realisation", "true_id", "seed")
"""Columns that name the row of a true highlight in two runs."""


def harms(rows: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Compute the values in some cells: `cell`, `realisation`, `true_id`, `seed`, `quantity`, `value`.

    A row for each true highlight and quantity, and one for each frame's false detections, with a null `true_id`.
    `cells` numbers the names of the cells as `cell`; rows of others are left out.
    """
    own = with_optional(rows).join(cells, on=CELL, how="inner", maintain_order="left")
    index = ["cell", "realisation", "true_id", "seed"]
    true = own.filter(IS_TRUE).select(*index, **HARMS)
    true = true.unpivot(list(HARMS), index=index, variable_name="quantity").drop_nulls("value")
    count = is_false(own).sum().cast(pl.Float64)
    false = own.group_by("cell", "realisation", "seed", maintain_order=True).agg(
        pl.lit(None, own.schema["true_id"]).alias("true_id"), quantity=pl.lit("false"), value=count
    )
    return pl.concat([true, false.select(true.columns)])


def with_optional(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows with the columns of `OPTIONAL_COLUMNS` that they lack, as null."""
    return rows.with_columns(
        pl.lit(None, dtype).alias(name) for name, dtype in OPTIONAL_COLUMNS.items() if name not in rows.columns
    )


def told_twice(rows: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return the quantities of `SAME_AS` that are the other one in all rows of a cell: `cell`, `quantity`."""
    own = with_optional(rows).join(cells, on=CELL, how="inner").filter(IS_TRUE).select("cell", **HARMS)
    same = [
        ((pl.col(name) - pl.col(other)).abs().fill_null(0.0) <= TWICE * (1 + pl.col(other).abs().fill_null(0.0))).all()
        .and_((pl.col(name).is_null() == pl.col(other).is_null()).all()).alias(name)
        for name, other in SAME_AS.items()
    ]  # fmt: skip
    found = own.group_by("cell").agg(same).unpivot(list(SAME_AS), index="cell", variable_name="quantity")
    return found.filter("value").select("cell", "quantity")


TWICE = 1e-6
"""Values of two quantities that differ by a smaller share are the same: a baseline keeps some in single precision."""
