"""How many signs of curvatures motion tells, and how many of these are wrong."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.conventions import MOTION, MOTION_COLUMNS
from simtest.runtime.statistics import share_interval
from simtest.validation.statistics import units


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
    wrong_share : (float, float, float)
        Share of the judged highlights' signs that are told and wrong, and its 95 % interval over frames.
    """

    signs: int
    told: int
    wrong: int
    misfits: int
    judged: int
    wrong_share: tuple[float, float, float]

    @property
    def told_share(self) -> float:
        """Share of the signs that were told."""
        return self.told / max(self.signs, 1)


def motion_rows(results: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of true highlights that motion was to judge; none in a run without further views."""
    if not {*MOTION_COLUMNS} <= {*results.columns}:
        return results.clear()
    return results.filter((pl.col("estimator") == MOTION) & pl.col("true_id").is_not_null())


def motion_counts(rows: pl.DataFrame) -> MotionCounts:
    """Count the signs of rows of `motion_rows`."""
    signs = [(pl.col(f"motion_sign_{i}").fill_null(0), pl.col(f"motion_gain_{i}").fill_null(0)) for i in (1, 2)]
    count = rows.with_columns(
        told=pl.sum_horizontal(sign != 0 for sign, _ in signs),
        wrong=pl.sum_horizontal(sign * gain < 0 for sign, gain in signs),
    )
    told, wrong = int(count["told"].sum()), int(count["wrong"].sum())
    judged = count.filter(pl.col("motion_fits").is_not_null())
    asked = np.full(judged.height, 2.0)
    interval = share_interval(judged["wrong"].to_numpy(), *units(judged), asked) if judged.height else (0.0, 1.0)
    share = wrong / max(2 * judged.height, 1)
    misfits = int((judged["motion_fits"] == 0).sum())
    return MotionCounts(2 * rows.height, told, wrong, misfits, judged.height, (share, *interval))
