"""What each row of results counts as. Whoever counts rows counts these kinds, so that all counts agree and add up."""

import polars as pl

from simtest.conventions import ON_INSTRUMENT

KINDS = ("ok", "failed", "missed", "false", ON_INSTRUMENT, "in_spot")
"""A true highlight is answered ("ok"), failed or missed.

Any other row is a detection: on an instrument, in a visible spot of a relief that melts several glints or holds none,
or else a false detection.
"""


def row_kind(rows: pl.DataFrame) -> pl.Expr:
    """Return the kind of each row, one of `KINDS`; columns that `rows` lacks say nothing."""
    true, status = pl.col("true_id").is_not_null(), pl.col("status")
    on_instrument = pl.col(ON_INSTRUMENT).fill_null(False) if ON_INSTRUMENT in rows.columns else pl.lit(False)
    in_spot = pl.col("visible_id").is_not_null() if "visible_id" in rows.columns else pl.lit(False)
    return (
        pl.when(true & (status == "ok")).then(pl.lit("ok"))
        .when(true & (status == "missed")).then(pl.lit("missed"))
        .when(true).then(pl.lit("failed"))
        .when(on_instrument).then(pl.lit(ON_INSTRUMENT))
        .when(in_spot).then(pl.lit("in_spot"))
        .otherwise(pl.lit("false"))
    )  # fmt: skip


def is_false(rows: pl.DataFrame) -> pl.Expr:
    """Return which rows are false detections."""
    return row_kind(rows) == "false"


def counts(rows: pl.DataFrame) -> dict[str, pl.Expr]:
    """Return the number of rows of each kind, and of true highlights as "true", by name: for `DataFrame.group_by`."""
    kind = row_kind(rows)
    numbers = {name: (kind == name).sum() for name in KINDS}
    return {"true": pl.col("true_id").is_not_null().sum(), **numbers}
