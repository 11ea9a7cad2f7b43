"""Canary of the signs that motion tells: those of a run's results, against the error rate that the method states."""

import math

import polars as pl
from scipy import stats

from simtest.nightly.canaries.canary import canary
from simtest.nightly.records import Figure
from simtest.validation.motion_counts import motion_rows

STATED = 0.04
"""Chance that one of a highlight's two told signs is wrong, at most: 2 % each (docs/howto/motion.md)."""

ALPHA = 1e-4
"""Chance that a run with wrong signs at the stated rate does not pass. Measured rates lie far below it, and this level
lets three highlights, all wrong, fail."""


def wrong_signs(rows: pl.DataFrame) -> list[Figure]:
    """Compare the share of highlights with a wrong told sign with the rate that the method states.

    The unit is the highlight, since its two signs hang together. Rows without further views give no figure; where
    motion told no sign at all there is nothing to measure, which does not pass.
    """
    judged = motion_rows(rows)
    if judged.is_empty():
        return []
    signs = [pl.col(f"motion_sign_{i}").fill_null(0) for i in (1, 2)]
    wrong = [(sign * pl.col(f"motion_gain_{i}") < 0).fill_null(False) for i, sign in enumerate(signs, 1)]
    told = judged.filter((signs[0] != 0) | (signs[1] != 0))
    count, bad = told.height, told.filter(wrong[0] | wrong[1]).height
    high = float(stats.binom.isf(ALPHA, count, STATED)) / count if count else 0.0
    about = f"highlights with a wrong sign among those with a told one; stated are {STATED:g} at most"
    return [canary("motion", "wrong_signs", "", bad / count if count else math.nan, high, n=count, about=about)]
