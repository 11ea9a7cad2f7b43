"""Estimators compared pair by pair on the same highlights."""

import polars as pl

from simtest.pages.style import estimator_order
from simtest.report.run_folder import Run
from simtest.validation.comparison import Pair, compare, distinct_frames, side_by_side, targets_of


def pairs(run: Run) -> list[tuple[str, Pair]]:
    """Compare each two estimators by the errors of their proposed normals, as (label of the curve, pair).

    Each label is counted apart, since labels differ in kind; a single estimator has no pairs. Estimators that state
    the normals of different surfaces, fine and base, are no pair: they answer for different highlights.
    """
    true = run.results.filter(pl.col("true_id").is_not_null())
    names, targets = estimator_order(true["estimator"].drop_nulls().to_list()), targets_of(true)
    return [
        (str(label), pair)
        for (label,), part in side_by_side(true, targets).group_by("label", maintain_order=True)
        for pair in compare(distinct_frames(part), names)
        if targets[pair.first] == targets[pair.second]
    ]
