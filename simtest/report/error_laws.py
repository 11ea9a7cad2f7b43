"""The error laws: which law is about which rows, whether the measurements meet it, and the charts of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
import polars as pl

from simtest.pages.charts import Axis, Chart, Mark, Panel, log_range
from simtest.pages.style import FURTHER, NEUTRAL, SERIES, degrees, number, symbols
from simtest.report.error_figures import TOLERANCE_DEG, TOLERANCE_SHARE
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import deviation_of_mean, summed
from simtest.spec.recipes import LawName
from simtest.validation import laws
from simtest.validation.statistics import units

MET, DEPARTS, ABSENT = "met", "departs", "not in this run"
SLOPE = "branch_point_slope"
BRANCH_SLOPE = 0.5


@dataclass(frozen=True)
class Law:
    """A law and the columns of the results that hold its two sides."""

    title: str
    formula: str
    estimator: str  # whose rows it is about
    measured: str  # column
    predicted: str  # column; the branch point's is made from the row's own axis ratio
    is_angle: bool = True  # met within 0.3 deg or 3 %; else a ratio, met within 3 %


LAWS: dict[LawName, Law] = {
    "circle_pose": Law(
        "circle pose on a curved surface", "sin(error) = √((1 − (b/a)²) / (1 + b²))",
        "circle_pose", "error_oracle_deg", "error_law_deg",
    ),
    "branch_point": Law(
        "circle pose near its branch point", "error = √(2δ), δ = 1 − b/a",
        "circle_pose", "error_oracle_deg", "branch_point_deg",
    ),
    "axis_ratio": Law(
        "axis ratio", "b/a = |1 + d k|min / |1 + d k|max",
        "cone_axis", "axis_ratio", "axis_ratio_law", False,
    ),
    "axis_ratio_seen": Law(
        "axis ratio as it is seen", "with falloff, finite isovalue, smoothing and pixels",
        "cone_axis", "axis_ratio", "axis_ratio_seen_law", False,
    ),
    "offset": Law(
        "sightline under light offset", "error = half the angle between L and V, about atan(ε/d) / 2",
        "cone_axis", "error_deg", "error_law_deg",
    ),
    "bisector": Law(
        "bisector with a wrong distance", "difference of those angles at d and at d (1 + e)",
        "bisector", "error_deg", "error_law_deg",
    ),
    "falloff": Law(
        "vignetting or emission not known", "error = k tan φ / (c m² + 2 m + k + k tan² φ)",
        "cone_axis", "error_deg", "error_law_deg",
    ),
    "look": Law(
        "a miss, where the estimate looks", "error = |(I + d S) w|",
        "brightest_point", "error_look_deg", "error_look_law_deg",
    ),
}  # fmt: skip
assert set(LAWS) == set(get_args(LawName))


@dataclass(frozen=True)
class LawResult:
    """What a run says about one law."""

    name: str  # of `LAWS`, or `SLOPE`
    law: Law
    settings: tuple[str, ...]  # those with a value
    measured: Array  # means over each setting's realisations, deg or ratios, shape (n,)
    predicted: Array
    rows: int  # of the law's estimator
    failed: int  # rows without a value on either side
    tolerance: Array  # what each setting may depart by

    @property
    def gap(self) -> Array:
        """Measured less predicted."""
        return self.measured - self.predicted

    @property
    def met(self) -> int:
        """Settings within tolerance."""
        return int((np.abs(self.gap) <= self.tolerance).sum())

    @property
    def verdict(self) -> str:
        """Met only where every setting has a value and is within tolerance."""
        if not self.settings:
            return ABSENT
        return MET if self.met == len(self.settings) and not self.failed else DEPARTS

    def text(self, value: float) -> str:
        """Write a value in the law's unit."""
        return degrees(value) if self.law.is_angle else number(value)

    @property
    def cells(self) -> dict[str, str]:
        """Texts of the table's cells."""
        if not self.settings:
            return dict.fromkeys(("range", "worst", "share", "where", "met"), "–")
        # Where the law is 0, as without noise, no departure is a share of it.
        gap, size = np.abs(self.gap), np.abs(self.predicted)
        share = np.divide(gap, size, out=np.zeros_like(gap), where=size > 0)
        worst, most = int(np.abs(self.gap).argmax()), int(share.argmax())
        met = f"{self.met} of {len(self.settings)}"
        return {
            "range": f"{self.text(self.predicted.min())} to {self.text(self.predicted.max())}",
            "worst": self.text(float(self.gap[worst])),
            "share": f"{number(100 * float(share[most]), 2)}\u00a0%",
            "where": self.settings[most],
            "met": met if not self.failed else f"{met}, {self.failed} of {self.rows} rows without a value",
        }


