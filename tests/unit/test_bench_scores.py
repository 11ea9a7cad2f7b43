"""Figures of the benchmark on known distributions: scores, uncertainty, and the ranking of cores by them."""

import json

import numpy as np
import polars as pl
import pytest
from drawn_cores import claims, cores, rankings, with_any
from scipy.stats import binom, chi2

from simtest.bench.scores import (
    CAP_DEG,
    coverage_error,
    energy_scores,
    results_hash,
    score_part,
    score_uncertainty,
    verdict_of,
)
from simtest.bench.table import ALPHA, COLUMNS, SceneSums, margin, part_cells, rank
from simtest.geometry.vectors import basis_across
from simtest.validation.columns import table

SD = np.radians(0.5)
LAYOUT = {"plane": (600, 4)}
"""Scenes of the only case, and frames of each."""


def _rows(count: int, stated: float = 1.0, seed: int = 0, per_scene: int = 4) -> pl.DataFrame:
    """Return rows whose errors are normal with a known covariance, and which state it times a factor."""
    rng, rows = np.random.default_rng(seed), []
    true = SD**2 * np.array([[1.0, 0.3], [0.3, 0.6]])
    shape, inverse = np.linalg.cholesky(true), np.linalg.inv(stated * true)
    for i in range(count):
        normal = np.array([0.1, 0.2, -1.0])
        normal /= np.linalg.norm(normal)
        miss = shape @ rng.standard_normal(2)
        angle = np.hypot(*miss)
        truth = np.cos(angle) * normal + np.sin(angle) / angle * (miss @ basis_across(normal))
        row = {"setting": "plane", "realisation": i, "specularity": 0, "true_id": 0, "status": "ok", "estimator": "x"}
        row |= {"target": "fine", "error_deg": float(np.degrees(angle))}
        row |= {f"normal_{axis}": value for axis, value in zip("xyz", normal, strict=True)}
        row |= {f"truth_{axis}": value for axis, value in zip("xyz", truth, strict=True)}
        row |= {f"cov_{j + 1}{k + 1}": stated * true[j, k] for j, k in ((0, 0), (0, 1), (1, 1))}
        rows.append(row | {"mahalanobis2": float(miss @ inverse @ miss)})
    return table(rows, {})


