"""Results that were edited without touching the code: what the gate says of each.

A night is edited, and the gate compares it with the same night as it was.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.nightly.compare import compare
from simtest.nightly.quantities import setting_figures
from simtest.nightly.records import NightlyRun, RunRecord, Verdict
from simtest.validation.columns import SCHEMA

OK = (pl.col("status") == "ok") & pl.col("true_id").is_not_null()
OF_ANSWERS = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_fine_deg", "error_base_deg", "normal_x", "normal_y",
    "normal_z", "cov_11", "cov_12", "cov_22", "mahalanobis2", "axis_ratio", "gain_1", "gain_2", "gain_error",
    "gain_oracle_error", "direction_error_deg", "error_law_deg",
)  # fmt: skip
ERRORS = ("error_deg", "error_oracle_deg", "error_fine_deg", "error_base_deg")

Edit = Callable[[pl.DataFrame, np.random.Generator], pl.DataFrame]


def run_of(rows: pl.DataFrame) -> NightlyRun:
    """Return a run of rows with its figures, as a night has them."""
    return NightlyRun(RunRecord(), rows, setting_figures(rows))


def _where(rows: pl.DataFrame, condition: pl.Expr, **values: pl.Expr) -> pl.DataFrame:
    """Return rows with values replaced where a condition holds."""
    return rows.with_columns(
        pl.when(condition).then(value).otherwise(pl.col(name)).cast(SCHEMA[name]).alias(name)
        for name, value in values.items()
    )


def _unanswered(rows: pl.DataFrame, condition: pl.Expr, status: str) -> pl.DataFrame:
    """Return rows whose answers are taken away where a condition holds."""
    gone = {name: pl.lit(None) for name in OF_ANSWERS}
    return _where(rows, OK & condition, status=pl.lit(status), flags=pl.lit(""), **gone)


def _settings(rows: pl.DataFrame, count: int, rng: np.random.Generator) -> pl.Expr:
    """Return a condition that some settings with answers meet, chosen by chance."""
    keys = rows.filter(OK).select("experiment", "setting").unique().sort("experiment", "setting")
    chosen = keys[np.sort(rng.choice(keys.height, count, replace=False)).tolist()]
    condition = pl.lit(False)
    for experiment, setting in chosen.iter_rows():
        condition |= (pl.col("experiment") == experiment) & (pl.col("setting") == setting)
    return condition


def failing(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Let all estimators fail in 4 settings."""
    return _unanswered(rows, _settings(rows, 4, rng), "no_closed_isophote")


