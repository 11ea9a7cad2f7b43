"""Warnings that hang on the isophotes of a highlight."""

from simtest.errors import Reason
from simtest.estimators.spot import Spot


def spot_flags(spot: Spot) -> tuple[str, ...]:
    """Give the flags of a highlight's isophotes.

    ``missing_isovalues``: some isovalues gave no ellipse. ``partial_arc``: some of them because the isophote runs into
    the border of the region, the frame or the view, so that the highlight may be cut there.
    """
    flags = ("missing_isovalues",) if spot.failures else ()
    cut = any(failure.reason == Reason.NO_CLOSED_ISOPHOTE for failure in spot.failures)
    return (*flags, "partial_arc") if cut else flags
