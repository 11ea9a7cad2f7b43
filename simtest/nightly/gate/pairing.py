"""Which rows of two nights are pairs, and what nights differ in beside their numbers."""

from dataclasses import dataclass

import polars as pl

from simtest.nightly.gate.pairing_units import UNIT
from simtest.nightly.gate.quantities import ANSWERED, HARMS, IS_TRUE, KEY, harms_of_frames, harms_of_rows
from simtest.nightly.gate.records import PLACE


@dataclass(frozen=True)
class Numbered:
    """One night's rows of the shared places.

    Parameters
    ----------
    rows, frames : polars.DataFrame
        See `harms_of_rows` and `harms_of_frames`, with the number of the place, `place`.
    """

    rows: pl.DataFrame
    frames: pl.DataFrame

    @classmethod
    def of(cls, rows: pl.DataFrame, names: pl.DataFrame) -> "Numbered":
        """Give the rows of places with their numbers; those of others are left out."""
        own = rows.join(names, on=PLACE, how="inner", maintain_order="left")
        return cls(
            *(made.join(names, on=PLACE, maintain_order="left") for made in (harms_of_rows(own), harms_of_frames(own)))
        )


@dataclass(frozen=True)
class Pairing:
    """Which places of two nights are pairs.

    Parameters
    ----------
    places : frozenset of int
        Places whose frames have the same seeds, and all of whose true highlights tonight are in the baseline, once:
        what both nights have is compared pair by pair.
    lost : polars.DataFrame
        `place`, `before` (true highlights of the baseline), `kept` (those that tonight has too): places whose frames
        have the same seeds, and of whose true highlights some are missing tonight.
    """

    places: frozenset[int]
    lost: pl.DataFrame


def pairing(before: Numbered, after: Numbered) -> Pairing:
    """Find the places that are pairs, and those that have lost highlights."""
    key = ("place", "realisation", "true_id", "seed")
    counted = [
        night.rows.group_by(key).agg(pl.len().alias(name)) for night, name in ((before, "once"), (after, "again"))
    ]
    once, again = pl.col("once"), pl.col("again")
    counts = (
        counted[0]
        .join(counted[1], on=key, how="full", coalesce=True, nulls_equal=True)
        .with_columns(once.fill_null(0), again.fill_null(0))
        .group_by("place")
        .agg(
            before=(once > 0).sum(), kept=((once > 0) & (again > 0)).sum(), gained=(once == 0).sum(),
            repeated=((once > 1) | (again > 1)).any(),
        )
    )  # fmt: skip
    # A frame without a highlight has rows only where something was found in it.
    frames = before.frames.join(after.frames, on=("place", "realisation"), suffix="_2")
    moved = set(frames.filter(pl.col("seed").ne_missing(pl.col("seed_2")))["place"].to_list())
    # Realisations of other numbers are other realisations: nothing of them is lost.
    same = (pl.col("kept") < pl.col("before")) & pl.col("place").is_in(list(set(frames["place"].to_list()) - moved))
    lost = counts.filter(same).select("place", "before", "kept")
    other = counts.filter((pl.col("gained") > 0) | pl.col("repeated") | ((pl.col("kept") < pl.col("before")) & ~same))
    every = set(before.frames["place"].to_list()) & set(after.frames["place"].to_list())
    return Pairing(frozenset(every - set(other["place"].to_list()) - moved), lost)


def pairs(before: Numbered, after: Numbered, paired: frozenset[int]) -> pl.DataFrame:
    """Give the pairs of all quantities: `UNIT`, `baseline`, `tonight`; a row where both nights have a value."""
    kept = pl.col("place").is_in(list(paired))
    rows = _long(before.rows.filter(kept), "baseline").join(
        _long(after.rows.filter(kept), "tonight"), on=(*UNIT, "true_id")
    )
    # A frame that had highlights and has no row at all tonight is lost: it is not one without false detections.
    unseen = before.rows.join(after.frames, on=("place", "realisation"), how="anti").select("place", "realisation")
    frames = (
        _frames(before.frames.filter(kept).join(unseen, on=("place", "realisation"), how="anti"), "baseline")
        .join(_frames(after.frames.filter(kept), "tonight"), on=UNIT, how="full", coalesce=True)
        .with_columns(pl.col("baseline", "tonight").fill_null(0.0))
    )
    return pl.concat([table.select(*UNIT, "baseline", "tonight") for table in (rows, frames)])


def alone(night: Numbered, paired: frozenset[int]) -> pl.DataFrame:
    """Give one night's values of all quantities at the places that are not paired: `UNIT`, `value`."""
    kept = ~pl.col("place").is_in(list(paired))
    tables = (_long(night.rows.filter(kept), "value"), _frames(night.frames.filter(kept), "value"))
    return pl.concat([table.select(*UNIT, "value") for table in tables])


def _long(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    index = ("place", "realisation", "true_id")
    tables = [
        rows.select(*index, quantity=pl.lit(quantity), **{name: pl.col(quantity)}).filter(pl.col(name).is_not_null())
        for quantity in HARMS
    ]
    return pl.concat(tables)


def _frames(frames: pl.DataFrame, name: str) -> pl.DataFrame:
    return frames.select("place", "realisation", quantity=pl.lit("false"), **{name: pl.col("false")})


@dataclass(frozen=True)
class Changes:
    """How answers, rather than their values, changed between two nights.

    Parameters
    ----------
    pairs : int
        True highlights times estimators in both nights, of the same seed.
    lost, gained : int
        Of these, answered in the baseline alone, and tonight alone.
    status : int
        Of these, whose status differs.
    frames : int
        Frames in both nights.
    detections : int
        Of these, with another number of detections.
    """

    pairs: int
    lost: int
    gained: int
    status: int
    frames: int
    detections: int


def changes(baseline: pl.DataFrame, tonight: pl.DataFrame) -> Changes:
    """Count what changed in kind: isophotes that opened, highlights that were found no more.

    Parameters
    ----------
    baseline, tonight : polars.DataFrame
        Rows of two nights.

    Returns
    -------
    Changes
    """
    key = (*KEY, "seed")
    first, second = (
        rows.filter(IS_TRUE).select(*key, "status", answered=ANSWERED).unique(key, keep="first")
        for rows in (baseline, tonight)
    )
    both = first.join(second, on=key, suffix="_2")
    lost, gained = pl.col("answered") & ~pl.col("answered_2"), pl.col("answered_2") & ~pl.col("answered")
    frame = ("experiment", "setting", "realisation", "seed")
    seen = [
        rows.group_by(frame).agg(found=pl.col("specularity").drop_nulls().n_unique()) for rows in (baseline, tonight)
    ]
    frames = seen[0].join(seen[1], on=frame, suffix="_2")
    return Changes(
        both.height, both.filter(lost).height, both.filter(gained).height,
        both.filter(pl.col("status").ne_missing(pl.col("status_2"))).height, frames.height,
        frames.filter(pl.col("found") != pl.col("found_2")).height,
    )  # fmt: skip
