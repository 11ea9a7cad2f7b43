"""How many signs of curvatures motion tells, and how many of these are wrong."""

from dataclasses import dataclass

import polars as pl

from simtest.conventions import MOTION, MOTION_COLUMNS
from simtest.validation.statistics import share_interval


@dataclass(frozen=True)
class MotionCounts:
    """Signs of 1 + d k, two for each true highlight.

    Parameters
    ----------
    signs : int
        All, those of highlights that were missed or have no curvature included.
    told, wrong : int
        That were told, and of these those that are wrong.
    misfits : int
        Highlights of which no curvature explains the further views.
    judged : int
        Highlights that were judged at all.
    """

    signs: int
    told: int
    wrong: int
    misfits: int
    judged: int

    @property
    def told_share(self) -> float:
        """Share of the signs that were told."""
        return self.told / max(self.signs, 1)

    @property
    def wrong_share(self) -> tuple[float, float, float]:
        """Share of the judged highlights' signs that are told and wrong, and its exact 95 % interval."""
        asked = max(2 * self.judged, 1)
        return (self.wrong / asked, *share_interval(self.wrong, asked))


def motion_rows(results: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of true highlights that motion was to judge; none in a run without further views."""
    if not {*MOTION_COLUMNS} <= {*results.columns}:
        return results.clear()
    return results.filter((pl.col("estimator") == MOTION) & pl.col("true_id").is_not_null())


def motion_counts(rows: pl.DataFrame) -> MotionCounts:
    """Count the signs of rows of `motion_rows`."""
    told = wrong = 0
    for i in (1, 2):
        sign, gain = pl.col(f"motion_sign_{i}"), pl.col(f"motion_gain_{i}")
        told += rows.filter(sign != 0).height
        wrong += rows.filter(sign * gain < 0).height
    judged = rows["motion_fits"].drop_nulls()
    return MotionCounts(2 * rows.height, told, wrong, int((judged == 0).sum()), len(judged))
