"""A frame's measured statistics as one vector of numbers that are near normal."""

from collections.abc import Callable

import numpy as np

from simtest.realism.frame_statistics import Measured
from simtest.runtime.arrays import Array

Reduce = Callable[[Array], float]

LEAST_VALUES = 3
"""Of fewer highlights no spread is taken."""


def _log1p(values: Array) -> float:
    return float(np.log1p(values[0]))


def _level(values: Array) -> float:
    return float(np.median(values))


def _mean_log(values: Array) -> float:
    return float(np.mean(np.log(np.maximum(values, 1e-6))))


def _spread_log(values: Array) -> float:
    # Of near equal values the logarithm of the spread has no lower end.
    logs = np.log(np.maximum(values, 1e-6))
    return float(np.std(logs)) if len(values) >= LEAST_VALUES else np.nan


def _spread(values: Array) -> float:
    return float(np.log(np.std(values) + 1e-3)) if len(values) >= LEAST_VALUES else np.nan


def _log(values: Array) -> float:
    return float(np.log(np.maximum(values[0], 1e-4)))


def _as_is(values: Array) -> float:
    return float(values[0])


SUMMARIES: tuple[tuple[str, str, Reduce], ...] = (
    ("count", "per_frame", _log1p),
    ("radius", "radius", _mean_log),
    ("radius spread", "radius", _spread_log),
    ("axis ratio", "axis_ratio", _level),
    ("clipped", "clipped", _as_is),
    ("area", "area", lambda values: float(np.log(values[0] + 1e-4))),
    ("clustering", "clustering", _mean_log),
    ("halo", "halo", _level),
    ("halo spread", "halo", _spread),
    ("lightness", "l_mean", _as_is),
    ("lightness spread", "l_sd", _log),
    ("red-green", "a_mean", _as_is),
    ("red-green spread", "a_sd", _log),
    ("yellow-blue", "b_mean", _as_is),
    ("yellow-blue spread", "b_sd", _log),
    ("falloff", "falloff", _as_is),
    ("spectrum", "spectrum", _as_is),
    ("vessels", "vessels", _log),
    ("noise", "noise", _log),
)
"""Name of each summary, the measured column that it is of, and how it is taken."""

NAMES = tuple(name for name, _, _ in SUMMARIES)


def summarise(measured: Measured) -> Array:
    """Return a frame's summaries, shape (S,); NaN where the frame does not tell one, such as without highlights."""
    return np.array([reduce(measured[column]) if len(measured[column]) else np.nan for _, column, reduce in SUMMARIES])
