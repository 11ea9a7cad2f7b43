"""Nights drawn from rows that were made once, and what the gate says of each."""

import multiprocessing
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.nightly.gate.compare import compare
from simtest.nightly.gate.records import FIGURES, PLACE, Night

SETTING = ("experiment", "setting")
WORKERS = 2


@dataclass(frozen=True)
class Source:
    """Rows, and their units.

    Parameters
    ----------
    rows : polars.DataFrame
        Columns of `studies.gate.bank.COLUMNS`.
    unit : ndarray of int, shape (N,)
        Number of each row's unit: a realisation of a setting.
    setting : ndarray of int, shape (U,)
        Number of each unit's setting.
    """

    rows: pl.DataFrame
    unit: npt.NDArray[np.int64]
    setting: npt.NDArray[np.int64]

    @classmethod
    def of(cls, rows: pl.DataFrame) -> "Source":
        """Give rows with their units numbered."""
        units = rows.select(*SETTING, "realisation").unique(maintain_order=True).with_row_index("unit")
        settings = units.select(SETTING).unique(maintain_order=True).with_row_index("number")
        numbers = units.join(settings, on=SETTING, maintain_order="left")["number"].to_numpy().astype(np.int64)
        unit = rows.join(units, on=(*SETTING, "realisation"), maintain_order="left")["unit"].to_numpy()
        return cls(rows, unit.astype(np.int64), numbers)

    def ranks(self, rng: np.random.Generator) -> npt.NDArray[np.int64]:
        """Give every unit a rank within its setting, in random order, shape (U,)."""
        order = np.lexsort((rng.random(len(self.setting)), self.setting))
        sizes = np.bincount(self.setting)
        ranks = np.empty(len(order), dtype=np.int64)
        ranks[order] = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return ranks

    def chosen(self, units: npt.NDArray[np.bool_]) -> pl.DataFrame:
        """Give the rows of some units."""
        return self.rows.filter(pl.Series(units[self.unit]))


def night(rows: pl.DataFrame, name: str, equal: pl.DataFrame | None = None) -> Night:
    """Give a night of rows; its places' hashes are its name, but for those that are equal to the other night's."""
    places = rows.select(PLACE).unique(maintain_order=True).with_columns(digest=pl.lit(name))
    if equal is not None:
        places = places.join(equal.with_columns(same=pl.lit("equal")), on=PLACE, how="left").select(
            *PLACE, digest=pl.coalesce("same", "digest")
        )
    columns = [pl.lit(None, dtype).alias(column) for column, dtype in FIGURES.items() if column not in places.columns]
    figures = places.with_columns(columns).with_columns(kind=pl.lit("setting"), quantity=pl.lit("n"))
    return Night({}, rows, figures.select(list(FIGURES)))


def equal_places(first: pl.DataFrame, second: pl.DataFrame) -> pl.DataFrame:
    """Give the places whose rows are the same to the last bit in two tables of the same order."""
    same = pl.Series([True] * first.height)
    for name in first.columns:
        same &= first[name].eq_missing(second[name])
    return (
        first.select(PLACE)
        .with_columns(same=same)
        .group_by(PLACE)
        .agg(pl.col("same").all())
        .filter("same")
        .select(PLACE)
    )


Draw = Callable[[np.random.Generator], tuple[Night, Night]]
"""Gives tonight and a baseline."""


@dataclass(frozen=True)
class Fresh:
    """Nights of n realisations a setting against other n: seeds differ, and nothing else.

    Parameters
    ----------
    source : Source
        The bank.
    n : int
        Realisations of each setting.
    tonight : Source, optional
        Where tonight is drawn from, of the same units; default the bank.
    """

    source: Source
    n: int
    tonight: Source | None = None

    def __call__(self, rng: np.random.Generator) -> tuple[Night, Night]:
        """Draw two nights without a common unit."""
        ranks = self.source.ranks(rng)
        after = (self.tonight or self.source).chosen((ranks >= self.n) & (ranks < 2 * self.n))
        return night(after, "tonight"), night(self.source.chosen(ranks < self.n), "baseline")


@dataclass(frozen=True)
class Paired:
    """Nights of the same n realisations a setting, made by two versions of the code.

    Parameters
    ----------
    baseline, tonight : Source
        Of the same units in the same order.
    n : int
        Realisations of each setting.
    equal : polars.DataFrame, optional
        Places that are the same in both.
    """

    baseline: Source
    tonight: Source
    n: int
    equal: pl.DataFrame | None = None

    def __call__(self, rng: np.random.Generator) -> tuple[Night, Night]:
        """Draw the same units of both."""
        units = self.baseline.ranks(rng) < self.n
        return (
            night(self.tonight.chosen(units), "tonight", self.equal),
            night(self.baseline.chosen(units), "baseline", self.equal),
        )


@dataclass(frozen=True)
class Found:
    """What the gate said of one night.

    Parameters
    ----------
    regression : bool
        Whether anything was worse.
    estimators : tuple of str
        Of which.
    tests : int
        Size of the family.
    least : float
        Least corrected p-value; 1 without a test.
    """

    regression: bool
    estimators: tuple[str, ...]
    tests: int
    least: float


def judge(draw: Draw, seed: int) -> Found:
    """Draw a night and judge it."""
    tonight, baseline = draw(np.random.default_rng(seed))
    verdict = compare(tonight, baseline)
    tested = verdict.comparisons.filter(pl.col("p").is_not_null())
    worse = verdict.regressions["estimator"].unique().sort().to_list()
    least = tested["p_holm"].to_numpy().min() if tested.height else 1.0
    return Found(verdict.state == "regression", tuple(worse), tested.height, float(least))


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
