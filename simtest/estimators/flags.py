"""Warnings that hang on the isophotes of a highlight."""

from simtest.errors import Reason
from simtest.estimators.isophote_family import IsophoteFamily

STREAK_RATIO = 0.1
"""An isophote with a smaller axis ratio is a streak."""


def isophote_flags(spot: IsophoteFamily) -> tuple[str, ...]:
    """Give the flags of a highlight's isophotes.

    ``missing_isovalues``: some isovalues gave no ellipse. ``partial_arc``: some isophotes run into the border of the
    region, the frame or the view, so that the highlight may be cut there; they are left out, or fitted to what is seen.
    ``streak``: longer than it is wide by 10 and more, so that along it little holds the centre. ``not_elliptic``: an
    isophote is no ellipse, as where two highlights touch or the surface's curvature changes under the spot.
    """
    missing = any(failure.reason == Reason.NO_CLOSED_ISOPHOTE for failure in spot.failures)
    said = {
        "missing_isovalues": bool(spot.failures),
        "partial_arc": missing or any(isophote.cut for isophote in spot.isophotes),
        "streak": spot.axis_ratio < STREAK_RATIO,
        "not_elliptic": spot.is_bent,
    }
    return tuple(flag for flag, holds in said.items() if holds)
