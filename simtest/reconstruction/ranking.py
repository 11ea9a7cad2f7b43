"""Which of a highlight's estimates is the best one, and why: the one with the smallest reported error."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.errors import Failure
from simtest.estimators.budget import deviations, dominant
from simtest.estimators.protocol import Estimate, Target

WITHOUT_UNCERTAINTY = ("bisector", "curved", "photometric", "cone_axis", "brightest_point")
"""Order of estimates that state no uncertainty, so that nothing else can rank them: that which knows the lights, those
which follow the lobe to its peak, that which averages isophotes, and the one that needs none. Other packages' follow,
and `circle_pose` last, which takes a curved surface for a plane."""


@dataclass(frozen=True)
class StatedErrors:
    """What the best estimates of a picture state, deg: medians of the standard deviation and of each part's.

    Parameters
    ----------
    count, silent : int
        Best estimates that state an uncertainty, and others.
    median_deg : float
        Of the square root of the covariance's trace.
    parts_deg : dict
        The same of each part of the budget, the largest first.
    """

    count: int
    silent: int
    median_deg: float
    parts_deg: dict[str, float]

    def __str__(self) -> str:
        # Parts below a hundredth of the whole change nothing that is shown.
        told = {name: value for name, value in self.parts_deg.items() if value >= 0.01 * self.median_deg}
        parts = ", ".join(f"{name} {value:.2g}" for name, value in told.items())
        left = f"; {self.silent} report none" if self.silent else ""
        return f"median ± {self.median_deg:.2g} deg of {self.count} best normals ({parts}){left}"


def stated_errors(best: Sequence[Estimate]) -> StatedErrors | None:
    """Summarise the uncertainties of a picture's best estimates; None where none states any."""
    stated = [each for each in best if each.covariance is not None]
    if not stated:
        return None
    parts: dict[str, list[float]] = {}
    for each in stated:
        for name, value in deviations(each.budget or {}).items():
            parts.setdefault(name, []).append(float(np.degrees(value)))
    # A part that some estimates do not have is 0 there.
    medians = {name: statistics.median(values + [0.0] * (len(stated) - len(values))) for name, values in parts.items()}
    median = statistics.median([deviation for each in stated if (deviation := each.deviation_deg) is not None])
    ordered = dict(sorted(medians.items(), key=lambda item: -item[1]))
    return StatedErrors(len(stated), len(best) - len(stated), median, ordered)


def best_of(estimates: Mapping[str, Estimate | Failure], target: Target = "fine") -> tuple[str | None, str]:
    """Return the name of the estimator whose normal is the best one, and why; None where all failed.

    The best one has the smallest expected error, the square root of the covariance's trace, of those that state the
    wanted surface's normal, or else of all. Estimates without uncertainty are worse than any with one.
    """
    answered = {name: result for name, result in estimates.items() if isinstance(result, Estimate)}
    if not answered:
        return None, "no estimator answered"
    wanted = {name: result for name, result in answered.items() if result.target == target} or answered
    stated = {name: expected for name, result in wanted.items() if (expected := result.deviation_deg) is not None}
    if not stated:
        best = min(wanted, key=_rank)
        return best, "no estimator reports an uncertainty; chosen by the estimators' order"
    # The first of equal ones; so the result does not depend on rounding alone.
    best = min(stated, key=lambda name: (stated[name], _rank(name)))
    others = sorted((expected, name) for name, expected in stated.items() if name != best)
    because = f"smallest expected error, {stated[best]:.2g} deg{_mostly(wanted[best])}"
    if others:
        return best, f"{because}; next {others[0][1]} with {others[0][0]:.2g} deg"
    return best, f"{because}; " + ("the only answer" if len(wanted) == 1 else "the others report no uncertainty")


def _mostly(estimate: Estimate) -> str:
    """Name the largest part of a budget, where it has several."""
    budget = estimate.budget or {}
    return f", mostly {dominant(budget)}" if len(budget) > 1 else ""


def _rank(name: str) -> int:
    if name in WITHOUT_UNCERTAINTY:
        return WITHOUT_UNCERTAINTY.index(name)
    return len(WITHOUT_UNCERTAINTY) + (name == "circle_pose")