def one_cell_five_times(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make the errors of one estimator in one setting five times larger."""
    cell = _settings(rows, 1, rng) & (pl.col("estimator") == rows["estimator"].mode().sort()[0])
    return _where(rows, cell, **{name: 5 * pl.col(name) for name in ERRORS})


def one_result_five_times(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make one single error of at least 0.02 deg five times larger."""
    number = pl.int_range(pl.len())
    large = rows.with_columns(row=number).filter(OK & (pl.col("error_deg") > 0.02))["row"]
    chosen = number == int(large[int(rng.integers(len(large)))])
    return _where(rows, chosen, **{name: 5 * pl.col(name) for name in ERRORS})


def no_errors(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make all errors 0."""
    return _where(rows, OK, **{name: pl.lit(0.0) for name in ERRORS})


def laws_off(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Move every law by 5 deg."""
    return rows.with_columns(pl.col("error_law_deg") + 5.0)


def _regions(rows: pl.DataFrame, factor: float) -> pl.DataFrame:
    """Scale every region, its distances and the parts of its budget with it."""
    parts = [name for name in SCHEMA if name.startswith("budget_")]
    return rows.with_columns(
        *(pl.col(f"cov_{name}") * factor**2 for name in ("11", "12", "22")),
        *(pl.col(name) * factor for name in parts),
        pl.col("mahalanobis2") / factor**2,
    )


def narrow_regions(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make every region 100 times smaller."""
    return _regions(rows, 0.01)


def wide_regions(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make every region a quarter wider."""
    return _regions(rows, 1.25)


def narrow_covariances(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make the covariances alone 100 times smaller."""
    return rows.with_columns(pl.col(f"cov_{name}") * 1e-4 for name in ("11", "12", "22"))


def shared_seeds(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Set the seeds of all settings of an experiment to those of its first one."""
    first = rows.filter(pl.col("setting") == pl.col("setting").first().over("experiment"))
    seeds = first.select("experiment", "realisation", new="seed").unique(("experiment", "realisation"))
    joined = rows.join(seeds, on=("experiment", "realisation"), how="left", maintain_order="left")
    return joined.with_columns(seed=pl.coalesce("new", "seed")).drop("new")


def duplicated(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Replace the results of every setting's second realisation by those of the first, seeds left as they are."""
    key = ("experiment", "setting", "estimator", "true_id")
    rank = pl.col("realisation").rank("dense").over("experiment", "setting")
    first = rows.filter(rank == 1, OK).unique(key).select(*key, **{f"new_{name}": pl.col(name) for name in OF_ANSWERS})
    joined = rows.join(first, on=key, how="left", maintain_order="left")
    second = OK & (rank == 2) & pl.col("new_error_deg").is_not_null()
    return _where(joined, second, **{name: pl.col(f"new_{name}") for name in OF_ANSWERS}).select(rows.columns)


def true_normals(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Put the truth in the place of every normal; errors stay as they are."""
    return _where(rows, OK, **{f"normal_{axis}": pl.col(f"truth_{axis}") for axis in "xyz"})


def setting_dropped(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Drop a setting."""
    return rows.filter(~_settings(rows, 1, rng))


def false_removed(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Drop all false detections."""
    return rows.filter(pl.col("true_id").is_not_null())


def flags_removed(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Empty the flags of all answers."""
    return _where(rows, OK, flags=pl.lit(""))


def axis_ratio_constant(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Make all axis ratios 0.7."""
    return _where(rows, pl.col("axis_ratio").is_not_null(), axis_ratio=pl.lit(0.7))


def some_missed(rows: pl.DataFrame, rng: np.random.Generator) -> pl.DataFrame:
    """Let 5 % of the answers be missed."""
    chosen = pl.Series(rng.random(rows.height) < 0.05)
    return _unanswered(rows, pl.lit(chosen), "missed")


EDITS: dict[str, Edit] = {
    "all estimators failing in 4 settings": failing,
    "errors of one cell five times larger": one_cell_five_times,
    "one single error five times larger": one_result_five_times,
    "all errors 0": no_errors,
    "every law off by 5 deg": laws_off,
    "regions x 0.01": narrow_regions,
    "regions x 1.25": wide_regions,
    "covariances alone x 0.0001": narrow_covariances,
    "seeds shared between settings": shared_seeds,
    "realisations duplicated": duplicated,
    "normals replaced by the truth": true_normals,
    "a setting dropped": setting_dropped,
    "false detections removed": false_removed,
    "flags removed": flags_removed,
    "axis ratio constant": axis_ratio_constant,
    "answers missed in 5 %": some_missed,
}
"""Edits of rows by name."""


@dataclass(frozen=True)
class Edited:
    """What the gate said of an edit.

    `name`: of the edit; `changes`: whether it changed anything of this night; `same`, `fresh`: against the night
    itself, and against one of other seeds.
    """

    name: str
    changes: bool
    same: Verdict
    fresh: Verdict | None


def edited(tonight: pl.DataFrame, other: pl.DataFrame | None, seed: int = 0) -> list[Edited]:
    """Edit a night in all ways; the first of the list is no edit.

    `other` is a night of other seeds, if there is one.
    """
    runs = {"none": run_of(tonight)}
    for name, edit in EDITS.items():
        runs[name] = run_of(edit(tonight, np.random.default_rng(seed)))
    unedited, fresh = runs["none"], None if other is None else run_of(other)
    return [
        Edited(
            name, not (run.rows.equals(tonight) and run.figures.equals(unedited.figures)), compare(run, unedited),
            None if fresh is None else compare(run, fresh),
        )
        for name, run in runs.items()
    ]  # fmt: skip
