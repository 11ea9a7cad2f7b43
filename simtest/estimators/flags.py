"""Warnings about the isophotes of a highlight."""

from simtest.errors import Reason
from simtest.estimators.isophote_family import IsophoteFamily

STREAK_RATIO = 0.1
"""An isophote with a smaller axis ratio is a streak."""


def isophote_flags(family: IsophoteFamily) -> tuple[str, ...]:
    """Return the flags of a highlight's isophotes.

    ``missing_isovalues``: some isovalues have no ellipse. ``partial_arc``: some isophotes run into the border of the
    region, the frame or the view, so the highlight may be cut there; they are left out, or fitted to what is seen.
    ``streak``: ten times as long as wide or more, so that its centre is hardly determined along it. ``not_elliptic``:
    an isophote is no ellipse, as where two highlights touch or the surface's curvature changes under the highlight.
    """
    missing = any(failure.reason == Reason.NO_CLOSED_ISOPHOTE for failure in family.failures)
    conditions = {
        "missing_isovalues": bool(family.failures),
        "partial_arc": missing or any(isophote.cut for isophote in family.isophotes),
        "streak": family.axis_ratio < STREAK_RATIO,
        "not_elliptic": family.is_bent,
    }
    return tuple(flag for flag, holds in conditions.items() if holds)
