"""Summary figures of many errors."""

from typing import Any

import numpy as np
import polars as pl
from scipy import stats

PENALTY_DEG = 90.0
"""What a failed or missed row counts in mean_penalised_deg: refusing is no way to a good figure."""

CONFIDENCE = 0.95


def summarise(results: pl.DataFrame) -> dict[str, dict[str, dict[str, Any]]]:
    """Summarise results by setting and estimator (design.md section 3, summary.json).

    Parameters
    ----------
    results : polars.DataFrame
        Rows of one experiment.

    Returns
    -------
    dict
        ``{setting: {estimator: figures}}`` in order of appearance; a figure is None where nothing answered.
    """
    summary: dict[str, dict[str, dict[str, Any]]] = {}
    for (setting, estimator), rows in results.group_by("setting", "estimator", maintain_order=True):
        summary.setdefault(str(setting), {})[str(estimator)] = figures(rows)
    return summary


def figures(rows: pl.DataFrame) -> dict[str, Any]:
    """Give the figures of the rows of one setting and estimator.

    `n` counts true highlights (answered, failed or missed); false detections, answered or not, are counted apart.
    """
    true = rows.filter(pl.col("true_id").is_not_null())
    answered = true.filter(pl.col("status") == "ok")
    errors = answered["error_deg"].to_numpy()
    failed = true.filter(~pl.col("status").is_in(["ok", "missed"]))["status"].value_counts()
    unanswered = true.height - len(errors)
    lo, hi = mean_interval(errors)
    distances = answered["mahalanobis2"].drop_nulls().to_numpy()
    return {
        "n": true.height,
        "n_ok": len(errors),
        "n_failed_by_reason": dict(sorted(failed.iter_rows())),
        "n_missed": true.filter(pl.col("status") == "missed").height,
        "n_false": rows.filter(pl.col("true_id").is_null()).height,
        "mean_deg": _or_none(np.mean, errors),
        "mean_oracle_deg": _or_none(np.mean, answered["error_oracle_deg"].to_numpy()),
        "rms_deg": _or_none(lambda e: np.sqrt(np.mean(e**2)), errors),
        "std_deg": float(np.std(errors, ddof=1)) if len(errors) > 1 else None,
        "median_deg": _or_none(np.median, errors),
        "p95_deg": _or_none(lambda e: np.percentile(e, 95), errors),
        "max_deg": _or_none(np.max, errors),
        "mean_penalised_deg": _or_none(np.mean, np.concatenate([errors, np.full(unanswered, PENALTY_DEG)])),
        "ci95_deg": [lo, hi],
        "coverage95": float(np.mean(distances <= stats.chi2.ppf(CONFIDENCE, 2))) if len(distances) else None,
    }


def _or_none(statistic: Any, values: np.ndarray) -> float | None:
    return float(statistic(values)) if len(values) else None


def mean_interval(values: np.ndarray) -> tuple[float | None, float | None]:
    """Give Student's 95 % interval of the mean of angles; None with fewer than two values."""
    low, high = student_interval(values)
    # An angle is not negative, nor is its mean.
    return None if low is None else max(low, 0.0), high


def student_interval(values: np.ndarray) -> tuple[float | None, float | None]:
    """Give Student's 95 % interval of the mean, such as of paired differences; None with fewer than two values."""
    if len(values) < 2:
        return None, None
    half = stats.t.ppf((1 + CONFIDENCE) / 2, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values) - half), float(np.mean(values) + half)
