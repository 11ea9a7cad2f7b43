"""The quantities that the gate compares, each as a harm of every row: more is worse."""

from dataclasses import dataclass

import polars as pl
from scipy import stats

from simtest.nightly.gate.limits import Limits
from simtest.nightly.records import CELL
from simtest.validation.statistics import CONFIDENCE, PENALTY_DEG

COVERED = float(stats.chi2.ppf(CONFIDENCE, 2))
"""Squared Mahalanobis distance of the border of a 95 % region."""

WORST_RATIO = 1.0
"""A larger relative deviation of an axis ratio counts as this: near a law of 0 the ratio of the two means nothing."""

RESULT_COLUMNS = (
    "specularity", "true_id", "seed", "status", "error_deg", "mahalanobis2", "axis_ratio", "axis_ratio_law",
)  # fmt: skip
"""Columns that `compare` reads, beside those that name a row: cell and realisation."""

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

    @property
    def scale_floor(self) -> float:
        """Baseline at which both margins are equal; 0 where there is no relative one."""
        return self.absolute / self.relative if self.relative else 0.0


def quantities(limits: Limits) -> dict[str, Quantity]:
    """Return the compared quantities by name."""
    error = Quantity("deg", limits.relative, limits.absolute_deg)
    return {
        "mean_deg": error,
        PENALISED: Quantity("deg", limits.relative, limits.absolute_deg, span=PENALTY_DEG),
        "axis_ratio": Quantity("", limits.relative, limits.absolute_ratio),
        "unanswered": Quantity("", 0.0, limits.rate, span=1.0),
        "false": Quantity("a frame", 0.0, limits.rate, span=1.0),
        "coverage95": Quantity("", 0.0, limits.coverage, span=1.0, falls=True),
        "no_region": Quantity("", 0.0, limits.rate, span=1.0),
        "no_axis_ratio": Quantity("", 0.0, limits.rate, span=1.0),
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

HARMS: dict[str, pl.Expr] = {
    "mean_deg": pl.when(ANSWERED).then(pl.col("error_deg")),
    PENALISED: pl.when(ANSWERED).then(pl.col("error_deg")).when(IS_TRUE).then(PENALTY_DEG),
    "axis_ratio": RATIO_OFF,
    "unanswered": pl.when(IS_TRUE).then((~ANSWERED).cast(pl.Float64)),
    # Outside too: a distance that is no number or infinite, as in `simtest.validation.statistics.figures`.
    "coverage95": pl.when(ANSWERED & pl.col("mahalanobis2").is_not_null()).then(
        (~(pl.col("mahalanobis2").is_finite() & (pl.col("mahalanobis2") <= COVERED))).cast(pl.Float64)
    ),
    "no_region": pl.when(ANSWERED).then(pl.col("mahalanobis2").is_null().cast(pl.Float64)),
    "no_axis_ratio": pl.when(ANSWERED).then(RATIO_OFF.is_null().cast(pl.Float64)),
}
"""Harm of a row by quantity; null where the row has none. False detections are counted by frames instead."""

WHERE_MIXED = ("no_region", "no_axis_ratio")
"""Quantities that count what results leave unstated: compared where some results state it, and some do not."""

KEY = (*CELL, "realisation", "true_id", "seed")
"""Columns that name the row of a true highlight in two runs."""


def harms(rows: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Compute the harms in some cells: `cell`, `realisation`, `true_id`, `seed`, `quantity`, `value`.

    A row for each true highlight and quantity, and one for each frame's false detections, with a null `true_id`.
    `cells` numbers the names of the cells as `cell`; rows of others are left out.
    """
    own = rows.join(cells, on=CELL, how="inner", maintain_order="left")
    index = ["cell", "realisation", "true_id", "seed"]
    true = own.filter(IS_TRUE).select(*index, **HARMS)
    true = true.unpivot(list(HARMS), index=index, variable_name="quantity").drop_nulls("value")
    count = pl.col("true_id").is_null().sum().cast(pl.Float64)
    false = own.group_by("cell", "realisation", "seed", maintain_order=True).agg(
        pl.lit(None, own.schema["true_id"]).alias("true_id"), quantity=pl.lit("false"), value=count
    )
    return pl.concat([true, false.select(true.columns)])
