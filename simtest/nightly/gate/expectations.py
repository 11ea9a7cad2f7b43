"""Figures that are judged without a test: canaries by their bounds, costs by intervals, the ladder by a margin."""

import polars as pl

from simtest.nightly.gate.limits import Limits
from simtest.nightly.records import CELL

_KEY = (*CELL, "quantity")
_VALUE, _BEFORE = pl.col("value"), pl.col("value_before")


def canaries(tonight: pl.DataFrame, baseline: pl.DataFrame | None) -> pl.DataFrame:
    """Compare canaries, with `low` and `high` as their bounds: worse where one is out of bounds, or missing tonight."""
    # A passed canary is compared with the baseline's value.
    sound = pl.when(_VALUE == _BEFORE).then(pl.lit("same")).when(_BEFORE.is_not_null()).then(pl.lit("equivalent"))
    passed = pl.when("passed").then(sound.otherwise(pl.lit("new"))).otherwise(pl.lit("worse"))
    return _both(tonight, baseline, "canary").select(*_compared(), pl.col("low", "high"), outcome=passed)


def costs(
    tonight: pl.DataFrame, baseline: pl.DataFrame | None, limits: Limits, same_machine: bool = True
) -> pl.DataFrame:
    """Compare costs: worse where tonight's whole interval lies beyond the baseline's and the margin.

    A figure without an interval is its own interval. Quantities whose name holds "memory" have the margin `memory` of
    the limits, all others `run_time`. Costs of different processors are shown and not judged.
    """
    # Margins and intervals
    of_memory = pl.col("quantity").str.contains("memory", literal=True)
    share = pl.when(of_memory).then(pl.lit(limits.memory)).otherwise(pl.lit(limits.run_time))
    low, high = pl.coalesce("low", "value"), pl.coalesce("high", "value")
    low_before, high_before = pl.coalesce("low_before", _BEFORE), pl.coalesce("high_before", _BEFORE)
    # The first that holds
    outcome = (
        pl.when(_BEFORE.is_null()).then(pl.lit("new"))
        .when(_VALUE.is_null()).then(pl.lit("gone"))
        .when(pl.lit(not same_machine)).then(pl.lit("undecided"))
        .when(_BEFORE == _VALUE).then(pl.lit("same"))
        .when(low > high_before * (1 + share)).then(pl.lit("worse"))
        .when(high < low_before * (1 - share)).then(pl.lit("better"))
        .when((_VALUE - _BEFORE).abs() <= share * _BEFORE).then(pl.lit("equivalent"))
        .otherwise(pl.lit("undecided"))
    )  # fmt: skip
    margin = pl.when(_VALUE.is_not_null()).then(share * _BEFORE)
    return _both(tonight, baseline, "cost").select(*_compared(), margin=margin, outcome=outcome)


def rungs(tonight: pl.DataFrame, baseline: pl.DataFrame, limits: Limits, same_versions: bool) -> pl.DataFrame:
    """Compare the error ladder's rungs, by value: worse where one rose beyond the margin, or is missing tonight.

    The ladder's seed is fixed, so that unchanged code gives its values again. With other versions of the packages the
    noise may be another: intervals must then lie apart as well.
    """
    margin = pl.max_horizontal(limits.relative * _BEFORE.abs(), pl.lit(limits.absolute_deg))
    difference = _VALUE - _BEFORE
    above, below = pl.col("low") > pl.col("high_before"), pl.col("high") < pl.col("low_before")
    apart = [pl.lit(True) if same_versions else side.fill_null(True) for side in (above, below)]
    outcome = (
        pl.when(_BEFORE.is_null()).then(pl.lit("new"))
        .when(_VALUE.is_null()).then(pl.lit("worse"))
        .when(_VALUE == _BEFORE).then(pl.lit("same"))
        .when((difference > margin) & apart[0]).then(pl.lit("worse"))
        .when((difference < -margin) & apart[1]).then(pl.lit("better"))
        .when(difference.abs() <= margin).then(pl.lit("equivalent"))
        .otherwise(pl.lit("undecided"))
    )  # fmt: skip
    found = _both(tonight, baseline, "ladder").filter(_VALUE.is_not_null() | _BEFORE.is_not_null())
    return found.select(*_compared(), margin=margin, outcome=outcome).with_columns(method=pl.lit("ladder"))


def _both(tonight: pl.DataFrame, baseline: pl.DataFrame | None, kind: str) -> pl.DataFrame:
    """Join the figures of a kind with the baseline's, `*_before`; values that are no number count as unknown."""
    numbers = pl.col("value", "low", "high").fill_nan(None)
    before = tonight.clear() if baseline is None else baseline
    before = before.filter(pl.col("kind") == kind).select(*_KEY, numbers.name.suffix("_before"))
    after = tonight.filter(pl.col("kind") == kind).with_columns(numbers)
    # A name that does not apply, such as the surface of a rung, is null.
    return after.join(before, on=_KEY, how="full", coalesce=True, nulls_equal=True, maintain_order="left_right")


def _compared() -> list[pl.Expr]:
    """Return the columns that comparisons of canaries and of costs share."""
    return [
        *map(pl.col, _KEY), pl.col("unit").fill_null(""), pl.lit("none").alias("method"), pl.col("n"),
        _BEFORE.alias("baseline"), _VALUE.alias("tonight"), (_VALUE - _BEFORE).alias("difference"),
    ]  # fmt: skip
