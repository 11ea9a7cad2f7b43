"""The article's statements beside what a run of the published protocol says, each with its rule and its reason."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from simtest.conventions import PAPER_SMOOTHING_PX
from simtest.pages.style import degrees, number
from simtest.report.paper.sweeps import DEFAULTS, PARAMETERS, Sweep, SweepFigure, Value
from simtest.runtime.arrays import Array
from simtest.validation.paper.isocurves import isophote_radius


class Line(NamedTuple):
    """A least-squares line."""

    slope: float
    error: float  # standard error of the slope, from the means'; NaN where one of these is unknown
    worst: float  # largest distance of a mean from the line


def fit_line(x: Array, y: Array, error: Array | None = None) -> Line:
    """Fit a line to means at two x or more by ordinary least squares; `error` are their standard errors, independent.

    Points without a finite mean are left out.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
    slope = float(weights @ y)
    worst = float(np.abs(y - y.mean() - slope * (x - x.mean())).max())
    spread = float("nan") if error is None else float(np.sqrt(np.sum((weights * error[known]) ** 2)))
    return Line(slope, spread, worst)


def offset_inside_window(fixed: Mapping[str, Value]) -> float:
    """Return the light offset, texture units, up to which the isophote stays inside a window at the camera's foot.

    `fixed` are the sweep's parameters: isovalue, exponent, height and size. The BP lies at most
    eps V_Z / (2 V_Z - eps / 2) from the foot (the light at its lowest), and the isophote's radius about it is close to
    r-.
    """
    isovalue, exponent, height, size = (float(fixed[name] or 0) for name in ("isovalue", "exponent", "height", "size"))
    room = size / 2 - isophote_radius(isovalue, exponent, height)
    return max(0.0, 2 * height * room / (height + room / 2))


NEAR_ZERO_SLANT = (
    "Near θ = 0 circle pose is at its branch point: a relative axis error δ tilts the normal by √(2δ), so that even "
    "small noise leaves degrees, and the error falls before it grows. A sweep that starts at a slant of some tens of "
    "degrees does not see this."
)

ISOVALUE_MINIMUM = (
    "Noise moves the isophote by σ over the lobe's slope, relative to its axes by σ / (t (−ln t)), and a contour holds "
    "independent noise in proportion to its length, √(−ln t): the error is then least where t (−ln t)^(5/4) is "
    "largest, at t = exp(−5/4) = 0.29. A wider smoothing, whose bias falls slowly with t, moves the minimum up."
)
"""Of the isovalue sweep's minimum."""

NOISE = (
    "The bias of the smoothing dominates at small noise and the random part may lean against it, which flattens the "
    "curve there. A run of more realisations tells the two apart."
)

NOISE_LEVEL = (
    "The noise's effect depends on the number of pixels on the isophote and on the smoothing, which the article does "
    "not state. The bias of the smoothing alone is drawn beside the means below."
)

TRUNCATION = (
    "A realisation whose isophote leaves the texture's window either fails or is fitted to a cut curve. That is "
    "truncation by the window, not the model."
)

OFFSET = (
    "The isophote of an offset light is no circle, and the model's error grows with ε. What noise and smoothing leave "
    "at ε = 0 is in both means, so that the ratio hangs on them."
)

BRANCH_POINT = (
    "The slope is 1/2 as long as the axes' relative error is small and noise alone causes it. Bias of the smoothing or "
    "failures at large noise bend the curve."
)

SMOOTHING = (
    "The law takes the lobe as Gaussian to second order and the isophote well inside the texture's window. Where the "
    "smoothing is as wide as the isophote, or reaches over the window's edge, it does not hold."
)


def exponent_slope(sweep: Sweep, law_slope: float, published: float) -> str:
    """Explain where the slope against the exponent comes from.

    `law_slope` is that of the smoothing's predicted bias, NaN where there is no law, `published` that of the article;
    deg per unit.
    """
    if not law_slope > 0:
        return (
            "The slope hangs on the smoothing's width, which the article does not state. "
            "This run has no prediction of the smoothing's bias to compare it with."
        )
    width = float(sweep.fixed.get("smoothing_px") or PAPER_SMOOTHING_PX)
    return (
        f"The slope is mainly the smoothing's bias, which grows with n s²: without noise {number(law_slope)}° per "
        f"unit is predicted at this run's s = {width:g} px. The article does not state its width; "
        f"its slope would belong to about {number(width * (published / law_slope) ** 0.5, 2)} px."
    )


AGREES, DIFFERS, ABSENT = "agrees", "differs", "not in this run"
PART, FEW = "only part of the range", "too few realisations"
"""What the run holds agrees, but is not the claim's whole range; there is no standard error to judge by."""

