"""Whether public and sealed seeds rank estimators alike: Kendall's tau of their headline figures.

``python -m studies.bench_seeds OUT [--sealed 3] [--scenes N] [--part P]...`` runs six estimators at once on the public
seeds and on sealed ones that are drawn from fixed texts, and prints the penalised errors and each tau. A stopped study
goes on. ``--scenes N`` takes the first N scenes of each case: fewer scenes tell estimators apart worse.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
from scipy.stats import kendalltau

from simtest.bench.draws import Seeds, experiment_of, public_seeds
from simtest.bench.phrases import NONE, degrees
from simtest.bench.scores import score_part
from simtest.bench.suite import FrozenCase, Suite, frames_of, load_suite
from simtest.validation.runner import run_experiments

ESTIMATORS = ("bisector", "cone_axis", "photometric", "curved", "brightest_point", "circle_pose")
NARROW = 0.8
"""A core that states this share of its covariance is to be marked."""


def thinned(suite: Suite, scenes: int | None) -> Suite:
    """Return a suite of at most so many scenes of each case."""

    def fewer(case: FrozenCase) -> FrozenCase:
        return replace(case, spec=case.spec.model_copy(update={"draws": min(case.spec.draws, scenes or 10**6)}))

    return replace(suite, cases=tuple(map(fewer, suite.cases)))


def with_covariance(rows: pl.DataFrame, factor: float) -> pl.DataFrame:
    """Return rows as if their estimator stated its covariances times a factor."""
    return rows.with_columns(
        *(pl.col(name) * factor for name in ("cov_11", "cov_12", "cov_22")), pl.col("mahalanobis2") / factor
    )


def percent(share: float | None) -> str:
    """Return a share in %."""
    return NONE if share is None else f"{100 * share:.1f} %"


def penalised(suite: Suite, seeds: Seeds, parts: list[str], folder: Path) -> dict[str, list[float]]:
    """Run the estimators on a set of seeds; return the penalised error of each part, deg, by estimator."""
    found: dict[str, list[float]] = {name: [] for name in ESTIMATORS}
    for part in parts:
        frames = frames_of(suite, part)
        experiment = experiment_of(suite, part, ESTIMATORS[0], seeds).model_copy(update={"estimators": ESTIMATORS})
        (run,) = run_experiments([(experiment, folder / part)])
        for name in ESTIMATORS:
            rows = run.results.filter(pl.col("estimator") == name)
            score, narrow = score_part(rows, frames), score_part(with_covariance(rows, NARROW), frames)
            assert score.penalised_deg is not None
            found[name].append(score.penalised_deg)
            stated = score.uncertainty
            print(
                f"{folder.name:8} {part:10} {name:16} n {score.n:4} penalised {score.penalised_deg:7.3f} "
                f"median {degrees(score.median_deg)} answered {score.answered:4} "
                f"coverage {percent(stated.coverage)} of {stated.n} {stated.verdict}, "
                f"with {NARROW:g} of the covariance {narrow.uncertainty.verdict}", flush=True,
            )  # fmt: skip
    return found


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sealed", type=int, default=3)
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--part", action="append")
    given = parser.parse_args()
    suite = thinned(load_suite(), given.scenes)
    parts = given.part or [part.name for part in suite.spec.parts if part.kind == "highlights"]
    sets = {"public": public_seeds(suite)} | {
        f"sealed{i}": Seeds(f"study {i}", f"study {i}") for i in range(1, given.sealed + 1)
    }
    means = {}
    for name, seeds in sets.items():
        found = penalised(suite, seeds, parts, given.out / name)
        means[name] = [float(np.mean(found[estimator])) for estimator in ESTIMATORS]
        ranks = sorted(zip(means[name], ESTIMATORS, strict=True))
        print(name, ", ".join(f"{estimator} {value:.3f}" for value, estimator in ranks), flush=True)
        if name != "public":
            print(
                f"{name}: Kendall's tau to public {kendalltau(means['public'], means[name]).statistic:.3f}", flush=True
            )


if __name__ == "__main__":
    main()
