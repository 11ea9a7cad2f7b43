"""Figures of a run's rows by cell, and the hash of each cell's results."""

import hashlib
from collections.abc import Iterator

import numpy as np
import polars as pl
from scipy import stats

from simtest.nightly.gate.quantities import RATIO_OFF
from simtest.nightly.records import CELL, Cell, Figure, figure_table
from simtest.validation.statistics import CONFIDENCE, figures, student_interval

DIGEST_KEYS = ("realisation", "true_id", "specularity", "seed")
"""Order of the rows within a cell."""

DIGEST_NUMBERS = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "n_candidates", "choice_margin", "rank_correct",
    "normal_x", "normal_y", "normal_z", "truth_x", "truth_y", "truth_z", "bp_x_px", "bp_y_px", "bp_true_x_px",
    "bp_true_y_px", "look_x_px", "look_y_px", "cov_11", "cov_12", "cov_22", "mahalanobis2", "distance_mm", "kd_min",
    "kd_max", "eps_over_d", "peak_snr", "axis_ratio", "axis_ratio_law", "saturated_share", "gain_1", "gain_2",
    "gain_error", "gain_oracle_error", "direction_error_deg",
)  # fmt: skip
"""Result columns that are hashed, in this order, beside keys and status; messages and names are not."""


def setting_figures(rows: pl.DataFrame) -> pl.DataFrame:
    """Compute the figures of a run's rows by cell.

    Parameters
    ----------
    rows : polars.DataFrame
        Columns of `simtest.validation.results_table.SCHEMA`.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, kind "setting", in the order of the rows: of each cell `n` (true highlights), `n_ok`,
        `failed`, `missed`, `unanswered` (shares of n), `false` (detections a frame), `mean_deg`, `median_deg`,
        `p95_deg`, `mean_penalised_deg`, `coverage95`, `axis_ratio` (mean deviation from the law over the law, at most 1
        a row) and `axis_ratio_median`. Unknown figures are left out.
    """
    cells = rows.group_by(CELL, maintain_order=True)
    return figure_table(figure for cell, own in cells for figure in _cell_figures(Cell(*cell), own))


def _cell_figures(cell: Cell, rows: pl.DataFrame) -> Iterator[Figure]:
    """Yield the known figures of one cell."""
    hashed = digest(rows)

    def figure(
        quantity: str, unit: str, value: float | None, n: int,
        interval: tuple[float | None, float | None] = (None, None), about: str = "",
    ) -> Iterator[Figure]:  # fmt: skip
        # A result that is no number makes a figure of its cell unknown.
        value, low, high = (float(v) if v is not None and np.isfinite(v) else None for v in (value, *interval))
        if value is not None:
            yield Figure("setting", cell, quantity, unit, value, low, high, n, None, hashed, about)

    def share(quantity: str, count: int, n: int) -> Iterator[Figure]:
        return figure(quantity, "", count / n, n, _share_interval(count, n), f"{count} of {n}")

    # Counts and shares
    found, frames = figures(rows), rows["realisation"].n_unique()
    n, n_ok, missed, failed = found.n, found.n_ok, found.n_missed, sum(found.n_failed_by_reason.values())
    yield from figure("n", "", n, n)
    yield from figure("n_ok", "", n_ok, n)
    if n:
        yield from share("failed", failed, n)
        yield from share("missed", missed, n)
        yield from share("unanswered", failed + missed, n)
    yield from figure("false", "a frame", found.n_false / frames, frames)
    # Errors
    yield from figure("mean_deg", "deg", found.mean_deg, n_ok, found.ci95_deg)
    yield from figure("median_deg", "deg", found.median_deg, n_ok)
    yield from figure("p95_deg", "deg", found.p95_deg, n_ok)
    yield from figure("mean_penalised_deg", "deg", found.mean_penalised_deg, n)
    if found.coverage95 is not None:
        stated = _results_with_region(rows)
        yield from share("coverage95", round(found.coverage95 * stated), stated)
    # Axis ratios against their law
    off = rows.select(off=RATIO_OFF)["off"].drop_nulls().to_numpy()
    if len(off):
        about = "abs(axis ratio / law - 1)"
        yield from figure("axis_ratio", "", float(np.mean(off)), len(off), student_interval(off), about)
        yield from figure("axis_ratio_median", "", float(np.median(off)), len(off), about=about)


def _results_with_region(rows: pl.DataFrame) -> int:
    """Count the results that state an uncertainty, as `figures` does."""
    answered = rows.filter(pl.col("true_id").is_not_null() & (pl.col("status") == "ok"))
    return answered["mahalanobis2"].drop_nulls().len()


def _share_interval(count: int, n: int) -> tuple[float, float]:
    """Compute the exact interval of a share [Clopper and Pearson 1934]."""
    tail = (1 - CONFIDENCE) / 2
    low = float(stats.beta.ppf(tail, count, n - count + 1)) if count else 0.0
    high = float(stats.beta.isf(tail, count + 1, n - count)) if count < n else 1.0
    return low, high


def digest(rows: pl.DataFrame) -> str:
    """Hash a cell's results, rows in any order: equal for two runs exactly where all numbers are the same bytes.

    SHA-256, hexadecimal, over the rows sorted by `DIGEST_KEYS`: which entries are null, the keys as int64, the numbers
    as float64, little-endian, and the status. A column that is absent counts as null.
    """
    ordered = rows.sort(*DIGEST_KEYS, nulls_last=True)
    found = hashlib.sha256(f"{ordered.height} {DIGEST_KEYS} {DIGEST_NUMBERS}".encode())
    for names, kind, dtype in ((DIGEST_KEYS, pl.Int64, "<i8"), (DIGEST_NUMBERS, pl.Float64, "<f8")):
        columns = [(pl.col(name) if name in ordered.columns else pl.lit(None)).cast(kind).alias(name) for name in names]
        table = ordered.select(columns)
        found.update(np.ascontiguousarray(table.select(pl.all().is_null()).to_numpy()).tobytes())
        found.update(np.ascontiguousarray(table.fill_null(0).to_numpy(), dtype=dtype).tobytes())
    found.update("\n".join(ordered["status"].fill_null("").to_list()).encode())
    return found.hexdigest()