def law_results(run: Run) -> list[LawResult]:
    """Judge each law, in the order of `LAWS`, on the settings that the experiment names for it; empty without any."""
    if "laws" not in run.results.columns or run.results["laws"].null_count() == run.results.height:
        return []
    ratio = run.results["axis_ratio"]
    tilt = pl.Series(np.degrees(laws.branch_point_error(1 - ratio.to_numpy().astype(float))))
    rows = run.results.with_columns(branch_point_deg=tilt, named=pl.col("laws").str.split(","))
    # A detection of no true highlight has no error: it says nothing of a law.
    rows = rows.filter(pl.col("true_id").is_not_null())
    results = []
    for name, law in LAWS.items():
        own = rows.filter(pl.col("named").list.contains(name) & (pl.col("estimator") == law.estimator))
        results.append(_result(name, law, own))
        if name == "branch_point" and (slope := _slope(own)):
            results.append(slope)
    return results


def _result(name: str, law: Law, rows: pl.DataFrame) -> LawResult:
    both = pl.col(law.measured).is_finite() & pl.col(law.predicted).is_finite() & (pl.col("status") == "ok")
    kept = rows.filter(both.fill_null(False))
    means = kept.group_by("setting", maintain_order=True).agg(
        measured=pl.col(law.measured).mean(), predicted=pl.col(law.predicted).mean()
    )
    measured, predicted = (means[side].to_numpy().astype(float) for side in ("measured", "predicted"))
    floor = TOLERANCE_DEG if law.is_angle else 0.0
    tolerance = np.maximum(floor, TOLERANCE_SHARE * np.abs(predicted))
    settings = tuple(str(setting) for setting in means["setting"])
    return LawResult(name, law, settings, measured, predicted, rows.height, rows.height - kept.height, tolerance)


def _slope(rows: pl.DataFrame) -> LawResult | None:
    """Fit the slope of log error over log sigma; None with fewer than three noise levels."""
    noisy = rows.filter(pl.col("noise_sigma") > 0)
    ok = noisy.filter((pl.col("status") == "ok") & (pl.col("error_oracle_deg") > 0))
    parts = {float(sigma): part for (sigma,), part in ok.group_by("noise_sigma")}
    if len(parts) < 3:
        return None
    sigmas = sorted(parts)
    means, shares = np.array([_mean_with_share(parts[sigma]) for sigma in sigmas]).T
    slope = np.polyfit(np.log(sigmas), np.log(means), 1)[0]
    # The noise levels are independent.
    level = np.log(sigmas) - np.log(sigmas).mean()
    error = float(np.sqrt(np.sum((level * shares) ** 2)) / np.sum(level**2))
    law = Law(
        "the same: slope of log error over log σ", f"1/2; here ± {number(error, 2)} by the errors' spread",
        "circle_pose", "", "", False,
    )  # fmt: skip
    span = f"σ = {sigmas[0]:g} to {sigmas[-1]:g}"
    allowed = np.array([TOLERANCE_SHARE * BRANCH_SLOPE + 2 * error])
    measured, predicted = np.array([slope]), np.array([BRANCH_SLOPE])
    return LawResult(SLOPE, law, (span,), measured, predicted, noisy.height, noisy.height - ok.height, allowed)


