"""Which method to use, and where it breaks: a run's highlights by situation, and each method's figures there.

A situation is a kind of surface under one kind of light, noise, relief and spot: settings that differ in kind never
share one. Settings that differ in degree do, and where a method breaks among them is told by setting.

The best method of a situation has the lowest mean error, a highlight without an answer counting `PENALTY_DEG`. A
method ties with it where the 95 % interval of their mean difference over the same highlights holds 0; frames, not
highlights, are the independent units of that interval.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.geometry import student_t
from simtest.runtime.arrays import Array
from simtest.validation.situations import Situation, situations_of
from simtest.validation.statistics import CONFIDENCE, PENALTY_DEG, Interval

BREAK_DEG = 5.0
"""A method breaks where its mean error is larger, failed and missed highlights counting `PENALTY_DEG`, ..."""

LEAST_ANSWERED = 0.5
"""... or where it answers less than this share of the highlights."""

KEYS = ("experiment", "setting", "realisation", "true_id")  # a true highlight of a frame


@dataclass(frozen=True)
class MethodFigures:
    """Figures of one method over some highlights; errors in deg."""

    estimator: str
    n: int  # highlights
    answered: int
    median_deg: float | None  # of the answers
    interval_deg: Interval  # 95 % interval of the median
    mean_penalised_deg: float

    @property
    def breaks(self) -> bool:
        """Whether the method breaks here."""
        return self.mean_penalised_deg > BREAK_DEG or self.answered < LEAST_ANSWERED * self.n


@dataclass(frozen=True)
class Advice:
    """What a run says of one situation."""

    situation: Situation
    n: int  # true highlights
    methods: Mapping[str, MethodFigures]
    best: str | None  # None where no method answered
    ties: tuple[str, ...]  # other methods that cannot be told from the best, the better first
    by_setting: Mapping[str, MethodFigures]  # of the best method

    @property
    def broken(self) -> dict[str, MethodFigures]:
        """The settings where the best method breaks, the mildest first."""
        broken = {setting: figures for setting, figures in self.by_setting.items() if figures.breaks}
        return dict(sorted(broken.items(), key=lambda item: item[1].mean_penalised_deg))

    @property
    def worst(self) -> str:
        """The setting where the best method's mean error is largest."""
        return max(self.by_setting, key=lambda setting: self.by_setting[setting].mean_penalised_deg)


@dataclass(frozen=True)
class Guide:
    """What a run says of all its situations."""

    shared: tuple[str, ...]  # conditions that hold in every situation
    advice: tuple[Advice, ...]
    left_out: tuple[str, ...]  # settings without a true highlight

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
    true = results.filter(pl.col("true_id").is_not_null())
    shared, found = situations_of(true, conditions or {})
    held = {setting for situation in found for setting in situation.settings}
    left = [str(name) for name in results["setting"].unique(maintain_order=True) if name not in held]
    return Guide(shared, tuple(_advice(each, true) for each in found), tuple(left))


def _advice(situation: Situation, true: pl.DataFrame) -> Advice:
    rows = true.filter(pl.col("setting").is_in(situation.settings))
    wide, names = side_by_side(rows)
    methods = {name: _figures(name, wide[f"of {name}"]) for name in names}
    ranked = sorted(methods.values(), key=lambda each: each.mean_penalised_deg)
    if not any(each.answered for each in ranked):
        return Advice(situation, wide.height, methods, None, (), {})
    best = ranked[0].estimator
    frames = wide.select(pl.struct("experiment", "setting", "realisation").rank("dense")).to_series().to_numpy()
    ties = [
        each.estimator
        for each in ranked[1:]
        if each.answered
        and not _is_worse(_penalised(wide[f"of {each.estimator}"]) - _penalised(wide[f"of {best}"]), frames)
    ]
    by_setting = {
        str(setting): _figures(best, part[f"of {best}"])
        for (setting,), part in wide.group_by("setting", maintain_order=True)
    }  # fmt: skip
    return Advice(situation, wide.height, methods, best, tuple(ties), by_setting)


def side_by_side(rows: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """Return a row for each true highlight with each estimator's error.

    Returns
    -------
    (polars.DataFrame, list of str)
        The table, with the columns `KEYS`, `label`, and "of NAME" for each estimator: its error, deg, null without an
        answer; and the estimators that were run on all of these highlights or some, in order of appearance.
    """
    names = [str(name) for name in rows["estimator"].drop_nulls().unique(maintain_order=True)]
    error = pl.when(pl.col("status") == "ok").then(pl.col("error_deg"))
    # A highlight may be found twice; the first detection counts for all estimators alike.
    columns = [error.filter(pl.col("estimator") == name).first().alias(f"of {name}") for name in names]
    return rows.group_by(KEYS, maintain_order=True).agg(pl.col("label").first(), *columns), names


def _figures(name: str, errors: pl.Series) -> MethodFigures:
    answers = errors.drop_nulls().to_numpy()
    median = float(np.median(answers)) if len(answers) else None
    mean = float(np.mean(_penalised(errors)))
    return MethodFigures(name, len(errors), len(answers), median, median_interval(answers), mean)


def _penalised(errors: pl.Series) -> Array:
    return errors.fill_null(PENALTY_DEG).to_numpy()


def _is_worse(differences: Array, frames: Array) -> bool:
    """Whether the interval of the mean of differences, deg, lies above 0; `frames` numbers the frame of each."""
    n = len(differences)
    _, index = np.unique(frames, return_inverse=True)
    count = int(index.max()) + 1
    if count < 2:
        return False
    mean = float(np.mean(differences))
    # Highlights of one frame share its noise and its light: residuals are summed before they are squared.
    sums = np.bincount(index, weights=differences - mean)
    deviation = math.sqrt(count / (count - 1) * float(np.sum(sums**2))) / n
    return mean - student_t.quantile((1 + CONFIDENCE) / 2, count - 1) * deviation > 0


def median_interval(values: Array) -> Interval:
    """Compute the 95 % interval of a median from order statistics; None with fewer than six values.

    The number of values below the median is binomial whatever their distribution, so the k-th smallest and the k-th
    largest hold it with a confidence of at least 95 %, k the largest for which that is so.
    """
    n = len(values)
    rank = max((k for k, below in enumerate(_binomial(n), 1) if below <= (1 - CONFIDENCE) / 2), default=0)
    if not rank:
        return None, None
    ordered = np.sort(values)
    return float(ordered[rank - 1]), float(ordered[n - rank])


def _binomial(n: int) -> Iterator[float]:
    """Yield P(B <= k) for k = 0, 1, ... below n / 2, B binomial with n draws of probability 1/2."""
    total = 0.0
    for k in range((n + 1) // 2):
        total += math.exp(math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) - n * math.log(2))
        yield total
