"""Cores drawn for the benchmark's ranking, as the part tissue has them: 240 scenes in four cases, 40 % missed."""

from collections.abc import Sequence
from unittest.mock import patch

import numpy as np

from simtest.bench.scores import CAP_DEG
from simtest.bench.table import ALPHA, Ranking, SceneSums, rank
from simtest.runtime.arrays import Array

SCENES = (60, 60, 60, 60)
"""Scenes of each case, as in the part tissue."""

TYPICAL_DEG, MISSED = 1.7, 0.4
"""Median error of an answer and share of missed highlights, as the sightline has them on tissue."""


def cores(seed: int, factors: Sequence[float], shared: float = 0.5) -> list[SceneSums]:
    """Return the sums of cores on the same scenes, whose errors are a factor times a common law.

    Each scene has no highlight or up to four, of which all cores miss the same. A share `shared` of the variance of
    the answers' logarithm is of the scene and the highlight, the rest is each core's own noise.
    """
    rng = np.random.default_rng(seed)
    found: list[dict[str, list[list[float]]]] = [{} for _ in factors]
    for case, scenes in enumerate(SCENES):
        numbers = rng.integers(0, 5, scenes)
        scene_of = np.repeat(np.arange(scenes), numbers)
        common = np.sqrt(shared) * 0.6 * (rng.standard_normal(scenes)[scene_of] + rng.standard_normal(len(scene_of)))
        missed = rng.random(len(scene_of)) < MISSED
        for core, factor in zip(found, factors, strict=True):
            own = np.sqrt(1 - shared) * 0.8 * rng.standard_normal(len(scene_of))
            errors = np.where(missed, CAP_DEG, np.minimum(factor * TYPICAL_DEG * np.exp(common + own), CAP_DEG))
            core[f"case {case}"] = np.stack([numbers, np.bincount(scene_of, errors, scenes)], axis=1).tolist()
    return list(found)


def rankings(factors: Sequence[float], tables: int, margin: bool = True, alpha: float = ALPHA) -> list[Ranking]:
    """Return the tables of as many draws; without the margin where that is asked for."""
    if margin:
        return [rank([cores(seed, factors)], alpha) for seed in range(tables)]
    with patch("simtest.bench.table.margin", lambda first, second: np.zeros(())):
        return [rank([cores(seed, factors)], alpha) for seed in range(tables)]


def claims(found: Sequence[Ranking]) -> Array:
    """Return the claims of all tables, as `Ranking.better`; shape (tables, N, N)."""
    return np.array([table.better for table in found])


def with_any(found: Sequence[Ranking]) -> float:
    """Return the share of tables with any claim."""
    return float((claims(found) != 0).any(axis=(1, 2)).mean())
