"""Why this run departs from the article, where it does: two sentences each, shown under the table."""

from simtest.conventions import PAPER_SMOOTHING_PX
from simtest.pages.style import number
from simtest.report.paper.sweeps import Sweep

NEAR_ZERO_SLANT = (
    "Near θ = 0 circle pose is at its branch point: a relative axis error δ tilts the normal by √(2δ), so that even "
    "small noise leaves degrees, and the error falls before it grows. A sweep that starts at a slant of some tens of "
    "degrees does not see this."
)

ISOVALUE_MINIMUM = (
    "Noise moves the isophote by σ over the lobe's slope, relative to its axes by σ / (t (−ln t)), and a contour holds "
    "independent noise in proportion to its length, √(−ln t): the error is then least where t (−ln t)^(5/4) is "
    "largest, at t = exp(−5/4) = 0.29. A wider smoothing, whose bias falls slowly with t, moves the minimum up."
)
"""Of the isovalue sweep's minimum."""

NOISE = (
    "The bias of the smoothing dominates at small noise and the random part may lean against it, which flattens the "
    "curve there. A run of more realisations tells the two apart."
)

NOISE_LEVEL = (
    "The noise's effect depends on the number of pixels on the isophote and on the smoothing, which the article does "
    "not state. The bias of the smoothing alone is drawn beside the means below."
)

TRUNCATION = (
    "A realisation whose isophote leaves the texture's window either fails or is fitted to a cut curve. That is "
    "truncation by the window, not the model."
)

OFFSET = (
    "The isophote of an offset light is no circle, and the model's error grows with ε. What noise and smoothing leave "
    "at ε = 0 is in both means, so that the ratio hangs on them."
)

BRANCH_POINT = (
    "The slope is 1/2 as long as the axes' relative error is small and noise alone causes it. Bias of the smoothing or "
    "failures at large noise bend the curve."
)

SMOOTHING = (
    "The law takes the lobe as Gaussian to second order and the isophote well inside the texture's window. Where the "
    "smoothing is as wide as the isophote, or reaches over the window's edge, it does not hold."
)


def exponent_slope(sweep: Sweep, law_slope: float, published: float) -> str:
    """Explain where the slope against the exponent comes from.

    `law_slope` is that of the smoothing's predicted bias, NaN where there is no law, `published` that of the article;
    deg per unit.
    """
    if not law_slope > 0:
        return (
            "The slope hangs on the smoothing's width, which the article does not state. "
            "This run has no prediction of the smoothing's bias to compare it with."
        )
    width = float(sweep.fixed.get("smoothing_px") or PAPER_SMOOTHING_PX)
    return (
        f"The slope is mainly the smoothing's bias, which grows with n s²: without noise {number(law_slope)}° per "
        f"unit is predicted at this run's s = {width:g} px. The article does not state its width; "
        f"its slope would belong to about {number(width * (published / law_slope) ** 0.5, 2)} px."
    )
