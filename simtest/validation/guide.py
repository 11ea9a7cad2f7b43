"""Which method to use, and where it breaks: a run's highlights by situation, and each method's figures there.

A situation is a kind of surface under one kind of light, noise, relief and spot: settings that differ in kind never
share one. Settings that differ in degree do, and where a method breaks among them is told by setting. Methods that
state the normal of the base are ranked apart from those that state the fine surface's: their errors are of other
normals, and of other highlights.

Methods are ranked in pairs, on the highlights that both answered (`comparison`): no other one is better
than the best, or the fewest are. A method ties with it where neither is better. What a method refuses or misses is
counted apart: one that answers fewer than `LEAST_ANSWERED` of the highlights is not the best where another answers
more. A method that breaks never ties with one that does not. Fewer than `LEAST_FRAMES` distinct frames make no tie:
what they cannot tell apart is not ranked.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from simtest.conventions import MOTION
from simtest.errors import FAULTS
from simtest.estimators.names import is_own
from simtest.runtime.statistics import Interval, median_interval
from simtest.validation.comparison import (
    LEAST_FRAMES,
    Distinct,
    Pair,
    best_of,
    compare,
    distinct_frames,
    side_by_side,
    targets_of,
)
from simtest.validation.situations import Situation, situations_of
from simtest.validation.statistics import FRAME, PENALTY_DEG, units

BREAK_DEG = 5.0
"""A method breaks where the mean error of its answers is larger, ..."""

LEAST_ANSWERED = 0.5
"""... or where it answers less than this share of the highlights."""


@dataclass(frozen=True)
class MethodFigures:
    """Figures of one method over the highlights that it has rows of; errors in deg."""

    estimator: str
    n: int  # highlights
    answered: int
    missed: int  # that no detection found
    failed: int  # where the method stopped with an error; the others without an answer were refused
    median_deg: float | None  # of the answers, as `interval_deg` and `mean_deg`
    interval_deg: Interval  # 95 % interval of the median
    mean_deg: float | None
    mean_penalised_deg: float  # highlights without an answer counting `PENALTY_DEG`

    @property
    def refused(self) -> int:
        """Highlights that were found, and that the method gave a reason for instead of a normal."""
        return self.n - self.answered - self.missed - self.failed

    @property
    def errs(self) -> bool:
        """Whether its answers are too far off."""
        return self.mean_deg is not None and self.mean_deg > BREAK_DEG

    @property
    def is_silent(self) -> bool:
        """Whether it answers too few."""
        return self.answered < LEAST_ANSWERED * self.n

    @property
    def breaks(self) -> bool:
        """Whether the method breaks here."""
        return self.errs or self.is_silent


@dataclass(frozen=True)
class Advice:
    """What a run says of one situation."""

    situation: Situation
    target: str  # surface whose normal the methods state: "fine" or "base"
    n: int  # true highlights
    methods: Mapping[str, MethodFigures]
    best: str | None  # None where no method answered
    ties: tuple[str, ...]  # other methods that cannot be told from the best, the better first
    by_setting: Mapping[str, MethodFigures]  # of the best method
    few: bool = False  # whether its frames are too few for an interval
    unranked: tuple[str, ...] = ()  # methods that so few frames cannot tell from the best
    guests: Mapping[str, Mapping[str, MethodFigures]] = field(default_factory=dict)  # by setting, of methods elsewhere
    pairs: Sequence[Pair] = ()  # of methods that answered

    @property
    def broken(self) -> dict[str, MethodFigures]:
        """The settings where the best method breaks."""
        return {setting: figures for setting, figures in self.by_setting.items() if figures.breaks}

    @property
    def worst(self) -> str:
        """The setting where the median error of the best method's answers is largest."""
        return max(self.by_setting, key=lambda setting: self.by_setting[setting].median_deg or 0.0)


@dataclass(frozen=True)
class Guide:
    """What a run says of all its situations."""

    shared: tuple[str, ...]  # conditions that hold in every situation
    advice: tuple[Advice, ...]
    left_out: tuple[str, ...]  # settings without a true highlight
    highlights: int = 0  # true ones
    frames: int = 0  # that show one

    @property
    def estimators(self) -> list[str]:
        """Names of the methods, in order of appearance."""
        return list(dict.fromkeys(name for each in self.advice for name in each.methods))


