"""Which rows of two runs are pairs, and what a run lacks against another: whole cells, or highlights of one."""

from typing import NamedTuple

import polars as pl

from simtest.nightly.gate.contrasts import UNIT
from simtest.nightly.gate.quantities import PENALISED
from simtest.nightly.records import CELL

_FALSE = pl.col("quantity") == "false"


class Pairing(NamedTuple):
    """Cells whose frames have the same seeds in two runs."""

    cells: frozenset[int]  # all true highlights tonight are in the baseline, once: rows are compared pair by pair
    lost: pl.DataFrame  # `cell`, `before` (true highlights of the baseline), `kept`: where tonight lacks some of them


def pairing(before: pl.DataFrame, after: pl.DataFrame) -> Pairing:
    """Find the cells that are pairs, and those that have lost highlights, in the `harms` of two runs."""
    # Count each true highlight in both runs; each has one row of this quantity.
    key = ("cell", "realisation", "true_id", "seed")
    counted = [
        run.filter(pl.col("quantity") == PENALISED).group_by(key).agg(pl.len().alias(name))
        for run, name in ((before, "first"), (after, "second"))
    ]
    first, second = pl.col("first"), pl.col("second")
    counts = (
        counted[0]
        .join(counted[1], on=key, how="full", coalesce=True, nulls_equal=True)
        .with_columns(first.fill_null(0), second.fill_null(0))
        .group_by("cell")
        .agg(
            before=(first > 0).sum(), kept=((first > 0) & (second > 0)).sum(), gained=(first == 0).sum(),
            repeated=((first > 1) | (second > 1)).any(),
        )
    )  # fmt: skip
    # Compare the frames' seeds. A frame without a highlight has rows only where something was found in it.
    frames = [run.filter(_FALSE).select("cell", "realisation", "seed") for run in (before, after)]
    both = frames[0].join(frames[1], on=("cell", "realisation"), suffix="_2")
    moved = set(both.filter(pl.col("seed").ne_missing(pl.col("seed_2")))["cell"].to_list())
    # Realisations of other numbers are other realisations: nothing of them is lost.
    fewer = pl.col("kept") < pl.col("before")
    lost = fewer & pl.col("cell").is_in(list(set(both["cell"].to_list()) - moved))
    unequal = counts.filter((pl.col("gained") > 0) | pl.col("repeated") | (fewer & ~lost))
    every = set(frames[0]["cell"].to_list()) & set(frames[1]["cell"].to_list())
    return Pairing(
        frozenset(every - set(unequal["cell"].to_list()) - moved), counts.filter(lost).select("cell", "before", "kept")
    )


def pairs(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Join the `harms` of two runs to pairs: `UNIT`, `baseline`, `tonight`; a row where both runs have a value."""
    first, second = before.rename({"value": "baseline"}), after.rename({"value": "tonight"})
    rows = first.filter(~_FALSE).join(second.filter(~_FALSE), on=(*UNIT, "true_id"), maintain_order="left")
    # A frame with highlights that has no row at all tonight is lost: it is not one without false detections.
    frame = ("cell", "realisation")
    lost = before.filter(~_FALSE).join(after, on=frame, how="anti")
    frames = first.filter(_FALSE).join(lost, on=frame, how="anti", maintain_order="left")
    frames = frames.join(second.filter(_FALSE), on=UNIT, how="full", coalesce=True, maintain_order="left_right")
    frames = frames.with_columns(pl.col("baseline", "tonight").fill_null(0.0))
    return pl.concat([table.select(*UNIT, "baseline", "tonight") for table in (rows, frames)])


def frames_taken(first: pl.DataFrame, second: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return how many frames were taken of some cells, the fewer of two runs: `cell`, `frames`.

    Cells of which a run does not know it are left out. `cells` numbers the names of the cells as `cell`.
    """
    held = [
        run.filter(pl.col("quantity") == "frames").select(*CELL, pl.col("value").alias(name))
        for run, name in ((first, "before"), (second, "after"))
    ]
    found = cells.join(held[0], on=CELL).join(held[1], on=CELL)
    return found.select("cell", frames=pl.min_horizontal("before", "after").cast(pl.Int64))


def with_all_frames(values: pl.DataFrame, frames: pl.DataFrame, *rows: pl.DataFrame) -> pl.DataFrame:
    """Add a value of 0 for the false detections of each frame that has no row.

    Parameters
    ----------
    values : polars.DataFrame
        `UNIT`, and numbers by run.
    frames : polars.DataFrame
        See `frames_taken`.
    rows : polars.DataFrame
        `harms` that hold all frames with rows.
    """
    held = values.filter(_FALSE).select("cell").unique()
    # Realisations of a choice (0, 2, 4) are no count: which frames have no row is then not known.
    for table in rows:
        last = table.group_by("cell").agg(last=pl.col("realisation").max())
        beyond = frames.join(last, on="cell").filter(pl.col("last") >= pl.col("frames"))
        frames = frames.join(beyond, on="cell", how="anti", maintain_order="left")
    numbered = frames.join(held, on="cell", how="semi").select("cell", realisation=pl.int_ranges("frames"))
    numbered = numbered.explode("realisation").drop_nulls().cast({"realisation": values.schema["realisation"]})
    for table in rows:
        numbered = numbered.join(table, on=("cell", "realisation"), how="anti", maintain_order="left")
    constants = {name: 0.0 for name in ("value", "baseline", "tonight") if name in values.columns}
    empty = numbered.with_columns(quantity=pl.lit("false"), **{name: pl.lit(v) for name, v in constants.items()})
    return pl.concat([values, empty], how="diagonal_relaxed") if empty.height else values


def digests(figures: pl.DataFrame) -> pl.DataFrame:
    """Return each cell's hash, in the order of the cells' names, and its number of true highlights, `highlights`."""
    counted = figures.filter(pl.col("quantity") == "n").select(*CELL, highlights="value").unique(CELL)
    return figures.select(*CELL, "digest").unique(CELL).join(counted, on=CELL, how="left").sort(CELL)


def missing_cells(baseline: pl.DataFrame, tonight: pl.DataFrame) -> pl.DataFrame:
    """Compare the cells that one of two runs lacks, by `n`: worse where tonight lacks them, else new; see `digests`."""
    zero, count = pl.lit(0.0), pl.col("highlights")
    # What vanishes is a regression until it is accepted; what is new is not.
    gone, new = (
        one.join(other, on=CELL, how="anti", maintain_order="left")
        for one, other in ((baseline, tonight), (tonight, baseline))
    )
    gone = gone.select(*CELL, baseline=count, tonight=zero, difference=-count, margin=zero, outcome=pl.lit("worse"))
    new = new.select(*CELL, tonight=count, outcome=pl.lit("new"))
    return pl.concat([gone, new], how="diagonal").with_columns(
        quantity=pl.lit("n"), unit=pl.lit(""), method=pl.lit("none")
    )


def lost_highlights(lost: pl.DataFrame, cells: pl.DataFrame, comparable: frozenset[int]) -> pl.DataFrame:
    """Compare the cells that have lost highlights of the baseline, by `n`; see `Pairing`.

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