ESTIMATOR = "circle_pose"  # the article's method; only its sweeps are compared
ARTICLE, EXPECTED = "published", "expected here"
# Figures of [MB, section 3.1]; docs/concepts/theory.md, section 2.
MEAN_BELOW_DEG = 1.25
SLANT_BELOW_DEG = 7.0
EXPONENT_BELOW_DEG = 1.75
EXPONENT_SLOPE_DEG = 1e-2
LEAST_AT = (0.5, 0.6)
STABLE_TO = 200.0

BRANCH_SLOPE = 0.5
SLOPE_TOLERANCE = 0.05
STABLE_TOLERANCE = 0.1
LAW_TOLERANCE = 0.2
LAW_FROM_PX = 1.0
FREE = ("smoothing_px",)  # parameters that the article does not state: any fixed value is compared


@dataclass(frozen=True)
class Statement:
    """A row of the table."""

    sweep: str
    claim: str  # what is stated
    source: str  # by whom
    rule: str  # when it counts as met
    measured: str  # what the run gave; empty where it holds no such sweep
    verdict: str  # `AGREES`, `DIFFERS`, `ABSENT`, `PART` or `FEW`
    because: str = ""  # why it differs; empty otherwise


@dataclass(frozen=True)
class _Check:
    """A statement with the sweep it is about and the test of it, which gives the measured text and whether it holds."""

    parameter: str
    fixed: dict[str, Value]
    claim: str
    rule: str
    test: Callable[[Sweep], tuple[str, bool]]
    because: str | Callable[[Sweep], str]
    source: str = ARTICLE
    where: str = ""
    range: tuple[float, float] | None = None
    """Least and largest answered setting that the claim needs."""

    def verdict(self, sweep: Sweep, met: bool) -> str:
        """Return the verdict on a sweep that the test has looked at."""
        answered = np.isfinite(sweep.mean)
        if self.test in _BY_STANDARD_ERROR and not np.isfinite(sweep.standard_error[answered]).all():
            return FEW
        if not met:
            return DIFFERS
        x = sweep.x[answered]
        whole = self.range is None or (x.min() <= self.range[0] and x.max() >= self.range[1])
        return AGREES if whole else PART


def statements(figures: Sequence[SweepFigure]) -> list[Statement]:
    """Judge every statement on the sweeps of a run.

    The article's come first, in its order, then those of this project's own analysis that the run has a sweep for.
    """
    rows = []
    for check in _CHECKS:
        sweep = _find(figures, check)
        about = PARAMETERS[check.parameter]
        name = f"{about.words} {about.symbol}" + (f", {check.where}" if check.where else "")
        if sweep is None:
            if check.source == ARTICLE:
                rows.append(Statement(name, check.claim, check.source, check.rule, "", ABSENT))
            continue
        measured, met = check.test(sweep)
        verdict = check.verdict(sweep, met)
        told = check.because if isinstance(check.because, str) else check.because(sweep)
        because = told if verdict == DIFFERS else ""
        rows.append(Statement(name, check.claim, check.source, check.rule, measured, verdict, because))
    return rows


def _find(figures: Sequence[SweepFigure], check: _Check) -> Sweep | None:
    """Return the first sweep of the article's method at the check's settings with two answered ones."""
    wanted = {name: value for name, value in {**DEFAULTS, **check.fixed}.items() if name != check.parameter}
    for figure in figures:
        for sweep in figure.sweeps if figure.parameter.name == check.parameter else ():
            named = all(sweep.fixed.get(k) == v for k, v in wanted.items() if k not in FREE or k in check.fixed)
            if sweep.estimator == ESTIMATOR and named and np.isfinite(sweep.mean).sum() > 1:
                return sweep
    return None


def _at(sweep: Sweep, index: int) -> str:
    return f"{degrees(float(sweep.mean[index]))} at {sweep.parameter.text(float(sweep.x[index]))}"


def _largest(sweep: Sweep, values: Array) -> str:
    index = int(np.nanargmax(values))
    return f"{degrees(float(values[index]))} at {sweep.parameter.text(float(sweep.x[index]))}"


def _grows(sweep: Sweep) -> tuple[str, bool]:
    known = np.flatnonzero(np.isfinite(sweep.mean))
    mean, error = sweep.mean[known], sweep.standard_error[known]
    noise = 2 * np.hypot(error[1:], error[:-1])
    met = bool(np.all(np.diff(mean) >= -noise) and mean[-1] - mean[0] > 2 * np.hypot(error[0], error[-1]))
    text = f"mean {_at(sweep, known[0])}, {_at(sweep, known[-1])}"
    least = known[int(mean.argmin())]
    return (text if least == known[0] else f"{text}; least {_at(sweep, least)}"), met


