"""Figures of a night's rows by place, and the hash of each place's results."""

import hashlib
from typing import Any

import numpy as np
import polars as pl
from scipy import stats

from simtest.nightly.gate.quantities import RATIO_OFF
from simtest.nightly.gate.records import FIGURES, PLACE
from simtest.validation.statistics import CONFIDENCE, figures, student_interval

DIGEST_KEYS = ("realisation", "true_id", "specularity", "seed")
"""Order of the rows within a place."""

DIGEST_NUMBERS = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "n_candidates", "choice_margin", "rank_correct",
    "normal_x", "normal_y", "normal_z", "truth_x", "truth_y", "truth_z", "bp_x_px", "bp_y_px", "bp_true_x_px",
    "bp_true_y_px", "look_x_px", "look_y_px", "cov_11", "cov_12", "cov_22", "mahalanobis2", "distance_mm", "kd_min",
    "kd_max", "eps_over_d", "peak_snr", "axis_ratio", "axis_ratio_law", "saturated_share", "gain_1", "gain_2",
    "gain_error", "gain_oracle_error", "direction_error_deg",
)  # fmt: skip
"""Result columns that are hashed, in this order, beside keys and status; messages and names are not."""


def setting_figures(rows: pl.DataFrame) -> pl.DataFrame:
    """Give the figures of a night's rows by place.

    Parameters
    ----------
    rows : polars.DataFrame
        Columns of `simtest.validation.results_table.SCHEMA`.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, kind "setting", in the order of the rows: of each place `n` (true highlights), `n_ok`,
        `failed`, `missed`, `unanswered` (shares of n), `false` (detections a frame), `mean_deg`, `median_deg`,
        `p95_deg`, `mean_penalised_deg`, `coverage95`, `axis_ratio` (mean deviation from the law over the law, at most 1
        a row) and `axis_ratio_median`. Figures that nothing is known of are left out.
    """
    made: list[dict[str, Any]] = []
    for place, own in rows.group_by(*PLACE, maintain_order=True):
        names = {"kind": "setting", **dict(zip(PLACE, place, strict=True)), "digest": digest(own)}
        made += [{**names, **figure} for figure in _figures_of(own)]
    return pl.DataFrame(made, schema=FIGURES)


def _figures_of(rows: pl.DataFrame) -> list[dict[str, Any]]:
    """Give the figures of one place."""
    found, frames = figures(rows), rows["realisation"].n_unique()
    n, failed = found.n, sum(found.n_failed_by_reason.values())
    made = [_figure("n", "", n, n), _figure("n_ok", "", found.n_ok, n)]
    if n:
        unanswered = failed + found.n_missed
        counts = {"failed": failed, "missed": found.n_missed, "unanswered": unanswered}
        made += [_share(name, count, n) for name, count in counts.items()]
    made.append(_figure("false", "a frame", found.n_false / frames, frames))
    low, high = found.ci95_deg
    made.append(_figure("mean_deg", "deg", found.mean_deg, found.n_ok, low, high))
    for name in ("median_deg", "p95_deg", "mean_penalised_deg"):
        made.append(_figure(name, "deg", getattr(found, name), n if name == "mean_penalised_deg" else found.n_ok))
    if found.coverage95 is not None:
        judged = _judged(rows)
        made.append(_share("coverage95", round(found.coverage95 * judged), judged))
    off = rows.select(off=RATIO_OFF)["off"].drop_nulls().to_numpy()
    if len(off):
        low, high = student_interval(off)
        about = "abs(axis ratio / law - 1)"
        made.append(_figure("axis_ratio", "", float(np.mean(off)), len(off), low, high, about))
        made.append(_figure("axis_ratio_median", "", float(np.median(off)), len(off), about=about))
    return [figure for figure in made if figure["value"] is not None]


def _judged(rows: pl.DataFrame) -> int:
    """Count the answers that state an uncertainty, as `figures` does."""
    answered = rows.filter(pl.col("true_id").is_not_null() & (pl.col("status") == "ok"))
    return answered["mahalanobis2"].drop_nulls().len()


def _figure(
    quantity: str, unit: str, value: float | None, n: int, low: float | None = None, high: float | None = None,
    about: str = "",
) -> dict[str, Any]:  # fmt: skip
    known = {"value": value, "low": low, "high": high}
    # An answer without a number makes a figure of its place unknown, not no number.
    finite = {name: float(v) if v is not None and np.isfinite(v) else None for name, v in known.items()}
    return {"quantity": quantity, "unit": unit, **finite, "n": n, "about": about}


def _share(quantity: str, count: int, n: int) -> dict[str, Any]:
    """Give a share with its exact interval [Clopper and Pearson 1934]."""
    tail = (1 - CONFIDENCE) / 2
    low = float(stats.beta.ppf(tail, count, n - count + 1)) if count else 0.0
    high = float(stats.beta.isf(tail, count + 1, n - count)) if count < n else 1.0
    return _figure(quantity, "", count / n, n, low, high, f"{count} of {n}")


def digest(rows: pl.DataFrame) -> str:
    """Hash the results of a place: equal for two nights exactly where all their numbers are the same bytes.

    Parameters
    ----------
    rows : polars.DataFrame
        Of one place, in any order.

    Returns
    -------
    str
        SHA-256, hexadecimal, over the rows sorted by `DIGEST_KEYS`: the bytes of where the columns are null, those of
        the keys as int64 and of the numbers as float64, little-endian, and the status. A column that is absent counts
        as null.
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
