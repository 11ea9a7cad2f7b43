"""Compares estimators on the same highlights, and ranks them; frames, not highlights, are the independent units.

Highlights of one frame share its noise, its light and its surface. Settings are chosen, not drawn, so the spread
between them is no noise: all spread is taken within settings. A frame that repeats another of its setting to the last
bit, as every realisation without noise does, says nothing new and counts once.

Methods are ranked in pairs, on the highlights that both answered; what one refuses or misses stands in columns of its
own.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import polars as pl

from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import LEAST_GROUPS, Interval, mean_interval
from simtest.validation.statistics import ANATOMY, FRAME, units

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
        Number of the frame and of the setting of each (`units`).
    certain : ndarray
        Whether its setting has no spread; such highlights count in the mean, and widen its interval only where their
        mean differs from that of the others.
    """
    if certain.all():
        exact = float(np.mean(differences)) if len(differences) else None
        return exact, exact
    drawn = ~certain
    return mean_interval(differences[drawn], frames[drawn], settings[drawn], others=differences[certain])


MATTERS_DEG = 0.01
"""A smaller difference between two methods decides nothing, ..."""

MATTERS_SHARE = 0.05
"""... nor one below this share of the better method's mean error."""


@dataclass(frozen=True)
class Pair:
    """Two methods over the highlights that both answered; errors in deg."""

    first: str
    second: str
    n: int  # highlights that both answered
    only_first: int  # highlights that one alone answered
    only_second: int
    mean_first: float | None  # over the n
    mean_second: float | None
    interval_deg: Interval  # 95 % interval of the first one's mean less the second one's
    first_nearer: int  # highlights where the first is nearer to the truth
    few: bool  # whether the frames that both answered are too few to rank by

    @property
    def difference_deg(self) -> float | None:
        """Mean error of the first less that of the second."""
        return None if self.mean_first is None or self.mean_second is None else self.mean_first - self.mean_second

    @property
    def ahead(self) -> str | None:
        """The one whose mean error is smaller by enough to matter, be it by chance."""
        if self.mean_first is None or self.mean_second is None:
            return None
        low, high = sorted((self.mean_first, self.mean_second))
        if high - low < max(MATTERS_DEG, MATTERS_SHARE * low):
            return None
        return self.first if self.mean_first < self.mean_second else self.second

    @property
    def better(self) -> str | None:
        """The one whose mean error is smaller by enough to matter, and by more than chance."""
        low, high = self.interval_deg
        return None if low is None or high is None or low <= 0 <= high else self.ahead

    def other(self, name: str) -> str:
        """Return the name of the other one."""
        return self.second if name == self.first else self.first


def compare(distinct: Distinct, names: Sequence[str]) -> list[Pair]:
    """Compare each two methods, by their errors side by side."""
    frames, settings = units(distinct.wide)
    certain = distinct.wide["setting"].is_in(list(distinct.copied)).to_numpy()
    errors = {name: distinct.wide[f"of {name}"].to_numpy().astype(float) for name in names}
    made = []
    for first, second in combinations(names, 2):
        answered, other = np.isfinite(errors[first]), np.isfinite(errors[second])
        both = answered & other
        a, b = errors[first][both], errors[second][both]
        mean_a, mean_b = (float(values.mean()) if len(values) else None for values in (a, b))
        interval = difference_interval(a - b, frames[both], settings[both], certain[both])
        few = not len(a) or 0 < len(np.unique(frames[both & ~certain])) < LEAST_FRAMES
        only = int(np.sum(answered & ~other)), int(np.sum(other & ~answered))
        made.append(Pair(first, second, len(a), *only, mean_a, mean_b, interval, int(np.sum(a < b)), few))
    return made


def best_of(pairs: Sequence[Pair], names: Sequence[str]) -> str:
    """Return the method that the fewest of the others are better than; of several, that the fewest are ahead of.

    Of several still, it is the first.
    """
    own = [pair for pair in pairs if pair.first in names and pair.second in names]
    worse = Counter(pair.other(pair.better) for pair in own if pair.better)
    behind = Counter(pair.other(pair.ahead) for pair in own if pair.ahead)
    return min(names, key=lambda name: (worse[name], behind[name]))
