"""Compares estimators on the same highlights; frames, not highlights, are the independent units.

Highlights of one frame share its noise, its light and its surface. Settings are chosen, not drawn, so the spread
between them is no noise: all spread is taken within settings. A frame that repeats another of its setting to the last
bit, as every realisation without noise does, says nothing new and counts once.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl
from numpy.typing import NDArray

from simtest.geometry import student_t
from simtest.runtime.arrays import Array, IntArray
from simtest.validation.statistics import CONFIDENCE, Interval

FRAME = ("experiment", "setting", "realisation")

KEYS = (*FRAME, "target", "true_id")
"""A true highlight of a frame. Of an estimator of clouds ``true_id`` numbers the base's highlights: a list apart."""

LEAST_FRAMES = 5
"""Distinct frames that each setting needs before the interval of a median is stated."""

NO_VALUES: Array = np.empty(0)

_ROUNDING = 1e-6
_RESAMPLES = 1000
_CHUNK = 2_000_000  # numbers in memory at once


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


def units(wide: pl.DataFrame) -> tuple[Array, Array]:
    """Return the number of the setting and of the frame of each highlight, from 0."""
    numbered = wide.select(
        pl.struct("experiment", "setting").rank("dense").alias("setting") - 1, pl.struct(FRAME).rank("dense") - 1
    )
    return numbered.to_series(0).to_numpy().astype(int), numbered.to_series(1).to_numpy().astype(int)


def difference_interval(differences: Array, frames: Array, settings: Array, certain: NDArray[np.bool_]) -> Interval:
    """Compute the 95 % interval of the mean of differences; None without any, or with a single frame.

    Parameters
    ----------
    differences : ndarray
        Of each highlight, deg.
    frames, settings : ndarray
        Number of the frame and of the setting of each.
    certain : ndarray
        Whether its setting has no spread; such highlights count in the mean, and widen its interval only where their
        mean differs from that of the others.
    """
    if not len(differences):
        return None, None
    mean, drawn = float(np.mean(differences)), ~certain
    if certain.all():
        return mean, mean
    half = half_width(differences[drawn], settings[drawn], frames[drawn], differences[certain])
    return (None, None) if half is None else (mean - half, mean + half)


def half_width(values: Array, settings: Array, frames: Array, others: Array = NO_VALUES) -> float | None:
    """Compute half the 95 % interval of the mean of values whose frames are the independent units.

    The number of values varies from frame to frame, and a frame with many of them draws the mean to its own. So the
    spread is that of `deviation_of_mean`, and Student's t has the degrees of freedom of `freedom_of`.

    Parameters
    ----------
    values : ndarray
        Of each highlight.
    settings, frames : ndarray
        Number of the setting and of the frame of each.
    others : ndarray
        Further values that the mean is over, without spread.

    Returns
    -------
    float or None
        None for a single frame.
    """
    _, first, frame = np.unique(frames, return_index=True, return_inverse=True)
    totals: Array = np.asarray(np.bincount(frame, values), dtype=np.float64)
    counts: Array = np.bincount(frame).astype(np.float64)
    strata = np.unique(settings[first], return_inverse=True)[1]
    if len(totals) == strata.max() + 1:
        # One frame a setting: no spread within any is seen, so that between them has to do.
        strata = np.zeros_like(strata)
    seen = np.bincount(strata)[strata] > 1
    if not seen.any():
        return None
    deviation = deviation_of_mean(totals, counts, strata, others)
    # Frames that are alone in their setting spread as the others do.
    deviation *= math.sqrt(len(totals) / np.count_nonzero(seen))
    return student_t.quantile((1 + CONFIDENCE) / 2, freedom_of(counts, strata)) * deviation


