"""Which of a highlight's estimates is the best one, and why: the one with the smallest stated error."""

from collections.abc import Mapping

import numpy as np

from simtest.errors import Failure
from simtest.estimators.budget import dominant
from simtest.estimators.protocol import Estimate, Target

WITHOUT_UNCERTAINTY = ("bisector", "curved", "photometric", "cone_axis", "brightest_point")
"""Order of estimates that state no uncertainty, so that nothing else can rank them: that which knows the lights, those
which follow the lobe to its peak, that which averages isophotes, and the one that needs none. Other packages' follow,
and `circle_pose` last, which takes a curved surface for a plane."""


def deviation_deg(estimate: Estimate) -> float | None:
    """Return the standard deviation of a normal, deg: the square root of the covariance's trace."""
    return None if estimate.covariance is None else float(np.degrees(np.sqrt(max(np.trace(estimate.covariance), 0))))


def best_of(estimates: Mapping[str, Estimate | Failure], target: Target = "fine") -> tuple[str | None, str]:
    """Return the name of the estimator whose normal is the best one, and why; None where all failed.

    The best one has the smallest expected error, the square root of the covariance's trace, of those that state the
    wanted surface's normal, or else of all. Estimates without uncertainty are worse than any with one.
    """
    answered = {name: result for name, result in estimates.items() if isinstance(result, Estimate)}
    if not answered:
        return None, "no estimator answered"
    wanted = {name: result for name, result in answered.items() if result.target == target} or answered
    stated = {name: expected for name, result in wanted.items() if (expected := deviation_deg(result)) is not None}
    if not stated:
        best = min(wanted, key=_rank)
        return best, "no estimator states an uncertainty; chosen by the estimators' order"
    # The first of equal ones; so the result does not depend on rounding alone.
    best = min(stated, key=lambda name: (stated[name], _rank(name)))
    others = sorted((expected, name) for name, expected in stated.items() if name != best)
    because = f"smallest expected error, {stated[best]:.2g} deg{_mostly(wanted[best])}"
    if others:
        return best, f"{because}; next {others[0][1]} with {others[0][0]:.2g} deg"
    return best, f"{because}; " + ("the only answer" if len(wanted) == 1 else "the others state no uncertainty")


def _mostly(estimate: Estimate) -> str:
    """Name the largest part of a budget, where it has several."""
    budget = estimate.budget or {}
    return f", mostly {dominant(budget)}" if len(budget) > 1 else ""


def _rank(name: str) -> int:
    if name in WITHOUT_UNCERTAINTY:
        return WITHOUT_UNCERTAINTY.index(name)
    return len(WITHOUT_UNCERTAINTY) + (name == "circle_pose")
