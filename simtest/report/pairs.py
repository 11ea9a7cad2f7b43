"""Estimators compared pair by pair on the same highlights."""

import itertools
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.pages.style import estimator_order, number
from simtest.report.run_folder import Run
from simtest.runtime.statistics import mean_interval
from simtest.validation.paired import side_by_side, targets_of
from simtest.validation.statistics import units

NONE = "–"


@dataclass(frozen=True)
class Pair:
    """Two estimators over the highlights that both answered; errors in deg."""

    label: str  # which curve's highlights
    first: str
    second: str
    n: int  # highlights that both answered
    only_first: int  # highlights that one alone answered
    only_second: int
    mean_first: float | None  # over the n
    mean_second: float | None
    difference: float | None  # mean of first less second
    low: float | None  # its 95 % interval, over frames; None with fewer than two
    high: float | None
    first_better: int  # highlights where the first is nearer to the truth

    @property
    def better(self) -> str:
        """The one whose error is smaller by more than chance; a dash where the interval holds 0."""
        if self.low is None or self.high is None or self.low <= 0 <= self.high:
            return NONE
        return self.first if self.high < 0 else self.second

    @property
    def interval(self) -> str:
        """The interval as text."""
        return NONE if self.low is None else f"{number(self.low)} to {number(self.high)}"


def pairs(run: Run) -> list[Pair]:
    """Compare each two estimators by the errors of their proposed normals.

    Each label is counted apart, since labels differ in kind; a single estimator has no pairs. Estimators that state
    the normals of different surfaces, fine and base, are no pair: they answer for different highlights.
    """
    true = run.results.filter(pl.col("true_id").is_not_null())
    names = estimator_order(true["estimator"].drop_nulls().to_list())
    if len(names) < 2:
        return []
    targets = targets_of(true)
    wide = side_by_side(true, targets)
    labels = wide["label"].unique(maintain_order=True).to_list()
    groups = [(str(label), wide.filter(pl.col("label") == label)) for label in labels]
    return [
        _pair(label, first, second, part)
        for label, part in groups
        for first, second in itertools.combinations(names, 2)
        if targets[first] == targets[second]
    ]


def _pair(label: str, first: str, second: str, wide: pl.DataFrame) -> Pair:
    one, other = (wide[f"of {name}"] for name in (first, second))
    answered = wide.filter(one.is_not_null() & other.is_not_null())
    a, b = (answered[f"of {name}"].to_numpy().astype(float) for name in (first, second))
    n = len(a)
    low, high = mean_interval(a - b, *units(answered))
    return Pair(
        label, first, second, n,
        int((one.is_not_null() & other.is_null()).sum()), int((one.is_null() & other.is_not_null()).sum()),
        float(a.mean()) if n else None, float(b.mean()) if n else None, float((a - b).mean()) if n else None,
        low, high, int(np.sum(a < b)),
    )  # fmt: skip
