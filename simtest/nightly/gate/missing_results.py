"""Results that a run lacks against another: whole cells, or highlights of one; a regression until accepted."""

import polars as pl

from simtest.nightly.records import CELL


def digests(figures: pl.DataFrame) -> pl.DataFrame:
    """Return each cell's hash, in the order of the cells' names, and its number of true highlights, `highlights`."""
    counted = figures.filter(pl.col("quantity") == "n").select(*CELL, highlights="value").unique(CELL)
    return figures.select(*CELL, "digest").unique(CELL).join(counted, on=CELL, how="left").sort(CELL)


def missing_cells(baseline: pl.DataFrame, tonight: pl.DataFrame) -> pl.DataFrame:
    """Compare the cells that one of two runs lacks, by `n`: worse where tonight lacks them, else new; see `digests`."""
    zero, count = pl.lit(0.0), pl.col("highlights")
    # What vanishes is a regression until it is accepted; what is new is not.
    gone = _only_in(baseline, tonight).select(
        *CELL, baseline=count, tonight=zero, difference=-count, margin=zero, outcome=pl.lit("worse")
    )
    new = _only_in(tonight, baseline).select(*CELL, tonight=count, outcome=pl.lit("new"))
    return pl.concat([gone, new], how="diagonal").with_columns(
        quantity=pl.lit("n"), unit=pl.lit(""), method=pl.lit("none")
    )


def _only_in(first: pl.DataFrame, second: pl.DataFrame) -> pl.DataFrame:
    return first.join(second, on=CELL, how="anti", maintain_order="left")


def lost_highlights(lost: pl.DataFrame, cells: pl.DataFrame, comparable: frozenset[int]) -> pl.DataFrame:
    """Compare the cells that have lost highlights of the baseline, by `n`; see `simtest.nightly.gate.pairing.Pairing`.

    `cells` names the cells by their number. In `comparable` ones seeds mean the same in both runs; in others a loss is
    reported, and not judged.
    """
    before, kept = pl.col("before").cast(pl.Float64), pl.col("kept").cast(pl.Float64)
    judged = pl.col("cell").is_in(list(comparable))
    return lost.sort("cell").join(cells, on="cell", maintain_order="left").select(
        *CELL, quantity=pl.lit("n"), unit=pl.lit(""), method=pl.lit("paired"), baseline=before, tonight=kept,
        difference=kept - before, margin=pl.lit(0.0),
        outcome=pl.when(judged).then(pl.lit("worse")).otherwise(pl.lit("undecided")),
    )  # fmt: skip
