"""Compares estimators on the same highlights; frames, not highlights, are the independent units.

Highlights of one frame share its noise, its light and its surface. Settings are chosen, not drawn, so the spread
between them is no noise: all spread is taken within settings. A frame that repeats another of its setting to the last
bit, as every realisation without noise does, says nothing new and counts once.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import LEAST_GROUPS, Interval, mean_interval
from simtest.validation.statistics import ANATOMY, FRAME

KEYS = (*FRAME, "target", "true_id")
"""A true highlight of a frame. Of an estimator of clouds ``true_id`` numbers the base's highlights: a list apart."""

LEAST_FRAMES = LEAST_GROUPS
"""Distinct frames that an interval of a median needs."""


def targets_of(rows: pl.DataFrame) -> dict[str, str]:
    """Return the surface whose normal each estimator states, "fine" or "base", in order of appearance."""
    names = [str(name) for name in rows["estimator"].drop_nulls().unique(maintain_order=True)]
    if "target" not in rows.columns:
        return dict.fromkeys(names, "fine")
    # A failure states no surface of its own: answers tell first.
    told = rows.sort(pl.col("status") == "ok", descending=True, maintain_order=True).drop_nulls("target")
    found = dict(told.group_by("estimator", maintain_order=True).agg(pl.col("target").first()).iter_rows())
    return {name: str(found.get(name, "fine")) for name in names}


def side_by_side(rows: pl.DataFrame, targets: Mapping[str, str]) -> pl.DataFrame:
    """Return a row for each true highlight with each estimator's error.

    Parameters
    ----------
    rows : polars.DataFrame
        Rows of results.parquet with a true highlight.
    targets : mapping
        Estimators and the surface whose normal they state (`targets_of`).

    Returns
    -------
    polars.DataFrame
        The columns `KEYS` and `label`; for each estimator "status NAME", null for a highlight that it has no row of,
        and "of NAME", its error, deg, null without an answer.
    """
    error = pl.when(pl.col("status") == "ok").then(pl.col("error_deg"))
    columns = []
    for name in targets:
        own = pl.col("estimator") == name
        # A highlight may be found twice; the first detection counts for all estimators alike.
        columns += [pl.col("status").filter(own).first().alias(f"status {name}"),
                    error.filter(own).first().alias(f"of {name}")]  # fmt: skip
    stated = pl.col("estimator").replace_strict(targets, default=None, return_dtype=pl.String).alias("target")
    if ANATOMY in rows.columns:
        columns.append(pl.col(ANATOMY).first())
    told = rows.with_columns(stated).drop_nulls("target")
    return told.group_by(KEYS, maintain_order=True).agg(pl.col("label").first(), *columns)


@dataclass(frozen=True)
class Distinct:
    """Highlights of frames that differ.

    Parameters
    ----------
    wide : polars.DataFrame
        Rows of `side_by_side` of all frames but copies.
    copied : frozenset of str
        Settings whose frames were all the same, two at least: their errors have no spread.
    """

    wide: pl.DataFrame
    copied: frozenset[str]


def distinct_frames(wide: pl.DataFrame) -> Distinct:
    """Leave out each frame whose errors are those of an earlier frame of its setting, to the last bit.

    Frames in which nothing was answered cannot be told apart, and all stay.
    """
    errors = [name for name in wide.columns if name.startswith("of ")]
    marked = wide.with_columns(
        wide.select("true_id", *errors).hash_rows().alias("_mark"),
        pl.any_horizontal(pl.col(name).is_not_null() for name in errors).alias("_answered"),
    )
    frames = marked.group_by(FRAME, maintain_order=True).agg(
        pl.col("_mark").sort().cast(pl.String).str.join(",").alias("_marks"), pl.col("_answered").any()
    )
    first = pl.struct("experiment", "setting", "_marks").is_first_distinct()
    frames = frames.with_columns((first | ~pl.col("_answered")).alias("_kept"))
    counts = frames.group_by("setting").agg(pl.len().alias("all"), pl.col("_kept").sum().alias("kept"))
    copied = counts.filter((pl.col("all") > 1) & (pl.col("kept") == 1))["setting"].to_list()
    kept = wide.join(frames.filter("_kept").select(FRAME), on=FRAME, how="semi", maintain_order="left")
    return Distinct(kept, frozenset(map(str, copied)))


def difference_interval(differences: Array, frames: IntArray, settings: IntArray, certain: Mask) -> Interval:
    """Compute the 95 % interval of the mean of differences.

    Parameters
    ----------
    differences : ndarray
        Of each highlight, deg.
    frames, settings : ndarray
        Number of the frame and of the setting of each (`simtest.validation.statistics.units`).
    certain : ndarray
        Whether its setting has no spread; such highlights count in the mean, and widen its interval only where their
        mean differs from that of the others.
    """
    if certain.all():
        exact = float(np.mean(differences)) if len(differences) else None
        return exact, exact
    drawn = ~certain
    return mean_interval(differences[drawn], frames[drawn], settings[drawn], others=differences[certain])