def _mean_below(sweep: Sweep) -> tuple[str, bool]:
    return f"largest mean {_largest(sweep, sweep.mean)}", bool(np.nanmax(sweep.mean) < MEAN_BELOW_DEG)


def _single_below(limit: float) -> Callable[[Sweep], tuple[str, bool]]:
    def test(sweep: Sweep) -> tuple[str, bool]:
        text = f"largest single error {_largest(sweep, sweep.largest)}, largest mean {_largest(sweep, sweep.mean)}"
        return text, bool(np.nanmax(sweep.largest) < limit)

    return test


def _slope(sweep: Sweep) -> tuple[str, bool]:
    line = fit_line(sweep.x, sweep.mean, sweep.standard_error)
    low, high = EXPONENT_SLOPE_DEG / 2, EXPONENT_SLOPE_DEG * 2
    met = line.slope + 2 * line.error >= low and line.slope - 2 * line.error <= high
    text = f"slope ({1e3 * line.slope:.2f} ± {1e3 * line.error:.2f})·10⁻³\u00a0° per unit"
    return f"{text}, straight to within {degrees(line.worst)}", met


def _why_slope(sweep: Sweep) -> str:
    known = np.isfinite(sweep.law)
    slope = fit_line(sweep.x[known], sweep.law[known]).slope if known.sum() > 1 else float("nan")
    return exponent_slope(sweep, slope, EXPONENT_SLOPE_DEG)


def _u_shape(sweep: Sweep) -> tuple[str, bool]:
    # Where most realisations failed, the others are a selection, and few.
    known = np.flatnonzero(np.isfinite(sweep.mean) & (sweep.answered >= sweep.failed))
    if known.size < 3:
        return "fewer than three settings where at least half of the realisations answered", False
    least = known[int(sweep.mean[known].argmin())]
    error = sweep.standard_error
    inside = [i for i in known if LEAST_AT[0] - 1e-9 <= sweep.x[i] <= LEAST_AT[1] + 1e-9]
    ends = (known[0], known[-1])
    is_u = all(sweep.mean[i] - sweep.mean[least] > 2 * np.hypot(error[i], error[least]) for i in ends)
    near = any(sweep.mean[i] - sweep.mean[least] <= 2 * np.hypot(error[i], error[least]) for i in inside)
    text = f"{'U-shaped' if is_u else 'not U-shaped'}: mean {_at(sweep, ends[0])}, {_at(sweep, ends[1])}; "
    return text + f"least {_at(sweep, least)}", is_u and near


def _stable(sweep: Sweep) -> tuple[str, bool]:
    known = np.isfinite(sweep.mean)
    at_end = np.flatnonzero(known & (np.abs(sweep.x - STABLE_TO) < 1e-9))
    at_zero = np.flatnonzero(known & (sweep.x == 0))
    if not (at_end.size and at_zero.size):
        return f"no value at ε = 0 or ε = {STABLE_TO:g}", False
    first, last = int(at_zero[0]), int(at_end[0])
    ratio = float(sweep.mean[last] / sweep.mean[first])
    shares = sweep.standard_error[[first, last]] / sweep.mean[[first, last]]
    error = ratio * float(np.hypot(*shares))
    met = abs(ratio - 1) <= STABLE_TOLERANCE + 2 * error
    largest = _largest(sweep, sweep.mean)
    return f"mean at ε = {STABLE_TO:g} over that at 0: {ratio:.3f} ± {error:.3f}; largest mean {largest}", met


def _half(sweep: Sweep) -> tuple[str, bool]:
    kept = (sweep.x > 0) & (sweep.mean > 0)
    if kept.sum() < 2:
        return "fewer than two settings with noise", False
    line = fit_line(np.log(sweep.x[kept]), np.log(sweep.mean[kept]), (sweep.standard_error / sweep.mean)[kept])
    met = abs(line.slope - BRANCH_SLOPE) <= SLOPE_TOLERANCE + 2 * line.error
    return f"slope {line.slope:.3f} ± {line.error:.3f}", met


