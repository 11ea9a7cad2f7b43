"""Warnings that hang on the isophotes of a highlight."""

from simtest.errors import Reason
from simtest.estimators.spot import Spot


def spot_flags(spot: Spot) -> tuple[str, ...]:
    """Give the flags of a highlight's isophotes.

    ``missing_isovalues``: some isovalues gave no ellipse. ``partial_arc``: some isophotes run into the border of the
    region, the frame or the view, so that the highlight may be cut there; they are left out, or fitted to what is seen.
    """
    flags = ("missing_isovalues",) if spot.failures else ()
    missing = any(failure.reason == Reason.NO_CLOSED_ISOPHOTE for failure in spot.failures)
    cut = any(isophote.cut for isophote in spot.isophotes)
    return (*flags, "partial_arc") if cut or missing else flags
