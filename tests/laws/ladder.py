"""Laws of the error ladder: the rungs whose height is known."""

import math

from studies import error_ladder as ladder
from tests.laws.law import Law, law

PROTOTYPE_NOISE_DEG, PROTOTYPE_CURVED_DEG = 0.008, 59.9
"""Mean error of cone_axis at sigma 5 %, n = 50, f = 406 px, and of circle pose on a cylinder with R = d, as an analytic
prototype measured them (docs/concepts/theory.md, section 3)."""


def error_ladder() -> list[Law]:
    """Compare rungs with what is known of them.

    Where the pose, or the cone of a plane, is exact nothing is left. Pixels widen an isophote as smoothing does, and a
    round cone's pose errs by the root of the widening (docs/concepts/theory.md, sections 3 and 4). Noise and curvature
    leave what a prototype apart from this package measured there.
    """
    rungs = ladder.error_ladder(seed=0)

    def values(name: str, *, plane: bool | None = None, pose: bool | None = None) -> list[float]:
        found = [
            rung.mean_deg for rung in rungs
            if rung.name == name and plane in (None, rung.scene.startswith("plane"))
            and pose in (None, rung.estimator == "circle_pose")
        ]  # fmt: skip
        return [math.nan if value is None else value for value in found]

    def mean(*what: float) -> float:
        return sum(what) / len(what) if what else math.nan

    empty = sum(rung.mean_deg is None for rung in rungs)
    round_cones = values("exact cone", plane=True) + values("exact contour", plane=True)
    # -2 ln t s^2 + (-2 ln t - 1)/6 px^2 of the smoothed one, over the same without s, at t = 0.5 and s = 2 px
    level = 2 * math.log(2)
    widening = math.sqrt((level * 4 + (level - 1) / 6) / ((level - 1) / 6))
    share = mean(*values("no noise", plane=True, pose=True)) / mean(*values("no smoothing", plane=True, pose=True))
    about = f"circle pose on planes, smoothed over not: {widening:.1f}, by the widening of the isophote"
    noise = mean(*values("as it is", pose=False)) / PROTOTYPE_NOISE_DEG
    curved = mean(*values("exact cone", plane=False, pose=True)) - PROTOTYPE_CURVED_DEG
    return [
        law("error ladder", "without_result", "", empty, 0.0, n=len(rungs), about="closed forms: every rung has one"),
        law("error ladder", "exact_pose", "deg", max(values("exact pose")), 1e-9, about="the normal itself: rounding"),
        law("error ladder", "exact_cone", "deg", max(round_cones), 1e-4, about="of a plane; rounding at the branch"),
        law("error ladder", "smoothing", "x", share / widening, 1.35, 0.74, about=about),
        law("error ladder", "noise", "x", noise, 1.4, 0.7, about="cone_axis over what the prototype measured"),
        law("error ladder", "curved", "deg", curved, 0.3, -0.3, about="circle pose on R = d, less the prototype's"),
    ]  # fmt: skip
