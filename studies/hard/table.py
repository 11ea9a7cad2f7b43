"""The study's table: coverage, size and silent errors of each row and estimator."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.runtime import chi_squared
from simtest.runtime.statistics import share_interval

CHI2_95 = chi_squared.quantile(0.95, 2)
"""95 % quantile of the chi-squared distribution with two degrees of freedom."""

SILENT = 4.0
"""An error of over twice the stated 95 % radius has a squared Mahalanobis distance of over four times the quantile."""

QUIET_FLAGS = frozenset({"round", "missing_isovalues", "small"})
"""Flags that do not say that the normal may be wrong."""


@dataclass(frozen=True)
class Line:
    """Figures of one row and estimator."""

    row: str
    estimator: str
    answers: int
    stated: int
    failures: int
    covered: float
    low: float
    high: float
    semi_over_rms: float
    semi_deg: float
    rms_deg: float
    median_deg: float
    silent: float
    merged: int
    merged_covered: float


def lines(table: pl.DataFrame, rows: Sequence[str], groups: Mapping[str, Sequence[str]] | None = None) -> list[Line]:
    """Return the figures of all rows, in their order, and of groups of rows together, by the groups' names."""
    made = []
    for row, members in {**{row: [row] for row in rows}, **(groups or {})}.items():
        part = table.filter(pl.col("row").is_in(list(members)))
        for estimator in table["estimator"].unique(maintain_order=True):
            own = part.filter(pl.col("estimator") == estimator)
            if own.height:
                made.append(_line(row, estimator, own))
    return made


def _line(row: str, estimator: str, own: pl.DataFrame) -> Line:
    single = own.filter(pl.col("holds") == 1)
    answers = single.filter(pl.col("status") == "ok")
    stated = answers.filter(pl.col("states"))
    distance = stated["mahalanobis2"].to_numpy()
    inside = distance <= CHI2_95
    errors, semi = stated["error_deg"].to_numpy(), stated["semi_deg"].to_numpy()
    rms = float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan
    half = float(np.nanmedian(semi)) if np.isfinite(semi).any() else math.nan
    merged = own.filter((pl.col("holds") > 1) & (pl.col("status") == "ok") & pl.col("states"))
    # What holds several glints must be covered too, or say that something is wrong.
    told = [warned(flags) for flags in merged["flags"]]
    sound = np.count_nonzero((merged["mahalanobis2"].to_numpy() <= CHI2_95) | np.array(told, dtype=bool))
    everything = own.filter((pl.col("status") == "ok") & pl.col("states") & pl.col("matched"))
    quiet = np.array([not warned(flags) for flags in everything["flags"]], dtype=bool)
    silent = np.count_nonzero((everything["mahalanobis2"].to_numpy() > SILENT * CHI2_95) & quiet)
    covered = 100 * np.count_nonzero(inside) / max(len(inside), 1)
    # Highlights of a scene share its noise and its relief.
    low, high = share_interval(inside, stated["scene"].to_numpy()) if len(inside) else (math.nan, math.nan)
    return Line(
        row, estimator, answers.height, stated.height, single.height - answers.height,
        covered, 100 * low, 100 * high, half * math.sqrt(2) / rms, half, rms,
        float(np.median(errors)) if len(errors) else math.nan, 100 * silent / max(everything.height, 1),
        merged.height, 100 * sound / max(merged.height, 1),
    )  # fmt: skip


def warned(flags: str) -> bool:
    """Return whether an estimate's flags say that its normal may be wrong."""
    return bool(set(flags.split(",")) - QUIET_FLAGS - {""})


def text(made: Sequence[Line]) -> str:
    """Return the table as markdown."""
    head = (
        "| row | estimator | answers (failed) | covered, % (95 % interval) | semi-axis over RMS | semi-axis, deg | "
        "RMS, median error, deg | silent, % | merged: covered or flagged |"
    )
    body = [head, "|" + "---|" * 9]
    for line in made:
        covered = f"{line.covered:.1f} ({line.low:.0f} to {line.high:.0f})" if line.stated else "states none"
        body.append(
            f"| {line.row} | {line.estimator} | {line.answers} ({line.failures}) | {covered} | "
            f"{line.semi_over_rms:.2f} | {line.semi_deg:.3f} | {line.rms_deg:.3f}, {line.median_deg:.3f} | "
            f"{line.silent:.1f} | {line.merged_covered:.0f} % of {line.merged} |"
        )
    return "\n".join(body)
