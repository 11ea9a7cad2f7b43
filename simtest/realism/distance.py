"""How far one set of frames is from another, statistic by statistic, with intervals over scenes.

A scene is what shows one anatomy: a film, or one picture. The distance of a statistic is the Wasserstein distance of
its two distributions over the spread of the real scenes: the mean distance of each real scene from all the others. At
1 the generated frames differ from the real ones as much as a real scene does from other real scenes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.errors import InputError
from simtest.realism.frame_statistics import COLUMNS, STATISTICS, Measured, Statistic
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer

VERDICTS = ("near", "between", "far", "too few scenes")

LEAST_SCENES = 5
"""Fewer scenes on a side carry no verdict."""

NEAR = 1.5
"""A distance up to here is near; one is far where it is larger and its interval lies above 1."""

RESAMPLES, LEVEL = 400, 0.95

BLOCK_VALUES = 2_000_000
"""Values of drawn scenes that are held at a time."""

Scenes = Mapping[str, Measured]
"""Measured values by scene: those of all its frames, one after the other."""


@dataclass(frozen=True)
class StatisticDistance:
    """Distance of a statistic between two sets of frames.

    Parameters
    ----------
    statistic : Statistic
        Which.
    distance : float
        Mean over the statistic's columns; NaN where a side has fewer than two scenes that tell it.
    interval : tuple of float
        95 % interval by bootstrap over the scenes of both sides.
    n_real, n_generated : int
        Scenes that tell it.
    """

    statistic: Statistic
    distance: float
    interval: tuple[float, float]
    n_real: int
    n_generated: int

    @property
    def verdict(self) -> str:
        """Whether it is "near" or "far", "between", or judged by "too few scenes"."""
        if min(self.n_real, self.n_generated) < LEAST_SCENES or not np.isfinite(self.distance):
            return "too few scenes"
        if self.distance <= NEAR:
            return "near"
        return "far" if self.interval[0] > 1 else "between"


def by_scene(frames: Sequence[tuple[str, Measured]]) -> dict[str, Measured]:
    """Collect the values of frames, each with its scene's name."""
    held: dict[str, dict[str, list[Array]]] = {}
    for scene, values in frames:
        columns = held.setdefault(scene, {name: [] for name in COLUMNS})
        for name in COLUMNS:
            columns[name].append(values[name])
    return {scene: {name: np.concatenate(parts) for name, parts in held[scene].items()} for scene in held}


def distances(real: Scenes, generated: Scenes, seed: int = 0) -> list[StatisticDistance]:
    """Compare two sets of frames by every statistic.

    Raises
    ------
    InputError
        If a side has no scene.
    """
    for name, scenes in (("real", real), ("generated", generated)):
        if not scenes:
            raise InputError(f"realism: no {name} frames; at least one is needed")
    return [_distance(statistic, real, generated, seed) for statistic in STATISTICS]


def _distance(statistic: Statistic, real: Scenes, generated: Scenes, seed: int) -> StatisticDistance:
    rng = from_integer(seed)
    sides = [[[values[c] for values in scenes.values() if len(values[c])] for c in statistic.columns]
             for scenes in (real, generated)]  # fmt: skip
    counts = [min(len(scenes) for scenes in side) for side in sides]
    if counts[0] < 2 or counts[1] < 1:
        return StatisticDistance(statistic, np.nan, (np.nan, np.nan), *counts)
    columns = [_column_distance(a, b, rng) for a, b in zip(*sides, strict=True)]
    value, samples = np.mean([c[0] for c in columns]), np.mean([c[1] for c in columns], axis=0)
    # Order statistics: between infinite distances nothing can be interpolated.
    low, high = np.quantile(samples, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="nearest")
    return StatisticDistance(statistic, float(value), (float(low), float(high)), *counts)


def _column_distance(real: list[Array], generated: list[Array], rng: np.random.Generator) -> tuple[float, Array]:
    """Return the distance over the real scenes' spread, and that of resampled scenes, shape (RESAMPLES,)."""
    grid = _grid([*real, *generated])
    # Distribution functions of all scenes on one grid: each resample is then a mean of rows.
    own, other = (np.stack([_steps(v, grid) for v in side]) for side in (real, generated))
    widths = np.diff(grid)

    def gap(first: Array, second: Array) -> Array:
        return np.asarray(np.abs(first - second) @ widths)

    n = len(real)
    rest = (own.sum(axis=0) - own) / (n - 1)
    spread = float(gap(own, rest).mean())
    if spread <= 0:
        # All real scenes are alike: any difference is infinitely many spreads.
        same = gap(own.mean(axis=0), other.mean(axis=0)) <= 0
        return (0.0, np.zeros(RESAMPLES)) if same else (np.inf, np.full(RESAMPLES, np.inf))
    value = float(gap(own.mean(axis=0), other.mean(axis=0))) / spread
    return value, gap(*(_resampled(side, rng) for side in (own, other))) / spread


def _resampled(scenes: Array, rng: np.random.Generator) -> Array:
    """Return the mean of as many scenes drawn again, RESAMPLES times: shape (RESAMPLES, grid)."""
    drawn = rng.integers(len(scenes), size=(RESAMPLES, len(scenes)))
    # In blocks: all of them at once would not fit into memory.
    blocks = np.array_split(drawn, max(1, scenes.size * RESAMPLES // BLOCK_VALUES))
    return np.concatenate([scenes[rows].mean(axis=1) for rows in blocks])


def _grid(values: list[Array]) -> Array:
    """Return the values at which a distribution function may step, thinned where there are many."""
    every = np.unique(np.concatenate(values))
    if len(every) > 2000:
        every = np.unique(np.quantile(every, np.linspace(0, 1, 2000)))
    return every if len(every) > 1 else np.array([every[0], every[0] + 1.0])


def distance_text(value: float) -> str:
    """Write a distance with two decimals; NaN becomes a dash, infinity its sign."""
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.2f}"


def mean_distribution(scenes: Scenes, column: str, at: Array) -> Array:
    """Return the distribution function of a column at values, each scene with the same weight; NaN without a scene."""
    held = [values[column] for values in scenes.values() if len(values[column])]
    if not held:
        return np.full(len(at), np.nan)
    return np.asarray(np.mean([np.searchsorted(np.sort(v), at, side="right") / len(v) for v in held], axis=0))


def quartiles(scenes: Scenes, column: str) -> tuple[float, float, float] | None:
    """Return where `mean_distribution` reaches 1/4, 1/2 and 3/4; None without a scene."""
    held = [values[column] for values in scenes.values() if len(values[column])]
    if not held:
        return None
    weights = np.concatenate([np.full(len(values), 1 / len(values)) for values in held])
    found = np.quantile(np.concatenate(held), (0.25, 0.5, 0.75), weights=weights, method="inverted_cdf")
    low, middle, high = (float(value) for value in found)
    return low, middle, high


def _steps(values: Array, grid: Array) -> Array:
    """Return the distribution function of values on the grid's intervals."""
    return np.asarray(np.searchsorted(np.sort(values), grid[:-1], side="right") / len(values))
