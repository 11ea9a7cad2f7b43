"""What each row of results counts as, and summary figures of many errors and of signs told by motion.

Whoever counts rows counts these kinds, so that all counts agree and add up.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
from pydantic import BaseModel, ConfigDict, Field

from simtest.conventions import MOTION, MOTION_COLUMNS, ON_INSTRUMENT
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.statistics import CONFIDENCE, Interval, mean_interval, root_mean_square, share_interval

KINDS = ("ok", "failed", "missed", "false", ON_INSTRUMENT, "in_spot")
"""A true highlight is answered ("ok"), failed or missed.

Any other row is a detection: on an instrument, in a visible spot of a relief that melts several glints or holds none,
or else a false detection.
"""


def row_kind(rows: pl.DataFrame) -> pl.Expr:
    """Return the kind of each row, one of `KINDS`; columns that `rows` lacks say nothing."""
    true, status = pl.col("true_id").is_not_null(), pl.col("status")
    on_instrument = pl.col(ON_INSTRUMENT).fill_null(False) if ON_INSTRUMENT in rows.columns else pl.lit(False)
    in_spot = pl.col("visible_id").is_not_null() if "visible_id" in rows.columns else pl.lit(False)
    return (
        pl.when(true & (status == "ok")).then(pl.lit("ok"))
        .when(true & (status == "missed")).then(pl.lit("missed"))
        .when(true).then(pl.lit("failed"))
        .when(on_instrument).then(pl.lit(ON_INSTRUMENT))
        .when(in_spot).then(pl.lit("in_spot"))
        .otherwise(pl.lit("false"))
    )  # fmt: skip


def is_false(rows: pl.DataFrame) -> pl.Expr:
    """Return which rows are false detections."""
    return row_kind(rows) == "false"


def counts(rows: pl.DataFrame) -> dict[str, pl.Expr]:
    """Return the number of rows of each kind, and of true highlights as "true", by name: for `DataFrame.group_by`."""
    kind = row_kind(rows)
    numbers = {name: (kind == name).sum() for name in KINDS}
    return {"true": pl.col("true_id").is_not_null().sum(), **numbers}


FRAME = ("experiment", "setting", "realisation")

ANATOMY = "anatomy"
"""Column of scored datasets: samples of one anatomy are not independent."""

PENALTY_DEG = 90.0
"""What a failed or missed row counts in mean_penalised_deg: refusing is no way to a good figure."""


WRONG_DEG, SURE = 5.0, 3.0
"""Wrong and sure: an error of more than this, and of more than so many times the reported deviation."""


def is_wrong_and_sure(error_deg: npt.ArrayLike, deviation_deg: npt.ArrayLike | None) -> Mask:
    """Return which errors are above both bounds; none is whose deviation is not reported, NaN or None."""
    errors, deviations = np.asarray(error_deg, dtype=float), np.asarray(deviation_deg, dtype=float)
    return (errors > WRONG_DEG) & (errors > SURE * deviations)


class Figures(BaseModel):
    """Figures of the rows of one setting and estimator, with their headings; None where nothing answered.

    Parameters
    ----------
    n : int
        True highlights, answered, failed or missed.
    n_ok, n_missed : int
        Of these, how many were answered and how many were missed.
    n_failed_by_reason : dict
        Of these, how many failed.
    n_false, n_in_spot : int
        False detections, answered or not, and detections in spots of a relief that melt several glints or hold none;
        they count nowhere else (`row_kind`).
    n_instrument : int or None
        Detections that show an instrument, which count nowhere else; None in a run without instruments.
    mean_deg, mean_oracle_deg, rms_deg, std_deg, median_deg, p95_deg, max_deg : float or None
        Of the errors of the answers.
    mean_base_deg : float or None
        Mean error against the base's normal; `mean_deg` itself without a relief.
    mean_penalised_deg : float or None
        Mean with `PENALTY_DEG` for each failed or missed highlight.
    ci95_deg : tuple of float or None
        Confidence interval of the mean, frames being the independent units.
    coverage95 : float or None
        Share of the answers with an uncertainty whose 95 % region holds the true normal.
    wrong_and_sure : float or None
        Share of the answers with a covariance that `is_wrong_and_sure`.
    """

    model_config = ConfigDict(frozen=True)

    n: int = Field(title="true highlights")
    n_ok: int = Field(title="ok")
    n_failed_by_reason: dict[str, int] = Field(title="failed")
    n_missed: int = Field(title="missed")
    n_false: int = Field(title="false")
    n_in_spot: int = Field(title="in spots")
    n_instrument: int | None = Field(None, title="on instruments")
    mean_deg: float | None = Field(title="mean\u00a0°")
    # In the file alone: the page has figures of its own for it.
    mean_base_deg: float | None = None
    mean_oracle_deg: float | None = Field(title="mean, better candidate\u00a0°")
    rms_deg: float | None = Field(title="RMS\u00a0°")
    std_deg: float | None = Field(title="std\u00a0°")
    median_deg: float | None = Field(title="median\u00a0°")
    p95_deg: float | None = Field(title="95th pct\u00a0°")
    max_deg: float | None = Field(title="max\u00a0°")
    mean_penalised_deg: float | None = Field(title="mean, failures as\u00a090°")
    ci95_deg: Interval = Field(title="95\u00a0% interval\u00a0°")
    coverage95: float | None = Field(title="coverage 95\u00a0%")
    wrong_and_sure: float | None = Field(None, title="wrong and sure")


def summarise(results: pl.DataFrame) -> dict[str, dict[str, Figures]]:
    """Compute the figures of one experiment's rows by setting and estimator, in order of appearance."""
    summary: dict[str, dict[str, Figures]] = {}
    for (setting, estimator), rows in results.group_by("setting", "estimator", maintain_order=True):
        summary.setdefault(str(setting), {})[str(estimator)] = figures(rows)
    return summary