def _mean_with_share(rows: pl.DataFrame) -> tuple[float, float]:
    """Return the mean error, and its standard deviation over frames as a share of it; NaN for a single frame."""
    errors = rows["error_oracle_deg"].to_numpy()
    totals, counts, strata = summed(errors, *units(rows), None)
    mean = float(errors.mean())
    return mean, deviation_of_mean(totals, counts, strata) / mean if len(totals) > 1 else np.nan


def is_tested(results: Sequence[LawResult]) -> bool:
    """Whether a run has a value for any law."""
    return any(result.settings for result in results)


def sentence(results: Sequence[LawResult]) -> str:
    """State how many laws are met."""
    judged = [result for result in results if result.verdict != ABSENT]
    met = sum(result.verdict == MET for result in judged)
    departing = [result.law.title for result in judged if result.verdict != MET]
    text = f"Of {len(judged)} error laws, {met} are met at every setting within 0.3° or 3 % (ratios: 3 %)"
    return f"{text}; not everywhere: {'; '.join(departing)}." if departing else f"{text}."


_COLOURS = (*SERIES, *FURTHER)
_LEAST_SHARE = 1e-4  # departures over what is allowed: smaller ones are drawn here on the logarithmic axis


def law_colours(results: Sequence[LawResult]) -> dict[str, str]:
    """Return the colour of each law by its name."""
    return {result.name: _COLOURS[i % len(_COLOURS)] for i, result in enumerate(results)}


def law_charts(results: Sequence[LawResult]) -> list[Chart]:
    """Describe the laws: a chart of angles and one of ratios, where there are any, and one of all departures."""
    colours, dot = law_colours(results), symbols([""])[""]
    kept = [result for result in results if result.settings]
    charts, departures = [], []
    for is_angle, key, title, unit in (
        (True, "laws_angles", "Angles: measured against predicted (deg)", " (deg)"),
        (False, "laws_ratios", "Axis ratios: measured against predicted", ""),
    ):
        shown = [result for result in kept if result.law.is_angle == is_angle and result.name != SLOPE]
        both = [part for result in shown for part in (result.measured, result.predicted)]
        ends = log_range(both) if is_angle else (0.0, 1.05)
        x, y = (Axis(side + unit, "log" if is_angle else "linear", ends) for side in ("predicted", "measured"))
        marks = [Mark(ends, ends, NEUTRAL, line="dash", width=1.5)]
        for result in shown:
            name, colour = result.law.title, colours[result.name]
            marks.append(Mark(result.predicted, result.measured, colour, name, symbol=dot, hover=_hover(result)))
        if shown:
            charts.append(Chart(key, title, (Panel(x, y, tuple(marks)),)))

    for row, result in enumerate(kept):
        share = np.maximum(np.abs(result.gap) / result.tolerance, _LEAST_SHARE)
        at = np.full(share.size, float(row))
        departures.append(Mark(share, at, colours[result.name], symbol=dot, hover=_hover(result)))
    # The first law stands on top.
    ends = len(kept) - 0.5, -0.5
    limit = Mark([1.0, 1.0], ends, NEUTRAL, line="dash", width=1.5)
    x = Axis("|measured − predicted| / allowed; beyond 1 the law is not met", "log")
    y = Axis("", limits=ends, named=tuple((float(i), result.law.title) for i, result in enumerate(kept)))
    panel = Panel(x, y, (limit, *departures))
    return [*charts, Chart("laws_departures", "Departure over what is allowed", (panel,))]


def _hover(result: LawResult) -> list[str]:
    return [
        f"{result.law.title}\n{setting}\nmeasured {result.text(m)}, predicted {result.text(p)}\n"
        f"allowed ± {result.text(a)}"
        for setting, m, p, a in zip(result.settings, result.measured, result.predicted, result.tolerance, strict=True)
    ]
