"""The error ladder as figures of a run."""

import polars as pl

from simtest.nightly.canaries.canary import canary
from simtest.nightly.records import Cell, Figure, figure_table
from simtest.validation.error_ladder import RUNGS, error_ladder


def ladder_figures(seed: int = 0) -> pl.DataFrame:
    """Compute the error ladder (`simtest.validation.error_ladder`): seconds. The seed is that of the noisy frames.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, of kind "ladder": `setting` the scene, `quantity` the rung, `value` the mean error, deg, with
        its 95 % interval where it is one over noise, `n` the results, `about` what the rung replaces.
    """
    return figure_table(
        Figure(
            "ladder", Cell("error ladder", rung.scene, None, rung.scene, rung.estimator), rung.name, "deg",
            rung.mean_deg, *rung.interval_deg, len(rung.errors_deg), about=RUNGS[rung.name],
        )
        for rung in error_ladder(seed=seed)
    )  # fmt: skip


def ladder_canary(figures: pl.DataFrame) -> pl.DataFrame:
    """Return the canary that counts rungs without a result: of a closed form, every rung has one."""
    without = figures.filter(pl.col("value").is_null())
    named = "; ".join(", ".join(names) for names in without.select("setting", "estimator", "quantity").iter_rows())
    about = f"rungs without an answer: {named}" if named else "each rung of a closed form has an answer"
    return figure_table([canary("error ladder", "unanswered", "", without.height, 0.0, n=figures.height, about=about)])
