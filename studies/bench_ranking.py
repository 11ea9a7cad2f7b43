"""How often the benchmark's ranking claims a difference that is not there, and how large one it sees.

``python -m studies.bench_ranking`` draws the sums by scene of six cores as the part tissue has them, 240 scenes in four
cases with 40 % of the highlights missed by all, and prints the share of tables with any claim between equal cores, with
and without the margin, and the share of claims against a core whose errors are larger by a factor.
"""

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


def main() -> None:
    """Print the risk and the power."""
    for count, tables in ((2, 3000), (6, 1500)):
        plain, kept = (with_any(rankings([1.0] * count, tables, margin)) for margin in (False, True))
        print(f"{count} equal cores: {100 * plain:.1f} % of {tables} tables order any without the margin, "
              f"{100 * kept:.1f} % with it", flush=True)  # fmt: skip
    for factor in (1.25, 1.5, 1.75, 2.0):
        found = rankings([1.0] * 5 + [factor], 200)
        gain = np.mean([table.scores[5] / table.scores[0] - 1 for table in found])
        seen, wrong = ((claims(found)[:, 5, :5] == sign).mean() for sign in (-1, 1))
        print(f"errors {factor:g} times as large, score {100 * gain:.0f} % larger: {100 * seen:.0f} % of pairs are "
              f"ordered, {100 * wrong:.0f} % wrongly", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
