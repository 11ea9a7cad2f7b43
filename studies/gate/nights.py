"""Nights drawn from rows that were made once, and the gate's verdict on each."""

import multiprocessing
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.nightly.compare import compare
from simtest.nightly.records import CELL, FIGURES, NightlyRun, RunRecord

SETTING = ("experiment", "setting")
WORKERS = 2


@dataclass(frozen=True)
class Source:
    """Rows, and their units.

    `rows`: columns of `studies.gate.bank.COLUMNS`; `unit` (shape (N,)): number of each row's unit: a realisation of
    a setting; `setting` (shape (U,)): number of each unit's setting.
    """

    rows: pl.DataFrame
    unit: npt.NDArray[np.int64]
    setting: npt.NDArray[np.int64]

    @classmethod
    def of(cls, rows: pl.DataFrame) -> "Source":
        """Return rows with numbers of their units."""
        units = rows.select(*SETTING, "realisation").unique(maintain_order=True).with_row_index("unit")
        settings = units.select(SETTING).unique(maintain_order=True).with_row_index("number")
        numbers = units.join(settings, on=SETTING, maintain_order="left")["number"].to_numpy().astype(np.int64)
        unit = rows.join(units, on=(*SETTING, "realisation"), maintain_order="left")["unit"].to_numpy()
        return cls(rows, unit.astype(np.int64), numbers)

    def ranks(self, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Return a rank for every unit within its setting, in random order, shape (U,)."""
        order = np.lexsort((rng.random(len(self.setting)), self.setting))
        sizes = np.bincount(self.setting)
        ranks = np.empty(len(order), dtype=np.int64)
        ranks[order] = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return ranks

    def chosen(self, units: npt.NDArray[np.bool_]) -> pl.DataFrame:
        """Return the rows of some units."""
        return self.rows.filter(pl.Series(units[self.unit]))


def run_of(rows: pl.DataFrame, name: str, equal: pl.DataFrame | None = None) -> NightlyRun:
    """Make a run of rows; its cells' hashes are its name, except for those that are equal to the other run's."""
    cells = rows.select(CELL).unique(maintain_order=True).with_columns(digest=pl.lit(name))
    if equal is not None:
        cells = cells.join(equal.with_columns(same=pl.lit("equal")), on=CELL, how="left").select(
            *CELL, digest=pl.coalesce("same", "digest")
        )
    columns = [pl.lit(None, dtype).alias(column) for column, dtype in FIGURES.items() if column not in cells.columns]
    figures = cells.with_columns(columns).with_columns(quantity=pl.lit("n"))
    return NightlyRun(RunRecord(), rows, figures.select(list(FIGURES)))


def equal_cells(first: pl.DataFrame, second: pl.DataFrame) -> pl.DataFrame:
    """Return the cells whose rows are the same to the last bit in two tables of the same order."""
    same = pl.Series([True] * first.height)
    for name in first.columns:
        same &= first[name].eq_missing(second[name])
    table = first.select(CELL).with_columns(same=same)
    return table.group_by(CELL).agg(pl.col("same").all()).filter("same").select(CELL)


Draw = Callable[[np.random.Generator], tuple[NightlyRun, NightlyRun]]
"""Draws tonight and a baseline."""


@dataclass(frozen=True)
class Fresh:
    """Nights of n realisations a setting against other n: seeds differ, and nothing else.

    `source`: the bank; `n`: realisations of each setting; `tonight`: where tonight is drawn from, of the same
    units; default the bank.
    """

    source: Source
    n: int
    tonight: Source | None = None

    def __call__(self, rng: np.random.Generator) -> tuple[NightlyRun, NightlyRun]:
        """Draw two nights without a common unit."""
        ranks = self.source.ranks(rng)
        after = (self.tonight or self.source).chosen((ranks >= self.n) & (ranks < 2 * self.n))
        return run_of(after, "tonight"), run_of(self.source.chosen(ranks < self.n), "baseline")


@dataclass(frozen=True)
class Paired:
    """Nights of the same n realisations a setting, made by two versions of the code.

    `baseline`, `tonight`: of the same units in the same order; `n`: realisations of each setting; `equal`: cells
    that are the same in both.
    """

    baseline: Source
    tonight: Source
    n: int
    equal: pl.DataFrame | None = None

    def __call__(self, rng: np.random.Generator) -> tuple[NightlyRun, NightlyRun]:
        """Draw the same units of both."""
        units = self.baseline.ranks(rng) < self.n
        return (
            run_of(self.tonight.chosen(units), "tonight", self.equal),
            run_of(self.baseline.chosen(units), "baseline", self.equal),
        )


@dataclass(frozen=True)
class Found:
    """The gate's verdict on one night.

    `alarm`: whether anything was worse, or must be explained; `tests`: size of the family; `least`: least corrected
    p-value; 1 without a test.
    """

    alarm: bool
    tests: int
    least: float


def judge(draw: Draw, seed: int) -> Found:
    """Draw a night and judge it."""
    tonight, baseline = draw(np.random.default_rng(seed))
    verdict = compare(tonight, baseline)
    tested = verdict.comparisons.filter(pl.col("p").is_not_null())
    least = tested["p_holm"].to_numpy().min() if tested.height else 1.0
    return Found(verdict.exit_code != 0, tested.height, float(least))


_draw: Draw


def _prepare(draw: Draw) -> None:
    global _draw
    _draw = draw


def _judge_prepared(seed: int) -> Found:
    return judge(_draw, seed)


def judge_many(draw: Draw, seeds: Iterable[int], workers: int = WORKERS) -> list[Found]:
    """Judge many nights, in several processes."""
    if workers == 1:
        return [judge(draw, seed) for seed in seeds]
    with multiprocessing.get_context("spawn").Pool(workers, _prepare, (draw,)) as pool:
        return pool.map(_judge_prepared, seeds, chunksize=5)


def raised(rows: pl.DataFrame, estimator: str, share: float) -> pl.DataFrame:
    """Raise one estimator's errors by a share."""
    own = pl.when(pl.col("estimator") == estimator).then(pl.col("error_deg") * (1 + share))
    return rows.with_columns(error_deg=own.otherwise(pl.col("error_deg")))
