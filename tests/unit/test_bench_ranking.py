"""The ranking of cores: how often it claims a difference that is not there, and how often it sees one that is."""

import numpy as np
import pytest

from simtest.bench.ranking import ALPHA, CAP_DEG, SceneSums, agreement, margin, rank
from simtest.runtime.arrays import Array

SCENES = (60, 60, 60, 60)
"""Scenes of each case, as in the part tissue."""

TYPICAL_DEG, MISSED = 1.7, 0.4
"""Median error of an answer and share of missed highlights, as the sightline has them on tissue."""


def _cores(seed: int, factors: list[float], shared: float = 0.5) -> list[SceneSums]:
    """Return the sums of cores on the same scenes, whose errors are a factor times a common law.

    Each scene has no highlight or up to four, of which all cores miss the same; a share `shared` of the answers'
    variance, in the logarithm, is of the scene and highlight, the rest is each core's own noise.
    """
    rng = np.random.default_rng(seed)
    cores: list[dict[str, list[list[float]]]] = [{} for _ in factors]
    for case, scenes in enumerate(SCENES):
        numbers = rng.integers(0, 5, scenes)
        scene_of = np.repeat(np.arange(scenes), numbers)
        common = np.sqrt(shared) * 0.6 * (rng.standard_normal(scenes)[scene_of] + rng.standard_normal(len(scene_of)))
        missed = rng.random(len(scene_of)) < MISSED
        for core, factor in zip(cores, factors, strict=True):
            own = np.sqrt(1 - shared) * 0.8 * rng.standard_normal(len(scene_of))
            errors = np.where(missed, CAP_DEG, np.minimum(factor * TYPICAL_DEG * np.exp(common + own), CAP_DEG))
            core[f"case {case}"] = np.stack([numbers, np.bincount(scene_of, errors, scenes)], axis=1).tolist()
    return list(cores)


def _claims(factors: list[float], runs: int) -> Array:
    """Return the claims of each run, as `Ranking.better`."""
    return np.array([rank([_cores(seed, factors)]).better for seed in range(runs)])


def test_equal_cores_are_tied() -> None:
    """Six cores that differ in noise alone: no pair is ordered in any of 100 tables, thanks to the margin."""
    assert np.count_nonzero(_claims([1.0] * 6, 100)) == 0


def test_a_planted_difference_is_seen() -> None:
    """One of six cores errs twice as much: its score is 21 % larger, and it ranks below all others in most tables."""
    claims = _claims([1.0] * 5 + [2.0], 50)
    assert (claims[:, 5, :5] == -1).mean() >= 0.95
    assert (claims[:, :5, :5] == 0).all()
    # A score 11 % larger is hardly beyond the margin of 10 %: it is no claim, and never one the other way.
    close = _claims([1.0] * 5 + [1.5], 50)
    assert (close[:, 5, :5] == -1).mean() < 0.05
    assert (close[:, 5, :5] <= 0).all()


def test_the_risk_of_a_claim_is_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the margin, six equal cores give any claim in 5 % of tables, as Bonferroni's level allows at most."""
    monkeypatch.setattr("simtest.bench.ranking.margin", lambda first, second: np.zeros(()))
    claimed = (_claims([1.0] * 6, 300) != 0).any(axis=(1, 2)).mean()
    # 300 tables tell 5 % to 1.3 %; the pairs of six cores hang together, so the level is not used up.
    assert 0.0 < claimed < ALPHA + 0.038
    # The negative control: at the level of a single pair, equal cores are ordered in many tables.
    each = np.array([rank([_cores(seed, [1.0] * 6)], alpha=15 * ALPHA).better for seed in range(60)])
    assert (each != 0).any(axis=(1, 2)).mean() > 0.2


def test_what_both_miss_cancels() -> None:
    """The standard error of a difference is far below that of each score, which is of the missed highlights."""
    pair = _cores(1, [1.0, 1.0], shared=0.95)
    strangers = [_cores(1, [1.0])[0], _cores(2, [1.0])[0]]
    assert rank([pair]).errors[0, 1] < 0.35 * rank([strangers]).errors[0, 1]


def test_the_error_of_a_difference_is_that_of_many_draws() -> None:
    found = [rank([_cores(seed, [1.0, 1.5])]) for seed in range(300)]
    drawn = np.std([one.scores[1] - one.scores[0] for one in found])
    assert np.mean([one.errors[0, 1] for one in found]) == pytest.approx(drawn, rel=0.12)


def test_a_clear_difference_within_the_margin_is_none() -> None:
    """Two scores that differ by the same in each scene are known to differ; a verification lets both move by more."""

    def constant(error: float) -> SceneSums:
        return {"plane": [(1, error)] * 5}

    apart = float(margin(np.array(1.0), np.array(1.1)))
    assert rank([[constant(1.0), constant(1.0 + 0.99 * apart)]]).better[0, 1] == 0
    assert rank([[constant(1.0), constant(1.0 + 1.02 * apart)]]).better[0, 1] == 1
    assert rank([[constant(0.0), constant(0.0)]]).better.tolist() == [[0, 0], [0, 0]]


def test_several_parts_count_alike() -> None:
    """The mean over parts is of their scores, whatever their numbers of highlights, and so are the errors."""
    large, small = _cores(3, [1.0, 2.0]), [{"a": [(1, 1.0), (1, 2.0)]}, {"a": [(1, 5.0), (1, 5.0)]}]
    both, alone = rank([large, small]), [rank([large]), rank([small])]
    assert both.scores == pytest.approx((alone[0].scores + alone[1].scores) / 2)
    assert both.errors[0, 1] == pytest.approx(np.hypot(alone[0].errors[0, 1], alone[1].errors[0, 1]) / 2)


def test_few_scenes_need_a_larger_difference() -> None:
    """With two scenes a case has one degree of freedom: 4 deg, 8 times its standard error, is not clear."""
    pair: list[SceneSums] = [{"a": [(1, 1.0), (1, 2.0)]}, {"a": [(1, 5.5), (1, 5.5)]}]
    found = rank([pair])
    assert found.errors[0, 1] == pytest.approx(0.5)
    assert found.better[0, 1] == 0
    many: list[SceneSums] = [{"a": [(1, 1.0), (1, 2.0)] * 20}, {"a": [(1, 5.5), (1, 5.5)] * 20}]
    assert rank([many]).better[0, 1] == 1


def test_ranks_are_those_of_the_claims() -> None:
    better = rank([_cores(1, [1.0, 1.0, 3.0, 0.1])])
    assert better.first.tolist() == [2, 2, 4, 1]
    assert better.last.tolist() == [3, 3, 4, 1]


def test_agreement_counts_reversed_and_changed_pairs() -> None:
    full = np.sign(np.arange(4)[None, :] - np.arange(4)[:, None]).astype(np.int8)
    assert agreement(full, full) == 1.0
    assert agreement(full, -full) == -1.0
    tied = full.copy()
    tied[0, 1] = tied[1, 0] = 0
    # 5 of 6 pairs agree and one is tied in one table alone
    assert agreement(full, tied) == pytest.approx(5 / np.sqrt(6 * 5))
    assert np.isnan(agreement(full, np.zeros_like(full)))