def guide_of(results: pl.DataFrame, conditions: Mapping[str, Mapping[str, object]] | None = None) -> Guide:
    """Sum up a run's results by situation.

    Parameters
    ----------
    results : polars.DataFrame
        Rows of results.parquet.
    conditions : mapping, optional
        ``conditions`` of summary.json, by setting; without them the columns alone tell the situations apart.
    """
    # Rows of motion repeat the normals of the first view's estimator: they are no method of their own here.
    true = results.filter(pl.col("true_id").is_not_null() & (pl.col("estimator") != MOTION))
    shared, found = situations_of(true, conditions or {})
    held = {setting for situation in found for setting in situation.settings}
    # A setting without a detection has no row at all.
    names = dict.fromkeys([*results["setting"].unique(maintain_order=True), *(conditions or {})])
    left = [str(name) for name in names if name not in held]
    # A cloud's number is that of the base's highlight: it counts where its frame has no glint of that number.
    counts = (true.select(key).n_unique() for key in ([*FRAME, "true_id"], [*FRAME]))
    return Guide(shared, tuple(advice for each in found for advice in advice_of(each, true)), tuple(left), *counts)


def advice_of(situation: Situation, true: pl.DataFrame) -> list[Advice]:
    """Return what is said of the fine surface's normals, and of the base's, as far as there are methods for them.

    `true` are the rows of true highlights; those of other situations' settings are left out.
    """
    rows = true.filter(pl.col("setting").is_in(situation.settings))
    targets = targets_of(rows)
    made = []
    for target in sorted(set(targets.values()), reverse=True):
        names = [name for name, own in targets.items() if own == target]
        wide = side_by_side(rows, dict.fromkeys(names, target))
        made.append(_ranked(situation, target, distinct_frames(wide), names))
    return made


def _ranked(situation: Situation, target: str, distinct: Distinct, names: Sequence[str]) -> Advice:
    wide = distinct.wide
    methods = {name: _figures(name, wide) for name in names}
    guests = {name: _by_setting(name, wide) for name in names if not is_own(name)}
    answering = [each for each in methods.values() if each.answered]
    if not answering:
        return Advice(situation, target, wide.height, methods, None, (), {}, guests=guests)
    # Of methods that the pairs leave alike, the one that answers more is best, then that of the smaller mean.
    answering.sort(key=lambda each: (-each.answered, each.mean_deg))
    order = [each.estimator for each in answering]
    pairs = compare(distinct, order)
    best = best_of(pairs, [name for name in order if not methods[name].is_silent] or order)
    open_pairs = {pair.other(best): pair.few for pair in pairs if best in (pair.first, pair.second) and not pair.better}
    alike = [name for name in order if name in open_pairs and (methods[best].breaks or not methods[name].breaks)]
    return Advice(
        situation, target, wide.height, methods, best, tuple(name for name in alike if not open_pairs[name]),
        _by_setting(best, wide), _is_few(distinct), tuple(name for name in alike if open_pairs[name]), guests, pairs,
    )  # fmt: skip


def _by_setting(name: str, wide: pl.DataFrame) -> dict[str, MethodFigures]:
    return {
        str(setting): _figures(name, part)
        for (setting,), part in wide.drop_nulls(f"status {name}").group_by("setting", maintain_order=True)
    }


def _is_few(distinct: Distinct) -> bool:
    """Whether the frames whose errors have a spread are too few for an interval; without noise one frame suffices."""
    spread = distinct.wide.filter(~pl.col("setting").is_in(list(distinct.copied)))
    return 0 < spread.select(FRAME).n_unique() < LEAST_FRAMES


def _figures(name: str, wide: pl.DataFrame) -> MethodFigures:
    own = wide.drop_nulls(f"status {name}")
    answered = own.drop_nulls(f"of {name}")
    answers = answered[f"of {name}"].to_numpy()
    mean = float(np.mean(answers)) if len(answers) else None
    missed = int((own[f"status {name}"] == "missed").sum())
    failed = int(own[f"status {name}"].is_in(list(map(str, FAULTS))).sum())
    penalised = float(np.mean(own[f"of {name}"].fill_null(PENALTY_DEG).to_numpy())) if own.height else PENALTY_DEG
    median = float(np.median(answers)) if len(answers) else None
    interval = median_interval(answers, *units(answered))
    return MethodFigures(name, own.height, len(answers), missed, failed, median, interval, mean, penalised)
