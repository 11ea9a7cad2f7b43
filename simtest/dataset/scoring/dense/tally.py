"""Figures of the pixels of one frame, and of many frames together.

The scenes, not the pixels, are the sample (of a dataset the anatomies): frames of one scene differ in noise alone.
"""

from collections.abc import Sequence

import numpy as np

from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject
from simtest.runtime.statistics import Interval, mean_interval, median_interval, root_mean_square, share_interval

PENALTY = 90.0
"""An unanswered pixel counts as this angle, deg, in the penalised mean."""

QUANTILES = {"median": 0.5, "p95": 0.95}


def frame_figures(values: Array, below: Sequence[float], penalty: float | None = PENALTY) -> JsonObject:
    """Return the figures of a frame's pixels of one cell: shares are of all, the unanswered among them.

    Parameters
    ----------
    values : ndarray, shape (N,)
        At least one; NaN where there is no answer.
    below : sequence of float
        Thresholds; the share of the pixels below each is told.
    penalty : float or None
        What an unanswered pixel counts in `mean_penalised`; None where the values have no such figure.
    """
    own = values[np.isfinite(values)]
    n, missing = len(values), len(values) - len(own)
    quantiles = np.quantile(own, [*QUANTILES.values()]).tolist() if own.size else [None] * len(QUANTILES)
    return {
        "n": n, "n_unanswered": missing,
        "mean": float(own.mean()) if own.size else None, "rms": root_mean_square(own),
        **({} if penalty is None else {"mean_penalised": float((own.sum() + penalty * missing) / n)}),
        "share_unanswered": missing / n,
        **{f"below_{most:g}": np.count_nonzero(own < most) / n for most in below},
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }  # fmt: skip


def joined_figures(rows: Sequence[JsonObject], scenes: IntArray, settings: IntArray) -> JsonObject:
    """Return the figures of a cell over its frames, with 95 % intervals where these show two scenes or more.

    Means and shares are of all pixels; median and p95 are the medians over the frames of each frame's.

    Parameters
    ----------
    rows : sequence of dict
        `frame_figures` of each frame.
    scenes, settings : ndarray of int, shape (N,)
        Number of the scene and of the setting of each frame.
    """
    columns = {name: np.array([np.nan if row[name] is None else row[name] for row in rows], float) for name in rows[0]}
    pixels = columns.pop("n")
    answers = pixels - columns.pop("n_unanswered")
    found: JsonObject = {"frames": len(rows), "n": int(pixels.sum()), "n_unanswered": int((pixels - answers).sum())}
    intervals: JsonObject = {}
    for name, values in columns.items():
        known = np.isfinite(values)
        value, interval = _joined(
            name, values[known], scenes[known], settings[known], (answers if name in ("mean", "rms") else pixels)[known]
        )
        found[name] = value
        if interval[0] is not None and len(np.unique(scenes)) > 1:
            intervals[name] = list(interval)
    return found | {"ci95": intervals}


def _joined(
    name: str, values: Array, scenes: IntArray, settings: IntArray, counts: Array
) -> tuple[float | None, Interval]:
    if not len(values):
        return None, (None, None)
    if name in QUANTILES:
        return float(np.median(values)), median_interval(values, scenes, settings)
    root = np.sqrt if name == "rms" else float
    totals = counts * (values**2 if name == "rms" else values)
    interval_of = share_interval if name.startswith(("share", "below")) else mean_interval
    low, high = interval_of(totals, scenes, settings, counts)
    ends = (None, None) if low is None or high is None else (float(root(max(low, 0.0))), float(root(high)))
    return float(root(totals.sum() / counts.sum())), ends
