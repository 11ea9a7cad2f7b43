"""The records that the nightly's stages hand on: `NightlyRun` (measure), `Verdict` (judge), `JudgedRun` (draw)."""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

import polars as pl
from pydantic import BaseModel, ConfigDict

from simtest.validation.statistics import counts


class Cell(NamedTuple):
    """A cell of the results: what an estimator did in one setting of one experiment."""

    experiment: str | None = ""
    label: str | None = ""
    surface: str | None = ""
    setting: str | None = ""
    estimator: str | None = ""


CELL = Cell._fields
"""Columns that name a cell."""

POOLED = "all"
"""Stands for label, surface and setting of a comparison over all settings of an experiment, and for the experiment too
of one over all experiments."""

SINGLE = "single"
"""Method of comparisons of results one by one."""

_CELL_TYPES: dict[str, pl.DataType] = dict.fromkeys(CELL, pl.String())

FIGURES: dict[str, pl.DataType] = {
    **_CELL_TYPES, "quantity": pl.String(), "unit": pl.String(), "value": pl.Float64(), "low": pl.Float64(),
    "high": pl.Float64(), "n": pl.Int64(), "digest": pl.String(),
}  # fmt: skip
"""Columns of a run's figures, a row a number of an estimator in a setting.

`low`, `high` are its 95 % interval, `digest` is the hash of the cell's results, the same for all figures of a cell.
"""

COMPARISONS: dict[str, pl.DataType] = {
    **_CELL_TYPES, "quantity": pl.String(), "unit": pl.String(), "method": pl.String(),
    "n": pl.Int64(), "baseline": pl.Float64(), "tonight": pl.Float64(), "difference": pl.Float64(),
    "low": pl.Float64(), "high": pl.Float64(), "margin": pl.Float64(), "p": pl.Float64(), "p_holm": pl.Float64(),
    "outcome": pl.String(),
}  # fmt: skip
"""Columns of the gate's comparisons, a row a cell and quantity.

`method` is "equal" (the same bytes: no test is made), "paired", "unpaired", "single" (results one by one, `n` that
moved) or "none". `difference` is tonight less the baseline, `low`, `high` its 95 % interval, `margin` the harmless size
of a difference; `p` one-sided for "changed by more than the margin" to the surer side, `p_holm` corrected over the
family. `outcome` is one of `OUTCOMES`. Rows over many settings (`POOLED`) of a quantity with a relative margin have the
unit "x": the baseline is 1, the difference the mean share of the settings'.
"""

OUTCOMES = ("same", "equivalent", "undecided", "better", "changed", "worse", "new", "gone")
"""same: equal bytes; equivalent: the interval, or every single pair, lies within the margin; worse: beyond the margin
at the corrected level, or a cell or highlights that tonight lacks (a regression); better: its mirror image; changed: a
quantity of which neither side is better, or a single result, moved; undecided: neither shown; new: the baseline lacks
it; gone: tonight has nothing to say of the quantity."""


def to_explain() -> pl.Expr:
    """Return which comparisons are no regression, and yet must be explained: errors that fell, and what changed."""
    return pl.col("outcome").is_in(["changed", "better"])


class RunRecord(BaseModel):
    """A run's record, as run.json holds it: when and where the run was made, of what, and by which versions.

    Fields that a record lacks have their defaults; `to_json` writes those alone that were given. Keys that this version
    does not know are kept. `definitions` is a hash by experiment (what was run); `variant` is Mitsuba's for
    grey scenes, `variants` that of each experiment; `reason` and `accepted` are a baseline's.
    """

    model_config = ConfigDict(frozen=True, extra="allow")

    id: str = ""
    profile: str = ""
    title: str = ""
    started: str = ""
    duration_s: float | None = None
    workers: int | None = None
    definitions: dict[str, str] = {}
    command: str = ""
    commit: str | None = None
    version: str | None = None
    versions: dict[str, str] = {}
    python: str | None = None
    processor: str | None = None
    system: str | None = None
    source_hash: str | None = None
    variant: str | None = None
    variants: dict[str, str] = {}
    llvm: str | None = None
    reason: str | None = None
    accepted: str | None = None

    @property
    def start(self) -> datetime:
        """When the run started, UTC."""
        return datetime.fromisoformat(self.started).astimezone(UTC)

    def to_json(self) -> dict[str, Any]:
        """Return the record as run.json and verdict.json hold it."""
        return self.model_dump(exclude_unset=True)


@dataclass(frozen=True)
class NightlyRun:
    """What one run of a profile measured."""

    record: RunRecord  # when, where and of what it was made
    rows: pl.DataFrame  # results of all experiments, the columns of `simtest.validation.columns.SCHEMA`
    figures: pl.DataFrame  # columns `FIGURES`


@dataclass(frozen=True)
class Verdict:
    """What the gate says of a run."""

    state: str  # "fine", "changed", "regression" or "no baseline"
    bit_equal: bool | None  # whether all rows of run and baseline are the same bytes; None without a baseline
    comparisons: pl.DataFrame  # columns `COMPARISONS`
    notes: tuple[str, ...]  # versions that differ, pairs that are missing, results that changed in kind
    baseline: RunRecord | None
    causes: tuple[str, ...] = ()  # what to look at first: estimator, experiment, setting, what it was and is

    @property
    def regressions(self) -> pl.DataFrame:
        """The comparisons that are worse."""
        return self.comparisons.filter(pl.col("outcome") == "worse")

    @property
    def unexplained(self) -> pl.DataFrame:
        """The comparisons that are no regression, and must be explained all the same (`to_explain`)."""
        return self.comparisons.filter(to_explain())

    @property
    def counts(self) -> dict[str, int]:
        """Number of comparisons by outcome."""
        return {name: self.comparisons.filter(pl.col("outcome") == name).height for name in OUTCOMES}

    @property
    def exit_code(self) -> int:
        """1 for a regression, or for a change that nobody has accepted, else 0."""
        return 1 if self.state in ("regression", "changed") else 0


@dataclass(frozen=True)
class JudgedRun:
    """A run with its verdict and history: all that page and outputs are made of."""

    run: NightlyRun
    verdict: Verdict
    history: pl.DataFrame  # columns `simtest.nightly.store.HISTORY`, the run's own rows among them
    reports: tuple[str, ...] = ()  # experiments with findings whose own page lies in reports/NAME, the worst first

    def by_experiment(self) -> pl.DataFrame:
        """Count by experiment: `rows` (true highlights), those `answered`, the other `KINDS` of rows, and `OUTCOMES`.

        All estimators are counted together. An experiment that the baseline alone has is counted by its outcomes.
        """
        numbers = self.run.rows.group_by("experiment", maintain_order=True).agg(**counts(self.run.rows))
        numbers = numbers.rename({"true": "rows", "ok": "answered"})
        outcomes = self.verdict.comparisons.group_by("experiment").agg(
            (pl.col("outcome") == name).sum().alias(name) for name in OUTCOMES
        )
        both = numbers.join(
            outcomes.sort("experiment"), on="experiment", how="full", coalesce=True, maintain_order="left_right"
        )
        return both.with_columns(pl.col(OUTCOMES).fill_null(0))