def freedom_of(counts: Array, strata: IntArray) -> int:
    """Return the degrees of freedom of `deviation_of_mean`, fewer where few frames hold most of the values.

    They are (1 - S / F) (sum c^2)^2 / sum c^4, with c the number of values of each of the F frames, and S strata: what
    Satterthwaite's rule gives if each value spreads alike. At least 1.
    """
    weights = counts[np.bincount(strata)[strata] > 1] ** 2
    if not weights.any():
        return 1
    free = 1 - len(np.unique(strata)) / len(strata)
    return max(math.floor(free * float(weights.sum() ** 2 / (weights @ weights)) + _ROUNDING), 1)


def deviation_of_mean(totals: Array, counts: Array, strata: IntArray, others: Array = NO_VALUES) -> float:
    """Compute the standard deviation of the mean of all values by the jackknife over frames.

    It leaves out one frame of a stratum at a time, and the others of the stratum weigh more instead [Rao and Wu, J. Am.
    Stat. Assoc. 83, 1988, 231]. So it holds where the number of values varies from frame to frame.

    Parameters
    ----------
    totals, counts : ndarray, shape (F,)
        Sum and number of the values of each frame; 0 of a frame without any.
    strata : ndarray of int, shape (F,)
        Number of the stratum of each, from 0.
    others : ndarray
        Further values that the mean is over, without spread. Where they differ from the mean of the frames', the number
        of values in each frame moves the mean of all.
    """
    size, fixed = np.bincount(strata)[strata], float(others.sum())
    mean = float((totals.sum() + fixed) / (counts.sum() + len(others)))
    off = (_without_each(totals, strata) + fixed) / (_without_each(counts, strata) + len(others)) - mean
    return math.sqrt(float(np.sum((1 - 1 / size) * off**2)))


def _without_each(values: Array, strata: IntArray) -> Array:
    """Return the sum of all values without each one; the others of its stratum weigh more."""
    size, own = np.bincount(strata)[strata], np.bincount(strata, values)[strata]
    # A value that is alone in its stratum stays: it shows no spread.
    return np.asarray(values.sum() + np.where(size > 1, (own - size * values) / np.maximum(size - 1, 1), 0.0))


def median_interval(values: Array, settings: Array, frames: Array) -> Interval:
    """Compute the 95 % interval of a median by resampling the frames within each setting.

    Of n frames n - 1 are drawn, with replacement, and weigh n / (n - 1): n draws would make the interval too narrow
    where n is small (Rao and Wu, J. Am. Stat. Assoc. 83, 1988, 231).

    Returns
    -------
    (float or None, float or None)
        None where a setting has fewer than `LEAST_FRAMES` frames. The resampling is seeded: the same values give the
        same interval.
    """
    if not len(values):
        return None, None
    numbers, first, frame = np.unique(frames, return_index=True, return_inverse=True)
    of_setting = settings[first]
    _, sizes = np.unique(of_setting, return_counts=True)
    if sizes.min() < LEAST_FRAMES:
        return None, None
    order = np.argsort(values, kind="stable")
    ordered, frame = values[order], frame[order]
    draws = np.empty((_RESAMPLES, len(numbers)))
    random = np.random.default_rng(0)
    for setting in np.unique(of_setting):
        own = np.flatnonzero(of_setting == setting)
        n = len(own)
        draws[:, own] = random.multinomial(n - 1, np.full(n, 1 / n), _RESAMPLES) * (n / (n - 1))
    step = max(1, _CHUNK // len(ordered))
    medians = [_medians(ordered, draws[at : at + step][:, frame]) for at in range(0, _RESAMPLES, step)]
    low, high = np.quantile(np.concatenate(medians), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)


def _medians(ordered: Array, weights: Array) -> Array:
    """Return the median of ordered values under each row of weights."""
    total = np.cumsum(weights, axis=1)
    half = total[:, -1:] / 2
    slack = 1e-9 * half
    lower = np.argmax(total >= half - slack, axis=1)
    upper = np.argmax(total > half + slack, axis=1)
    medians: Array = (ordered[lower] + ordered[upper]) / 2
    return medians
