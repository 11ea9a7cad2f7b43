"""What a night measured, and what the gate says of it."""

from dataclasses import dataclass
from typing import Any

import polars as pl

PLACE = ("experiment", "label", "surface", "setting", "estimator")
"""Columns that name a family member of the gate: what an estimator did in one setting of one experiment."""

POOLED = "all"
"""Stands for label, surface and setting of a comparison over all settings of an experiment, and for the experiment too
of one over all experiments."""

FIGURES: dict[str, pl.DataType] = {
    "kind": pl.String(), **{name: pl.String() for name in PLACE}, "quantity": pl.String(), "unit": pl.String(),
    "value": pl.Float64(), "low": pl.Float64(), "high": pl.Float64(), "n": pl.Int64(), "passed": pl.Boolean(),
    "digest": pl.String(), "about": pl.String(),
}  # fmt: skip
"""Columns of a night's figures, a row a number.

`kind` is "setting" (an estimator's figure in a setting; `low`, `high` its 95 % interval, `digest` the same hash for all
figures of a place: that of its rows' results), "canary" (`experiment` the canary's name, `low`, `high` what it may be,
`passed`) or "cost" (run time as ratio to the reference kernel, memory).
"""

COMPARISONS: dict[str, pl.DataType] = {
    **{name: pl.String() for name in PLACE}, "quantity": pl.String(), "unit": pl.String(), "method": pl.String(),
    "n": pl.Int64(), "baseline": pl.Float64(), "tonight": pl.Float64(), "difference": pl.Float64(),
    "low": pl.Float64(), "high": pl.Float64(), "margin": pl.Float64(), "p": pl.Float64(), "p_holm": pl.Float64(),
    "outcome": pl.String(),
}  # fmt: skip
"""Columns of the gate's comparisons, a row a place and quantity.

`method` is "equal" (the same bytes: no test is made), "paired", "unpaired" or "none"; `difference` is tonight less the
baseline, `low`, `high` its 95 % interval, `margin` what it may be without harm; `p` one-sided for "worse by more than
the margin", `p_holm` corrected over the family. `outcome` is one of `OUTCOMES`. Rows over many settings (`POOLED`) of a
quantity with a relative margin have the unit "x": the baseline is 1, the difference the mean share of the settings'.
Canaries (`experiment` the canary's name, `low`, `high` what it may be) and costs have the method "none".
"""

OUTCOMES = ("same", "equivalent", "undecided", "better", "worse", "new", "gone")
"""same: equal bytes; equivalent: the interval, or every single pair, lies within the margin; worse: beyond the margin
at the corrected level, or a place, highlights or a canary that tonight lacks (a regression); better: its mirror image;
undecided: neither shown; new: the baseline lacks it; gone: tonight has nothing to say of the quantity."""


@dataclass(frozen=True)
class Night:
    """What one run of a profile measured.

    Parameters
    ----------
    run : dict
        `id`, `profile`, `started` (ISO, UTC), `duration_s`, `command`, and `simtest.runtime.provenance.environment()`;
        where they are known `definitions` (a hash by experiment: what was run), `variant` and `llvm`.
    rows : polars.DataFrame
        Results of all experiments, the columns of `simtest.validation.results_table.SCHEMA`.
    figures : polars.DataFrame
        Columns `FIGURES`.
    """

    run: dict[str, Any]
    rows: pl.DataFrame
    figures: pl.DataFrame


@dataclass(frozen=True)
class Verdict:
    """What the gate says of a night.

    Parameters
    ----------
    state : str
        "fine", "regression" or "no baseline".
    bit_equal : bool or None
        Whether all rows of the two nights are the same bytes; None without a baseline.
    comparisons : polars.DataFrame
        Columns `COMPARISONS`.
    notes : tuple of str
        What a reader must know: versions that differ, pairs that are missing, contours that changed topology.
    baseline : dict or None
        The baseline's `Night.run`.
    """

    state: str
    bit_equal: bool | None
    comparisons: pl.DataFrame
    notes: tuple[str, ...]
    baseline: dict[str, Any] | None

    @property
    def regressions(self) -> pl.DataFrame:
        """The comparisons that are worse."""
        return self.comparisons.filter(pl.col("outcome") == "worse")
