"""The figures of a part: accuracy with intervals over scenes, refusals and misses, and the uncertainty."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.bench.ranking import CAP_DEG
from simtest.bench.suite import Layout, digest_of
from simtest.bench.uncertainty import UncertaintyScore, score_uncertainty
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import Json, JsonObject
from simtest.runtime.statistics import Interval, mean_interval, median_interval
from simtest.validation.statistics import figures

HASHED = (
    "setting", "realisation", "specularity", "true_id", "status", "target", "error_deg", "normal_x", "normal_y",
    "normal_z", "cov_11", "cov_12", "cov_22", "mahalanobis2", "n_candidates",
)  # fmt: skip
"""Columns that the hash of a part's results is of."""

SUM_DIGITS = 6
"""Decimals of the sums by scene: the score is computed of the rounded ones, so that it follows from a certificate."""

Span = tuple[float, float]


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
        95 % interval of the median, over scenes; the cases are frozen, and their differences no chance.
    score_deg, score_interval
        What cores are ranked by, and its interval: the mean of the errors, each at most `CAP_DEG`, with `CAP_DEG` for
        each highlight that was refused or missed.
    scenes : dict
        By case, for each scene: its number of highlights, and the sum of their errors as the score takes them, deg.
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
    median_interval: Span | None
    mean_deg: float | None
    p95_deg: float | None
    score_deg: float | None
    score_interval: Span | None
    scenes: dict[str, list[tuple[int, float]]]
    uncertainty: UncertaintyScore
    results: str

    def to_json(self) -> JsonObject:
        """Return the score as a JSON object."""
        spans = {name: None if (held := getattr(self, name)) is None else list(held)
                 for name in ("median_interval", "score_interval")}  # fmt: skip
        scenes: JsonObject = {case: [list(scene) for scene in held] for case, held in self.scenes.items()}
        return {**vars(self), **spans, "scenes": scenes, "uncertainty": self.uncertainty.to_json()}


def score_part(rows: pl.DataFrame, layout: Layout) -> PartScore:
    """Compute the figures of a part's rows.

    Raises `ValueError` for rows of scenes that the part does not have.
    """
    told = figures(rows)
    true = rows.filter(pl.col("true_id").is_not_null())
    answered = true.filter(pl.col("status") == "ok")
    errors = answered["error_deg"].to_numpy()
    capped = np.where(true["status"] == "ok", true["error_deg"].fill_null(CAP_DEG).clip(0.0, CAP_DEG), CAP_DEG)
    scenes = scene_sums(true, capped, layout)
    numbers, sums = np.array([scene for held in scenes.values() for scene in held]).T
    cases = np.repeat(np.arange(len(scenes)), [len(held) for held in scenes.values()])
    return PartScore(
        n=told.n,
        answered=told.n_ok,
        missed=told.n_missed,
        false=told.n_false,
        refused=told.n_failed_by_reason,
        median_deg=told.median_deg,
        median_interval=_span(median_interval(errors, *scenes_of(answered, layout))),
        mean_deg=told.mean_deg,
        p95_deg=told.p95_deg,
        score_deg=float(sums.sum() / numbers.sum()) if len(capped) else None,
        score_interval=_span(mean_interval(sums, None, cases, numbers), CAP_DEG) if len(capped) else None,
        scenes=scenes,
        uncertainty=score_uncertainty(answered, *scenes_of(answered, layout)),
        results=results_hash(rows),
    )


def scenes_of(rows: pl.DataFrame, layout: Layout) -> tuple[IntArray, IntArray]:
    """Return a number for the scene of each row, whose frames differ in noise alone, and one for its case."""
    scenes: dict[tuple[str, int], int] = {}
    cases = {case: number for number, case in enumerate(layout)}
    numbers = [(scenes.setdefault(key, len(scenes)), cases.get(key[0], 0)) for key in _scene_keys(rows, layout)]
    return np.array([scene for scene, _ in numbers], dtype=int), np.array([case for _, case in numbers], dtype=int)


def scene_sums(rows: pl.DataFrame, values: Array, layout: Layout) -> dict[str, list[tuple[int, float]]]:
    """Return how many rows each scene has, and the sum of their values, by case; scenes without rows are held."""
    numbers = {case: [0] * scenes for case, (scenes, _) in layout.items()}
    sums = {case: [0.0] * scenes for case, (scenes, _) in layout.items()}
    for (case, scene), value in zip(_scene_keys(rows, layout), values.tolist(), strict=True):
        numbers[case][scene] += 1
        sums[case][scene] += value
    return {
        case: [(number, round(total, SUM_DIGITS)) for number, total in zip(held, sums[case], strict=True)]
        for case, held in numbers.items()
    }


def _scene_keys(rows: pl.DataFrame, layout: Layout) -> list[tuple[str, int]]:
    """Return the case of each row, and the number of its scene there."""
    keys = []
    for case, number in zip(rows["setting"].to_list(), rows["realisation"].to_list(), strict=True):
        scenes, frames = layout.get(case, (0, 1))
        if not 0 <= number < scenes * frames:
            raise ValueError(f"setting {case!r}, realisation {number}: the part has no such frame")
        keys.append((case, number // frames))
    return keys


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


def _span(interval: Interval, most: float = 180.0) -> Span | None:
    """Return an interval of angles up to the largest; None where there is none."""
    low, high = interval
    return None if low is None or high is None else (max(low, 0.0), min(high, most))
