"""Single results of the same seeds, versions and machine: each is compared with itself.

Unchanged code gives the same result again, to the last digits. So no test is needed: a result that moved by more than
rounding could move it was moved by the code, and a night that holds one has changed.
"""

from typing import NamedTuple

import polars as pl

from simtest.nightly.gate.quantities import ANSWERED, IS_TRUE, REGION_DEG
from simtest.nightly.records import CELL
from simtest.validation.row_kinds import is_false


class Step(NamedTuple):
    """How far a number may move: both parts must be exceeded, `share` as a share of the smaller of both values."""

    value: pl.Expr
    unit: str
    absolute: float
    share: float
    of_answers: bool = True  # compared where both runs answered; else for every true highlight


STEPS = {
    "error": Step(pl.col("error_deg"), "deg", 0.01, 1.0),
    "better error": Step(pl.col("error_oracle_deg"), "deg", 0.01, 1.0),
    "law": Step(pl.col("error_law_deg"), "deg", 0.01, 0.02),
    "region": Step(REGION_DEG, "deg", 0.002, 0.5),
    "noise part": Step(pl.col("budget_noise_deg"), "deg", 0.002, 0.5),
    "axis ratio": Step(pl.col("axis_ratio"), "", 0.02, 0.05),
    "gain error": Step(pl.col("gain_error"), "", 0.05, 1.0),
    "direction": Step(pl.col("direction_error_deg"), "deg", 1.0, 1.0),
    "light": Step(pl.col("eps_over_d"), "", 1e-6, 1e-3, of_answers=False),
    "peak": Step(pl.col("peak_snr"), "", 0.1, 0.02, of_answers=False),
    "distance": Step(pl.col("distance_mm"), "mm", 1e-4, 1e-4, of_answers=False),
    "curvature": Step(pl.col("kd_min"), "", 1e-4, 1e-3, of_answers=False),
    "larger curvature": Step(pl.col("kd_max"), "", 1e-4, 1e-3, of_answers=False),
}  # fmt: skip
"""Numbers of a result by name. Other rounding moved errors by 3.2e-5 deg at most (docs/gallery/gate_measured.md)."""

SINGLE = "single"
"""Method of these comparisons."""

_KEY = (*CELL, "realisation", "true_id", "seed")
_LOST_HALF = 0.5


def moved(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Compare the results of two runs one by one, as comparisons; a row for each cell and number that moved.

    Parameters
    ----------
    before, after : polars.DataFrame
        Rows of cells whose seeds mean the same in both runs, of the same columns.

    Returns
    -------
    polars.DataFrame
        `n` counts the results that moved; `baseline` and `tonight` are those of the one that moved farthest, of the
        status the numbers of answers, of flags those of answers with a flag, of false detections their numbers.
        "worse" where half of a cell's answers are lost, else "changed".
    """
    chosen = (*_KEY, "answered", "status", "flags", *STEPS)
    first, second = (
        rows.filter(IS_TRUE).with_columns(
            answered=ANSWERED, **{name: step.value.cast(pl.Float64) for name, step in STEPS.items()}
        ).select(chosen).unique(_KEY, keep="first", maintain_order=True)
        for rows in (before, after)
    )  # fmt: skip
    both = first.join(second, on=_KEY, suffix="_2", nulls_equal=True, maintain_order="left")
    was, now = pl.col("answered"), pl.col("answered_2")
    answered = both.filter(was & now)
    # An answer whose error is no number is none, whatever its status.
    other = pl.col("status").ne_missing(pl.col("status_2")) | (was != now)
    lost = (was & ~now).sum()
    many = (lost > 0) & (lost >= _LOST_HALF * was.sum())
    made = [_told(both, "single answers", "", other.sum(), was.sum(), now.sum(), many)]
    was, now = (pl.col(name).fill_null("") for name in ("flags", "flags_2"))
    made.append(_told(answered, "single flags", "", (was != now).sum(), (was != "").sum(), (now != "").sum()))
    was, now = pl.col("found").fill_null(0), pl.col("found_2").fill_null(0)
    false = _false_by_frame(before, after)
    made.append(_told(false, "single false", "", (was != now).sum(), was.sum(), now.sum()))
    made += [_number(answered if step.of_answers else both, name, step) for name, step in STEPS.items()]
    return pl.concat(made, how="diagonal").with_columns(method=pl.lit(SINGLE), margin=pl.lit(0.0))


def _told(
    results: pl.DataFrame, quantity: str, unit: str, n: pl.Expr, baseline: pl.Expr, tonight: pl.Expr,
    worse: pl.Expr | None = None,
) -> pl.DataFrame:  # fmt: skip
    """Return comparisons of cells, by what is aggregated of their results; those without a moved one are left out."""
    found = results.group_by(CELL, maintain_order=True).agg(
        n=n.cast(pl.Int64), baseline=baseline.cast(pl.Float64), tonight=tonight.cast(pl.Float64),
        worse=pl.lit(False) if worse is None else worse,
    )  # fmt: skip
    return found.filter(pl.col("n") > 0).select(
        *CELL, "n", "baseline", "tonight", quantity=pl.lit(quantity), unit=pl.lit(unit),
        difference=pl.col("tonight") - pl.col("baseline"),
        outcome=pl.when(pl.col("worse")).then(pl.lit("worse")).otherwise(pl.lit("changed")),
    )  # fmt: skip


def _false_by_frame(before: pl.DataFrame, after: pl.DataFrame) -> pl.DataFrame:
    """Count the false detections of each frame, `found` before and `found_2` after."""
    frame = (*CELL, "realisation")
    first, second = (
        rows.group_by(frame, maintain_order=True).agg(found=is_false(rows).sum().cast(pl.Int64))
        for rows in (before, after)
    )
    return first.join(second, on=frame, how="full", coalesce=True, suffix="_2", maintain_order="left_right")


def _number(results: pl.DataFrame, name: str, step: Step) -> pl.DataFrame:
    was, now = pl.col(name), pl.col(f"{name}_2")
    size = (now - was).abs()
    far = (size > step.absolute) & (size > step.share * pl.min_horizontal(was.abs(), now.abs()))
    # A number that appears or vanishes has moved as well.
    far = far.fill_null(False) | (was.is_finite().fill_null(False) != now.is_finite().fill_null(False))
    marked = results.with_columns(far=far, size=size.fill_nan(None).fill_null(float("inf")))
    worst = pl.col("size").filter("far").arg_max()
    farthest = (value.filter("far").get(worst, null_on_oob=True) for value in (was, now))
    return _told(marked, f"single {name}", step.unit, pl.col("far").sum(), *farthest)
