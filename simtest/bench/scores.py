"""The figures of a part: accuracy with intervals over scenes, refusals and misses, and the uncertainty."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.bench.suite import digest_of
from simtest.bench.uncertainty import UncertaintyScore, score_uncertainty
from simtest.runtime.arrays import Array
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.seeds import from_integer
from simtest.validation.statistics import PENALTY_DEG, figures

RESAMPLES = 1000
"""Of the bootstrap over scenes; its seed is fixed, so that the same rows give the same intervals."""

_SEED = 1

HASHED = (
    "setting", "realisation", "specularity", "true_id", "status", "target", "error_deg", "normal_x", "normal_y",
    "normal_z", "cov_11", "cov_12", "cov_22", "mahalanobis2", "n_candidates",
)  # fmt: skip
"""Columns that the hash of a part's results is of."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class PartScore:
    """The figures of one part, or of several together.

    Parameters
    ----------
    n, answered, missed, false : int
        True highlights, how many of them were answered and not found, and false detections.
    refused : dict
        Refused highlights by reason.
    median_deg, mean_deg, p95_deg : float or None
        Of the errors of the answers.
    median_interval : tuple of float or None
        95 % interval of the median, by bootstrap over scenes.
    penalised_deg, penalised_interval
        Mean error with 90 deg for each highlight that was refused or missed, and its interval.
    uncertainty : UncertaintyScore
        Of the answers that state one.
    results : str
        SHA-256 of the rows.
    """

    n: int
    answered: int
    missed: int
    false: int
    refused: dict[str, int]
    median_deg: float | None
    median_interval: Interval | None
    mean_deg: float | None
    p95_deg: float | None
    penalised_deg: float | None
    penalised_interval: Interval | None
    uncertainty: UncertaintyScore
    results: str

    def to_json(self) -> JsonObject:
        """Return the score as a JSON object."""
        spans = {name: None if (held := getattr(self, name)) is None else list(held)
                 for name in ("median_interval", "penalised_interval")}  # fmt: skip
        return {**vars(self), **spans, "uncertainty": self.uncertainty.to_json()}


def score_part(rows: pl.DataFrame, frames: Mapping[str, int]) -> PartScore:
    """Compute the figures of a part's rows; `frames` says of how many frames each case's scenes are."""
    told = figures(rows)
    true = rows.filter(pl.col("true_id").is_not_null())
    answered = true.filter(pl.col("status") == "ok")
    errors = answered["error_deg"].to_numpy()
    penalised = np.where(true["status"] == "ok", true["error_deg"].fill_null(PENALTY_DEG), PENALTY_DEG)
    return PartScore(
        n=told.n,
        answered=told.n_ok,
        missed=told.n_missed,
        false=told.n_false,
        refused=told.n_failed_by_reason,
        median_deg=told.median_deg,
        median_interval=_interval(errors, scenes_of(answered, frames), median=True),
        mean_deg=told.mean_deg,
        p95_deg=told.p95_deg,
        penalised_deg=told.mean_penalised_deg,
        penalised_interval=_interval(penalised, scenes_of(true, frames)),
        uncertainty=score_uncertainty(answered, scenes_of(answered, frames)),
        results=results_hash(rows),
    )


def scenes_of(rows: pl.DataFrame, frames: Mapping[str, int]) -> Array:
    """Return a number for the scene of each row: frames of one scene differ in noise alone."""
    settings, numbers = rows["setting"].to_list(), rows["realisation"].to_list()
    index: dict[tuple[str, int], int] = {}
    keys = [(s, k // frames.get(s, 1)) for s, k in zip(settings, numbers, strict=True)]
    return np.array([index.setdefault(key, len(index)) for key in keys], dtype=int)


def results_hash(rows: pl.DataFrame) -> str:
    """Return the SHA-256 of a part's rows: of what was answered and how it was judged, in their order."""
    held: list[Json] = [list(map(_plain, row)) for row in rows.select(HASHED).iter_rows()]
    return digest_of([list(HASHED), held])


def _plain(value: Any) -> Json:
    """Return a value as it is hashed; JSON knows neither NaN nor infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    plain: Json = value
    return plain


def _interval(values: Array, scenes: Array, median: bool = False) -> Interval | None:
    """Compute the 95 % interval of a mean or median by bootstrap over scenes; None with fewer than two of them."""
    count = len(np.unique(scenes))
    if count < 2:
        return None
    # scenes are numbered in order of appearance
    index = np.unique(scenes, return_inverse=True)[1]
    picks = from_integer(_SEED).integers(0, count, size=(RESAMPLES, count))
    times = np.stack([np.bincount(pick, minlength=count) for pick in picks])
    if median:
        order = np.argsort(values, kind="stable")
        weights = np.cumsum(times[:, index[order]], axis=1)
        at = (weights >= weights[:, -1:] / 2).argmax(axis=1)
        drawn = values[order][at]
    else:
        sums, rows = np.bincount(index, weights=values), np.bincount(index)
        drawn = (times @ sums) / (times @ rows)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)
