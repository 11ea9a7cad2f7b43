"""The error ladder as figures of a run."""

import math

import polars as pl

from simtest.nightly.canaries.canary import canary
from simtest.nightly.records import Cell, Figure, figure_table
from simtest.validation.error_ladder import RUNGS, error_ladder

PROTOTYPE_NOISE_DEG, PROTOTYPE_CURVED_DEG = 0.008, 59.9
"""Mean error of cone_axis at sigma 5 %, n = 50, f = 406 px, and of circle pose on a cylinder with R = d, as an analytic
prototype measured them (docs/concepts/theory.md, section 3)."""


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


def ladder_values(figures: pl.DataFrame) -> pl.DataFrame:
    """Return the canaries of the rungs whose height is known.

    Where the pose, or the cone of a plane, is exact nothing is left. Pixels widen an isophote as smoothing does, and a
    round cone's pose errs by the root of the widening (docs/concepts/theory.md, sections 3 and 4). Noise and curvature
    leave what a prototype apart from this package measured there.
    """
    plane, pose = pl.col("setting").str.starts_with("plane"), pl.col("estimator") == "circle_pose"

    def largest(*rungs: str, where: pl.Expr) -> float:
        return _known(figures.filter(where, pl.col("quantity").is_in(rungs))["value"].max())

    def mean(rung: str, where: pl.Expr) -> float:
        return _known(figures.filter(where, pl.col("quantity") == rung)["value"].mean())

    exact = largest("exact pose", where=pl.lit(True))
    made = [canary("error ladder", "exact_pose", "deg", exact, 1e-9, about="the normal itself: rounding")]
    round_cones = largest("exact cone", "exact contour", where=plane)
    made.append(
        canary("error ladder", "exact_cone", "deg", round_cones, 1e-4, about="of a plane; rounding at the branch")
    )
    # -2 ln t s^2 + (-2 ln t - 1)/6 px^2 of the smoothed one, over the same without s, at t = 0.5 and s = 2 px
    level = 2 * math.log(2)
    widening = math.sqrt((level * 4 + (level - 1) / 6) / ((level - 1) / 6))
    share = mean("no noise", plane & pose) / mean("no smoothing", plane & pose)
    about = f"circle pose on planes, smoothed over not: {widening:.1f}, by the widening of the isophote"
    made.append(canary("error ladder", "smoothing", "x", share / widening, 1.35, 0.74, about=about))
    noise = mean("as it is", ~pose) / PROTOTYPE_NOISE_DEG
    made.append(
        canary("error ladder", "noise", "x", noise, 1.4, 0.7, about="cone_axis over what the prototype measured")
    )
    curved = mean("exact cone", ~plane & pose) - PROTOTYPE_CURVED_DEG
    made.append(
        canary("error ladder", "curved", "deg", curved, 0.3, -0.3, about="circle pose on R = d, less the prototype's")
    )
    return figure_table(made)


def _known(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