def _score(stated: float, seed: int = 0, count: int = 1000) -> object:
    rows = _rows(count, stated, seed)
    return score_uncertainty(rows, np.arange(rows.height) // 4)


@pytest.mark.parametrize(
    ("stated", "verdict"),
    [(1.0, "calibrated"), (0.8, "overconfident"), (2.0, "underconfident"), (0.1, "overconfident")],
)
def test_a_scaled_covariance_is_marked(stated: float, verdict: str) -> None:
    score = _score(stated)
    assert score.verdict == verdict
    assert score.inflation == pytest.approx(1 / stated, rel=0.15)
    low, high = score.interval
    assert low < score.coverage < high or score.coverage in (low, high)


@pytest.mark.parametrize("n", [50, 60, 80, 96, 128, 256, 1000])
def test_a_right_uncertainty_is_marked_as_seldom_as_stated(n: int) -> None:
    """The exact risk of each mark, over all shares that independent regions can have, and the power at 0.8."""
    hits, error = np.arange(n + 1), np.sqrt(0.95 * 0.05 / n)
    verdicts = np.array([verdict_of(k / n, error, n) for k in hits])
    right, narrow = binom.pmf(hits, n, 0.95), binom.pmf(hits, n, chi2.cdf(0.8 * chi2.ppf(0.95, 2), 2))
    assert right[verdicts == "overconfident"].sum() <= 0.01
    assert right[verdicts == "underconfident"].sum() <= 0.01
    assert right[verdicts != "calibrated"].sum() > 0.001
    assert narrow[verdicts == "overconfident"].sum() > {50: 0.05, 256: 0.5, 1000: 0.99}.get(n, 0.1)


def test_dependent_rows_are_marked_as_seldom_as_stated() -> None:
    """256 scenes of 4 rows, half of whose errors hang together: the test of independent rows would mark too many."""
    rng, limit, marks, naive = np.random.default_rng(1), chi2.ppf(0.95, 2), [], []
    scenes = np.arange(1024) // 4
    for _ in range(600):
        shared = np.repeat(rng.standard_normal((256, 2)), 4, axis=0)
        misses = np.sqrt(0.8) * shared + np.sqrt(0.2) * rng.standard_normal((1024, 2))
        inside = (misses**2).sum(axis=1) <= limit
        share = float(inside.mean())
        marks.append(verdict_of(share, coverage_error(inside, scenes), 1024))
        naive.append(verdict_of(share, coverage_error(inside, np.arange(1024)), 1024))
    for side in ("overconfident", "underconfident"):
        # 600 runs tell 1 % to 0.4 %
        assert 0.001 < np.mean([mark == side for mark in marks]) < 0.022
    assert np.mean([mark != "calibrated" for mark in naive]) > 0.06


def test_rows_of_one_scene_do_not_count_as_independent() -> None:
    inside = np.repeat(np.random.default_rng(2).random(50) < 0.9, 20)
    alone, grouped = coverage_error(inside, np.arange(1000)), coverage_error(inside, np.arange(1000) // 20)
    assert grouped > 3 * alone


def test_a_difference_between_frozen_cases_is_no_chance() -> None:
    """All of one case inside, none of another: other scenes of these cases would give the same share."""
    inside, scenes = np.repeat([1.0, 0.0], 200), np.arange(400) // 20
    assert coverage_error(inside, scenes, scenes // 10) == coverage_error(inside, np.arange(400), np.arange(400) // 200)
    assert coverage_error(inside, scenes) > 3 * coverage_error(inside, scenes, scenes // 10)


def test_few_regions_get_no_verdict() -> None:
    assert _score(0.01, count=40).verdict == "too few"
    unstated = dict.fromkeys(["cov_11", "cov_12", "cov_22", "mahalanobis2"])
    assert score_uncertainty(_rows(3).with_columns(**unstated), np.arange(3)).n == 0


@pytest.mark.parametrize(
    ("covariance", "distance"),
    [((0.0, 0.0, 0.0), None), ((1e-4, 1e-4, 1e-4), float("nan")), ((1e-320, 0.0, 1e-320), float("inf"))],
)
def test_a_singular_covariance_is_stated_and_missed(
    covariance: tuple[float, float, float], distance: float | None
) -> None:
    """A core that states it for all answers is overconfident; for some of them, these lie outside."""
    names = dict(zip(("cov_11", "cov_12", "cov_22"), map(pl.lit, covariance), strict=True))
    singular = _rows(200).with_columns(**names, mahalanobis2=pl.lit(distance, pl.Float64))
    score = score_uncertainty(singular, np.arange(200))
    assert (score.n, score.coverage, score.verdict, score.inflation) == (200, 0.0, "overconfident", None)
    assert score.energy_deg is not None
    rows = pl.concat([_rows(200), singular.head(20)])
    assert score_uncertainty(rows, np.arange(220)).verdict == "overconfident"
    assert len(results_hash(rows)) == 64
    assert results_hash(rows) == results_hash(rows.clone())


def test_a_covariance_beyond_all_bounds_has_no_figures() -> None:
    """What is not finite is no number of JSON: the certificate could not be written at the end of a run."""
    names = {name: pl.lit(1e308) for name in ("cov_11", "cov_22")}
    score = score_part(_rows(100).with_columns(**names, mahalanobis2=pl.lit(float("inf"))), LAYOUT)
    json.dumps(score.to_json(), allow_nan=False)
    assert score.uncertainty.semi_axis_deg is None


def test_the_energy_score_is_that_of_samples() -> None:
    rng, covariance = np.random.default_rng(3), np.array([[2.0, 0.7], [0.7, 0.5]])
    miss = np.array([1.2, -0.4])
    drawn = rng.standard_normal((400_000, 2)) @ np.linalg.cholesky(covariance).T
    sampled = (
        np.linalg.norm(drawn - miss, axis=1).mean() - 0.5 * np.linalg.norm(drawn[::2] - drawn[1::2], axis=1).mean()
    )
    assert energy_scores(miss[None], covariance[None])[0] == pytest.approx(sampled, rel=5e-3)


def test_the_energy_score_is_least_for_the_right_covariance() -> None:
    energies = {stated: _score(stated, count=2000).energy_deg for stated in (0.25, 0.6, 1.0, 1.6, 4.0)}
    assert min(energies, key=energies.get) == 1.0


def test_the_axis_is_that_of_the_region() -> None:
    area = SD**2 * np.sqrt(0.6 - 0.3**2)
    assert _score(1.0).semi_axis_deg == pytest.approx(np.degrees(np.sqrt(5.991 * area)), rel=1e-3)


def test_refused_and_missed_highlights_count_the_cap() -> None:
    rows = _rows(100)
    others = [
        dict(setting="plane", realisation=100, true_id=0, status="missed", estimator="x"),
        dict(setting="plane", realisation=101, specularity=0, true_id=0, status="not_converged", estimator="x"),
        dict(setting="plane", realisation=102, specularity=0, status="ok", estimator="x", error_deg=None),
    ]
    score = score_part(pl.concat([rows, table(others, {})]), LAYOUT)
    assert (score.n, score.answered, score.missed, score.false) == (102, 100, 1, 1)
    assert score.refused == {"not_converged": 1}
    assert score.score_deg == pytest.approx((rows["error_deg"].sum() + 2 * CAP_DEG) / 102)
    assert score.median_interval[0] < score.median_deg < score.median_interval[1]
    assert score.score_interval[0] < score.score_deg < score.score_interval[1]
    # the certificate's sums by scene are those of the score, and scenes without a highlight stand among them
    assert len(score.scenes["plane"]) == LAYOUT["plane"][0]
    assert [sum(scene[0] for scene in score.scenes["plane"][:at]) for at in (1, 25, 26)] == [4, 100, 102]
    assert score.scenes["plane"][25] == (2, 2 * CAP_DEG)
    assert score.scenes["plane"][26:] == [(0, 0.0)] * (LAYOUT["plane"][0] - 26)


def test_differences_between_frozen_cases_are_no_chance() -> None:
    """Errors near 1 deg in one case and near 9 in the other: other seeds move the score by their noise alone."""
    rng, rows = np.random.default_rng(3), []
    for case, level in (("easy", 1.0), ("hard", 9.0)):
        rows += [
            dict(setting=case, realisation=i, true_id=0, status="ok", estimator="x", target="fine",
                      error_deg=level + 0.3 * rng.standard_normal(), specularity=0)
            for i in range(20)
        ]  # fmt: skip
    score = score_part(table(rows, {}), {"easy": (20, 1), "hard": (20, 1)})
    low, high = score.score_interval
    # The standard error is 0.3 / sqrt(40); as if the cases were drawn it would be 0.64.
    assert (high - low) / 2 == pytest.approx(2.02 * 0.3 / np.sqrt(40), rel=0.25)
    assert score.median_interval is not None


def test_an_error_beyond_the_cap_counts_the_cap() -> None:
    rows = _rows(4).with_columns(error_deg=pl.Series([1.0, 9.0, 11.0, 170.0]))
    score = score_part(rows, LAYOUT)
    assert (score.score_deg, score.mean_deg) == (pytest.approx(7.5), pytest.approx(47.75))
    # Three of the four are off by more than 5 deg, and the rows state about 1 deg.
    assert score.wrong_and_sure == pytest.approx(0.75)
    told = dict(zip(COLUMNS, part_cells(score.to_json()), strict=True))
    assert (told["wrong and sure"], told["coverage"][:5]) == ("75.0 %", "100.0")
    # A certificate of an earlier release has none.
    without = {key: value for key, value in score.to_json().items() if key != "wrong_and_sure"}
    assert dict(zip(COLUMNS, part_cells(without), strict=True))["wrong and sure"] == "–"
    assert score.scenes["plane"][0] == (4, 30.0)


def test_a_frame_that_the_part_does_not_have_is_refused() -> None:
    for setting, realisation in (("plane", 4 * LAYOUT["plane"][0]), ("sphere", 0)):
        stray = dict(setting=setting, realisation=realisation, true_id=0, status="missed", estimator="x")
        with pytest.raises(ValueError, match=f"setting '{setting}', realisation {realisation}"):
            score_part(table([stray], {}), LAYOUT)


def test_the_hash_is_of_what_was_answered() -> None:
    rows = _rows(10)
    assert results_hash(rows) == results_hash(rows.clone())
    assert results_hash(rows) != results_hash(rows.with_columns(pl.col("normal_x") + 1e-15))
    assert results_hash(rows) == results_hash(rows.with_columns(estimator=pl.lit("named otherwise")))


def test_equal_cores_are_tied() -> None:
    """Six cores that differ in noise alone: no pair is ordered in any of 100 tables, thanks to the margin."""
    assert with_any(rankings([1.0] * 6, 100)) == 0


def test_a_planted_difference_is_seen() -> None:
    """One of six cores errs twice as much: its score is 21 % larger, and it ranks below all others in most tables."""
    found = claims(rankings([1.0] * 5 + [2.0], 50))
    assert (found[:, 5, :5] == -1).mean() >= 0.95
    assert (found[:, :5, :5] == 0).all()
    # A score 11 % larger is hardly beyond the margin of 10 %: it is no claim, and never one the other way.
    close = claims(rankings([1.0] * 5 + [1.5], 50))
    assert (close[:, 5, :5] == -1).mean() < 0.05
    assert (close[:, 5, :5] <= 0).all()


def test_the_risk_of_a_claim_is_as_stated() -> None:
    """Without the margin, six equal cores give any claim in 5 % of tables, as Bonferroni's level allows at most."""
    # 300 tables tell 5 % to 1.3 %.
    assert 0.0 < with_any(rankings([1.0] * 6, 300, margin=False)) < ALPHA + 0.038
    # The negative control: at the level of a single pair, equal cores are ordered in many tables.
    assert with_any(rankings([1.0] * 6, 60, margin=False, alpha=15 * ALPHA)) > 0.2


def test_what_both_miss_cancels() -> None:
    """The standard error of a difference is far below that of each score, which is of the missed highlights."""
    pair = cores(1, [1.0, 1.0], shared=0.95)
    strangers = [cores(1, [1.0])[0], cores(2, [1.0])[0]]
    assert rank([pair]).errors[0, 1] < 0.35 * rank([strangers]).errors[0, 1]


def test_the_error_of_a_difference_is_that_of_many_draws() -> None:
    found = [rank([cores(seed, [1.0, 1.5])]) for seed in range(300)]
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
    large, small = cores(3, [1.0, 2.0]), [{"a": [(1, 1.0), (1, 2.0)]}, {"a": [(1, 5.0), (1, 5.0)]}]
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
    better = rank([cores(1, [1.0, 1.0, 3.0, 0.1])])
    assert better.first.tolist() == [2, 2, 4, 1]
    assert better.last.tolist() == [3, 3, 4, 1]


@pytest.mark.parametrize("scenes", [(1,) * 12, (1, 1, 1, 1, 4, 4)])
def test_cases_of_one_scene_are_no_certainty(scenes: tuple[int, ...]) -> None:
    """Equal cores on cases of one scene, alone or beside others, are ordered as seldom as stated."""
    rng, claimed = np.random.default_rng(6), 0
    for _ in range(300):
        drawn = [{str(i): [(1, rng.normal(3 + i, 1)) for _ in range(n)] for i, n in enumerate(scenes)} for _ in "ab"]
        found = rank([drawn])
        score = found.scores[1] - found.scores[0]
        claimed += abs(score) > 0 and bool(found.better[0, 1])
    # 300 tables tell 5 % to 1.3 %; the margin asks for more.
    assert claimed / 300 < ALPHA + 0.038
    # A difference that is far beyond the scenes' spread is seen.
    far: list[SceneSums] = [{str(i): [(1, level)] * n for i, n in enumerate(scenes)} for level in (1.0, 5.0)]
    assert rank([far]).better[0, 1] == 1


def test_one_scene_orders_nothing() -> None:
    assert rank([[{"a": [(1, 1.0)]}, {"a": [(1, 9.0)]}]]).better[0, 1] == 0
