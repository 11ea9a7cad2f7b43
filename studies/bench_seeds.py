"""Whether public and sealed seeds rank estimators alike.

``python -m studies.bench_seeds OUT [--seeds TEXT]... [--scenes N] [--part P]...`` runs six estimators at once on the
public seeds and on sealed ones that are drawn from texts, ranks them by `simtest.bench.ranking`, and compares the
tables of all sets of seeds in pairs. A stopped study goes on. ``--scenes N`` takes the first N scenes of each case.

The criterion was fixed before the sealed seeds `confirm_1` to `confirm_3` were looked at; the public seeds and those of
earlier studies served to find the faults of the former ranking:

- Kendall's tau-b of the overall tables exceeds 0.9 for the public seeds with each sealed set, and for the sealed sets
  with each other.
- No pair of estimators is ordered one way by a set of seeds and the other way by another, overall or on any part.
- Pairs that are tied in one table and ordered in another are counted for each part.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import polars as pl
from scipy.stats import kendalltau

from simtest.bench.draws import Seeds, experiment_of, public_seeds
from simtest.bench.phrases import NONE, degrees
from simtest.bench.ranking import Ranking, SceneSums, agreement, rank
from simtest.bench.scores import score_part
from simtest.bench.suite import FrozenCase, Suite, layout_of, load_suite
from simtest.validation.runner import run_experiments

ESTIMATORS = ("bisector", "cone_axis", "photometric", "curved", "brightest_point", "circle_pose")
SEALED = ("confirm_1", "confirm_2", "confirm_3")
"""Texts of the sealed seeds on which nothing was chosen."""

NARROW = 0.8
"""A core that states this share of its covariance is to be marked."""

OVERALL = "overall"


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


def scene_sums(suite: Suite, seeds: Seeds, part: str, folder: Path) -> list[SceneSums]:
    """Run the estimators on a part, print each one's figures, and return its scenes' sums."""
    experiment = experiment_of(suite, part, ESTIMATORS[0], seeds).model_copy(update={"estimators": ESTIMATORS})
    (run,) = run_experiments([(experiment, folder / part)])
    found: list[SceneSums] = []
    for name in ESTIMATORS:
        rows = run.results.filter(pl.col("estimator") == name)
        score, narrow = (score_part(held, layout_of(suite, part)) for held in (rows, with_covariance(rows, NARROW)))
        stated = score.uncertainty
        print(
            f"{folder.name:10} {part:10} {name:16} n {score.n:4} score {degrees(score.score_deg)} "
            f"median {degrees(score.median_deg)} answered {score.answered:4} "
            f"coverage {percent(stated.coverage)} of {stated.n} {stated.verdict}, "
            f"with {NARROW:g} of the covariance {narrow.uncertainty.verdict}", flush=True,
        )  # fmt: skip
        found.append(score.scenes)
    return found


def ranked(parts: Mapping[str, list[SceneSums]]) -> dict[str, Ranking]:
    """Return the tables of a set of seeds: of each part and, where there are several, over all."""
    tables = {part: rank([held]) for part, held in parts.items()}
    return tables | ({OVERALL: rank(list(parts.values()))} if len(parts) > 1 else {})


def compared(first: Ranking, second: Ranking) -> str:
    """Return tau-b of two tables, how many pairs are reversed and how many are tied in one of them alone.

    Beside it stands tau of the scores themselves, whose order claims differences that are none.
    """
    upper = np.triu_indices(len(ESTIMATORS), 1)
    one, other = first.better[upper], second.better[upper]
    reversed_, changed = np.count_nonzero(one * other < 0), np.count_nonzero((one == 0) != (other == 0))
    ordered = np.count_nonzero(one)
    return (
        f"tau-b {agreement(first.better, second.better):.3f}, {ordered} of {len(one)} pairs ordered, "
        f"{reversed_} reversed, {changed} tied in one alone; "
        f"tau of the bare scores {kendalltau(first.scores, second.scores).statistic:.2f}"
    )


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", action="append", help="text of sealed seeds; default three fixed ones")
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--part", action="append")
    given = parser.parse_args()
    suite = thinned(load_suite(), given.scenes)
    parts = given.part or [part.name for part in suite.spec.parts if part.kind == "highlights"]
    sets = {"public": public_seeds(suite)} | {text: Seeds(text, text) for text in given.seeds or SEALED}
    tables: dict[str, dict[str, Ranking]] = {}
    for name, seeds in sets.items():
        tables[name] = ranked({part: scene_sums(suite, seeds, part, given.out / name) for part in parts})
        for part, table in tables[name].items():
            order = np.lexsort((table.scores, table.first))
            told = (f"{table.first[i]}-{table.last[i]} {ESTIMATORS[i]} {table.scores[i]:.3f}" for i in order)
            print(f"{name:10} {part:10} ranks: {', '.join(told)}", flush=True)
    for first, second in combinations(tables, 2):
        for part, table in tables[first].items():
            print(f"{first} and {second}, {part}: {compared(table, tables[second][part])}", flush=True)


if __name__ == "__main__":
    main()
