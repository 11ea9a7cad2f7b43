"""The error ladder as figures of a night."""

import polars as pl

from simtest.nightly.canaries.record import Canary, as_figures
from simtest.nightly.gate.records import FIGURES
from simtest.validation.error_ladder import RUNGS, error_ladder


def ladder_figures(seed: int = 0) -> pl.DataFrame:
    """Compute the error ladder (`simtest.validation.error_ladder`): seconds.

    Parameters
    ----------
    seed : int
        Of the noisy frames.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, of kind "ladder": `setting` the scene, `quantity` the rung, `value` the mean error, deg, with
        its 95 % interval where it is one over noise, `n` the answers, `about` what the rung replaces.
    """
    rows = []
    for rung in error_ladder(seed=seed):
        low, high = rung.interval_deg
        rows.append(
            {"kind": "ladder", "experiment": "error ladder", "label": rung.scene, "setting": rung.scene,
             "estimator": rung.estimator, "quantity": rung.name, "unit": "deg", "value": rung.mean_deg, "low": low,
             "high": high, "n": len(rung.errors_deg), "about": RUNGS[rung.name]}
        )  # fmt: skip
    return pl.DataFrame(rows, schema=FIGURES)


def ladder_canary(figures: pl.DataFrame) -> pl.DataFrame:
    """Give the canary that sees a rung that nothing answers: of a closed form, every one does.

    Parameters
    ----------
    figures : polars.DataFrame
        As `ladder_figures` gives them.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, kind "canary".
    """
    without = figures.filter(pl.col("value").is_null() | pl.col("value").is_nan())
    named = "; ".join(f"{row['setting']}, {row['estimator']}, {row['quantity']}" for row in without.to_dicts())
    about = f"rungs without an answer: {named}" if named else "each rung of a closed form has an answer"
    return as_figures([Canary("error ladder", "unanswered", "", without.height, 0.0, n=figures.height, about=about)])