def figures(rows: pl.DataFrame) -> Figures:
    """Compute the figures of the rows of one setting and estimator."""
    # Once: there are many settings, and an expression costs more than their few rows.
    kinds = rows.select(row_kind(rows)).to_series()
    count, answered = Counter(kinds.to_list()), rows.filter(kinds == "ok")
    n, failed = count["ok"] + count["failed"] + count["missed"], Counter(rows["status"].filter(kinds == "failed"))
    # Errors of the answers, and the penalty of the others.
    errors = answered["error_deg"].to_numpy()
    penalised = np.concatenate([errors, np.full(n - len(errors), PENALTY_DEG)])
    distances = answered["mahalanobis2"].drop_nulls().to_numpy()
    stated = answered.drop_nulls("cov_11")
    variances = (stated["cov_11"] + stated["cov_22"]).to_numpy()
    wrong = is_wrong_and_sure(stated["error_deg"].to_numpy(), np.degrees(np.sqrt(variances.clip(0))))
    low, high = mean_interval(errors, *units(answered))
    return Figures(
        n=n,
        n_ok=count["ok"],
        n_failed_by_reason=dict(sorted(failed.items())),
        n_missed=count["missed"],
        n_false=count["false"],
        n_in_spot=count["in_spot"],
        mean_deg=_or_none(np.mean, errors),
        mean_base_deg=_or_none(np.mean, answered["error_base_deg"].drop_nulls().to_numpy())
        if "error_base_deg" in rows.columns
        else None,
        mean_oracle_deg=_or_none(np.mean, answered["error_oracle_deg"].to_numpy()),
        rms_deg=root_mean_square(errors),
        std_deg=float(np.std(errors, ddof=1)) if len(errors) > 1 else None,
        median_deg=_or_none(np.median, errors),
        p95_deg=_or_none(lambda e: np.percentile(e, 95), errors),
        max_deg=_or_none(np.max, errors),
        mean_penalised_deg=_or_none(np.mean, penalised),
        # An angle is not negative, nor is its mean.
        ci95_deg=(None if low is None else max(low, 0.0), high),
        coverage95=float(np.mean(distances <= chi_squared.quantile(CONFIDENCE, 2))) if len(distances) else None,
        wrong_and_sure=_or_none(np.mean, wrong),
        **({"n_instrument": count[ON_INSTRUMENT]} if ON_INSTRUMENT in rows.columns else {}),
    )


def _or_none(statistic: Callable[[Any], Any], values: Array | Mask) -> float | None:
    return float(statistic(values)) if len(values) else None


def units(rows: pl.DataFrame) -> tuple[IntArray, IntArray]:
    """Return the number of the frame, of a dataset the anatomy, and of the setting of each row, from 0.

    They are the groups and the strata of an interval (`simtest.runtime.statistics`).
    """
    strata = FRAME[:-1]
    groups = (*strata, ANATOMY) if ANATOMY in rows.columns else FRAME
    numbers = rows.select(frames=pl.struct(groups).rank("dense"), settings=pl.struct(strata).rank("dense"))
    frames, settings = (number.to_numpy().astype(int) - 1 for number in numbers)
    return frames, settings


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