def _bias(sweep: Sweep) -> tuple[str, bool]:
    kept = np.isfinite(sweep.mean) & np.isfinite(sweep.law) & (sweep.law > 0)
    pairs = [f"{number(m)}/{number(p)}" for m, p in zip(sweep.mean[kept], sweep.law[kept], strict=True)]
    wide = kept & (sweep.x >= LAW_FROM_PX)
    gaps = np.abs(sweep.law[wide] / sweep.mean[wide] - 1)
    met = bool(wide.any() and np.all(gaps <= LAW_TOLERANCE))
    widths = ", ".join(f"{x:g}" for x in sweep.x[kept])
    worst = f"; largest departure {number(100 * float(gaps.max()), 2)}\u00a0%" if gaps.size else ""
    return f"measured/predicted {', '.join(pairs)}° at s = {widths} px{worst}", met


def _truncation(sweep: Sweep) -> tuple[str, bool]:
    limit = offset_inside_window(sweep.fixed)
    inside = sweep.x <= limit
    total = int(sweep.failed[inside].sum())
    beyond = ", ".join(
        f"{int(f)} of {int(f + n)} at {x:g}"
        for x, f, n in zip(sweep.x, sweep.failed, sweep.answered, strict=True)
        if f and x > limit
    )
    met = total == 0 and bool(beyond)
    text = f"failures up to ε = {limit:.0f}: {total}; beyond: {beyond or 'none'}"
    return f"{text}; largest mean {_largest(sweep, sweep.mean)}", met


_BY_STANDARD_ERROR = (_grows, _slope, _u_shape, _stable, _half)  # tests that hang on the means' standard errors

SIGMA, SLANT, EXPONENT, ISOVALUE = (0.0, 0.1), (10.0, 75.0), (30.0, 120.0), (0.05, 0.8)
"""Ranges of the article's claims; towards slant 90 and t = 0.02 the window leaves no closed isophote."""


_CHECKS = (
    _Check(
        "sigma", {}, "the mean error grows with the noise",
        "no mean falls below the one before by more than 2 standard errors, and the last is above the first",
        _grows, NOISE, range=SIGMA,
    ),
    _Check(
        "sigma", {}, f"the mean stays below {MEAN_BELOW_DEG}° throughout to 10\u00a0%", "largest mean",
        _mean_below, NOISE_LEVEL, range=SIGMA,
    ),
    _Check(
        "theta_deg", {}, "strong growth of the error with the slant",
        "no mean falls below the one before by more than 2 standard errors, and the last is above the first",
        _grows, NEAR_ZERO_SLANT, range=SLANT,
    ),
    _Check(
        "theta_deg", {}, f"the maximum stays below {SLANT_BELOW_DEG:g}°", "largest single error",
        _single_below(SLANT_BELOW_DEG), NEAR_ZERO_SLANT, range=SLANT,
    ),
    _Check(
        "exponent", {}, "about linear, slope about 10⁻² degrees per unit",
        "least-squares slope of the means within a factor of 2, give or take 2 standard errors", _slope, _why_slope,
        range=EXPONENT,
    ),
    _Check(
        "exponent", {}, f"never above {EXPONENT_BELOW_DEG}°", "largest single error",
        _single_below(EXPONENT_BELOW_DEG), NOISE_LEVEL, range=EXPONENT,
    ),
    _Check(
        "isovalue", {}, f"U-shaped, minimum at {LEAST_AT[0]:g} to {LEAST_AT[1]:g}",
        "of the settings where at least half answered, both ends above the least mean and a mean in that range "
        "equal to it, by 2 standard errors",
        _u_shape, ISOVALUE_MINIMUM, range=ISOVALUE,
    ),
    _Check(
        "eps", {"exponent": 100.0}, f"stable up to ε = {STABLE_TO:g}",
        f"ratio 1 within {STABLE_TOLERANCE:g}, give or take 2 standard errors", _stable, OFFSET,
    ),
    _Check(
        "sigma", {"theta_deg": 0.0}, "at slant 0 the error grows with the root of the noise: log-log slope 1/2",
        f"within {SLOPE_TOLERANCE:g}, give or take 2 standard errors", _half, BRANCH_POINT,
        EXPECTED, "slant 0",
    ),
    _Check(
        "eps", {"exponent": 100.0, "recentre": False},
        "with the window at the foot, failures begin where the window cuts the isophote, and not before",
        "no failure before, some beyond", _truncation, TRUNCATION, EXPECTED, "window at the foot",
    ),
    *(
        _Check(
            "smoothing_px", {"sigma": 0.0, "isovalue": t}, "without noise the error is the smoothing's predicted bias",
            f"within {LAW_TOLERANCE:.0%} from s = {LAW_FROM_PX:g} px on", _bias, SMOOTHING,
            EXPECTED, f"no noise, t = {t:g}",
        )
        for t in (0.1, 0.5)
    ),
)  # fmt: skip
