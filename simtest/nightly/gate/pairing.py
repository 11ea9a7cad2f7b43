"""Which rows of two runs are pairs."""

from dataclasses import dataclass

import polars as pl

from simtest.nightly.gate.pairing_units import UNIT
from simtest.nightly.gate.quantities import HARMS, harms_of_frames, harms_of_rows
from simtest.nightly.records import CELL


@dataclass(frozen=True)
class Numbered:
    """One run's rows of the shared cells.

    Parameters
    ----------
    rows, frames : polars.DataFrame
        See `harms_of_rows` and `harms_of_frames`, with the number of the cell, `cell`.
    """

    rows: pl.DataFrame
    frames: pl.DataFrame

    @classmethod
    def of(cls, rows: pl.DataFrame, cells: pl.DataFrame) -> "Numbered":
        """Return the rows of some cells with their numbers; those of others are left out."""
        own = rows.join(cells, on=CELL, how="inner", maintain_order="left")
        return cls(
            *(made.join(cells, on=CELL, maintain_order="left") for made in (harms_of_rows(own), harms_of_frames(own)))
        )


@dataclass(frozen=True)
class Pairing:
    """Which cells of two runs are pairs.

    Parameters
    ----------
    cells : frozenset of int
        Cells whose frames have the same seeds, and all of whose true highlights tonight are in the baseline, once: the
        rows of both runs are compared pair by pair.
    lost : polars.DataFrame
        `cell`, `before` (true highlights of the baseline), `kept` (those of them that tonight has): cells whose frames
        have the same seeds, and that lack some of the baseline's true highlights tonight.
    """

    cells: frozenset[int]
    lost: pl.DataFrame


def pairing(before: Numbered, after: Numbered) -> Pairing:
    """Find the cells that are pairs, and those that have lost highlights."""
    key = ("cell", "realisation", "true_id", "seed")
    counted = [run.rows.group_by(key).agg(pl.len().alias(name)) for run, name in ((before, "first"), (after, "second"))]
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
    # A frame without a highlight has rows only where something was found in it.
    frames = before.frames.join(after.frames, on=("cell", "realisation"), suffix="_2")
    moved = set(frames.filter(pl.col("seed").ne_missing(pl.col("seed_2")))["cell"].to_list())
    # Realisations of other numbers are other realisations: nothing of them is lost.
    fewer = pl.col("kept") < pl.col("before")
    lost = fewer & pl.col("cell").is_in(list(set(frames["cell"].to_list()) - moved))
    unequal = counts.filter((pl.col("gained") > 0) | pl.col("repeated") | (fewer & ~lost))
    every = set(before.frames["cell"].to_list()) & set(after.frames["cell"].to_list())
    return Pairing(
        frozenset(every - set(unequal["cell"].to_list()) - moved), counts.filter(lost).select("cell", "before", "kept")
    )


def pairs(before: Numbered, after: Numbered, paired: frozenset[int]) -> pl.DataFrame:
    """Return the pairs of all quantities: `UNIT`, `baseline`, `tonight`; a row where both runs have a value."""
    kept = pl.col("cell").is_in(list(paired))
    rows = _long(before.rows.filter(kept), "baseline").join(
        _long(after.rows.filter(kept), "tonight"), on=(*UNIT, "true_id"), maintain_order="left"
    )
    # A frame that had highlights and has no row at all tonight is lost: it is not one without false detections.
    frame = ("cell", "realisation")
    unseen = before.rows.join(after.frames, on=frame, how="anti")
    first = _frames(before.frames.filter(kept).join(unseen, on=frame, how="anti", maintain_order="left"), "baseline")
    second = _frames(after.frames.filter(kept), "tonight")
    frames = first.join(second, on=UNIT, how="full", coalesce=True, maintain_order="left_right").with_columns(
        pl.col("baseline", "tonight").fill_null(0.0)
    )
    return pl.concat([table.select(*UNIT, "baseline", "tonight") for table in (rows, frames)])


def unpaired_values(run: Numbered, paired: frozenset[int]) -> pl.DataFrame:
    """Return one run's values of all quantities in the cells that are not paired: `UNIT`, `value`."""
    kept = ~pl.col("cell").is_in(list(paired))
    tables = (_long(run.rows.filter(kept), "value"), _frames(run.frames.filter(kept), "value"))
    return pl.concat([table.select(*UNIT, "value") for table in tables])


def _long(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    index = ["cell", "realisation", "true_id"]
    return rows.unpivot(list(HARMS), index=index, variable_name="quantity", value_name=name).drop_nulls(name)


def _frames(frames: pl.DataFrame, name: str) -> pl.DataFrame:
    return frames.select("cell", "realisation", quantity=pl.lit("false"), **{name: pl.col("false")})
