"""What answers a question: each method's error and answers in the results, and where methods fail by the laws.

Frames, not highlights, are the independent units, and the distances are strata.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.advice.plan import DISTANCES, Question
from simtest.advice.tissue import rough
from simtest.runtime.statistics import Interval, mean_interval, root_mean_square
from simtest.validation import laws
from simtest.validation.comparison import Pair, best_of, targets_of
from simtest.validation.guide import Advice, MethodFigures, advice_of
from simtest.validation.situations import SMALL_SPOT_PX, Situation
from simtest.validation.statistics import FRAME, is_false, units

WIDE = 0.15
"""An interval that reaches farther from its mean than this share of it is called wide."""

LEAST_PART_DEG = 1e-6
"""A part of the budget below this is rounding."""

STRATUM = "surface.distance_mm"


@dataclass(frozen=True)
class MeanError:
    """The mean error of a method's answers, deg, with its 95 % interval; None where too little was answered."""

    mean_deg: float | None
    interval_deg: Interval
    answers: int
    frames: int

    @property
    def reach(self) -> float | None:
        """How far the interval reaches above the mean, as a share of it; None without an interval."""
        high = self.interval_deg[1]
        return None if not self.mean_deg or high is None else high / self.mean_deg - 1

    @property
    def is_wide(self) -> bool:
        """Whether the interval is too wide to tell a difference of 15 %."""
        return self.reach is None or self.reach > WIDE


@dataclass(frozen=True)
class MethodAnswers:
    """One method's answers: errors against both surfaces, and the terms of its budget, deg."""

    estimator: str
    target: str  # surface whose normal it states
    asked: int  # detections that hold a true highlight; of a method of clouds, the base's highlights
    answered: int
    refused: int
    missed: int
    fine: MeanError
    base: MeanError
    stated_deg: float | None  # root mean square of the stated standard deviations
    budget_deg: Mapping[str, float]  # the same of each part

    @property
    def own(self) -> MeanError:
        """The error against the surface whose normal it states."""
        return self.fine if self.target == "fine" else self.base


@dataclass(frozen=True)
class Difference:
    """Mean of another method's error minus the best one's over the highlights that both answered, deg."""

    other: str
    mean_deg: float | None  # None where both answered no highlight
    interval_deg: Interval
    highlights: int
    tied: bool  # whether the two cannot be told apart, or differ too little to matter


@dataclass(frozen=True)
class Choice:
    """Which method to use for the normal of a surface."""

    target: str
    best: str | None  # None where nothing was answered
    ties: tuple[str, ...]
    others: tuple[Difference, ...]  # of the other methods that answered, in the order of the ranking
    by_distance: Mapping[float, MethodFigures]


@dataclass(frozen=True)
class Answers:
    """What an advice's frames say."""

    frames: int
    visible: int  # visible highlights that stand above the noise; on a smooth surface all true ones
    found: int  # those of them that the detector found
    detections: int
    matched: int  # detections that hold a true highlight: what the methods of the fine surface are asked about
    unmatched: int  # detections in a visible highlight that melts several glints or holds none
    false: int  # detections that show no highlight
    methods: list[MethodAnswers]  # those of a choice together, the best first, in the order of the ranking
    choices: list[Choice]  # for the fine surface and, where a method states it, the base

    def method(self, name: str) -> MethodAnswers:
        """Return a method by name."""
        return next(each for each in self.methods if each.estimator == name)

    def beside(self, name: str) -> Difference | None:
        """Return how a method compares with the best; None for the best, and for one that did not answer."""
        return next((each for choice in self.choices for each in choice.others if each.other == name), None)

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON."""
        record = asdict(self)
        for choice in record["choices"]:
            choice["by_distance"] = {f"{at:g}": figures for at, figures in choice["by_distance"].items()}
        return record


def read_results(results: pl.DataFrame, frames: int, distances: int = DISTANCES) -> Answers:
    """Read the results of an advice's experiment, of so many frames, as many at each of some distances."""
    rows = results if STRATUM in results.columns else results.with_columns(pl.lit(0.0).alias(STRATUM))
    rows = rows.with_columns(pl.format("{} mm", STRATUM).alias("setting"))
    targets = targets_of(rows)
    single = next((name for name, target in targets.items() if target == "fine"), None)
    counted, choices = _counted(rows.filter(pl.col("estimator") == single)), _choices(rows)
    # What the recommendation goes by is what the table is sorted by.
    ranked = [name for choice in choices if choice.best for name in (choice.best, *(d.other for d in choice.others))]
    order = dict.fromkeys([*ranked, *targets])
    # Not of the distances that have rows: one without a highlight has none.
    methods = [_answers(name, targets[name], rows, frames // distances) for name in order]
    return Answers(frames, *counted, methods, choices)


def _counted(rows: pl.DataFrame) -> tuple[int, int, int, int, int, int]:
    """Return visible highlights, those found, and detections: all, matched, unmatched and false; from one method."""
    detected = rows.filter(pl.col("specularity").is_not_null())
    matched, false = detected["true_id"].count(), detected.filter(is_false(detected)).height
    kinds = detected.height, matched, detected.height - matched - false, false
    if rows["frame_visible"].null_count() == rows.height:
        # On a smooth surface a visible highlight is a true one.
        true = rows.filter(pl.col("true_id").is_not_null())
        # Without a detection a highlight is not found, whatever its status: in the dark it is no missed one.
        return true.height, true.drop_nulls("specularity").height, *kinds
    visible = rows.group_by(FRAME).agg(pl.col("frame_visible").max())["frame_visible"].sum()
    hit = detected.drop_nulls("visible_id").unique([*FRAME, "visible_id"]).height
    return int(visible), hit, *kinds


def _asked(rows: pl.DataFrame, target: str) -> pl.DataFrame:
    """Return the rows of true highlights that a method was asked about.

    A glint that no detection holds was asked of no method: most of a relief's glints are not even visible.
    """
    true = rows.filter(pl.col("true_id").is_not_null())
    return true.filter(pl.col("specularity").is_not_null()) if target == "fine" else true


def _answers(name: str, target: str, rows: pl.DataFrame, frames: int) -> MethodAnswers:
    own = _asked(rows.filter(pl.col("estimator") == name), target)
    answered = own.filter(pl.col("status") == "ok")
    missed = own.filter(pl.col("status") == "missed").height
    parts = {c.name: root_mean_square(c.drop_nulls().to_numpy()) for c in answered.select("^budget_.*$")}
    told = {name: value for name, value in parts.items() if value and value > LEAST_PART_DEG}
    budget = {name.removeprefix("budget_").removesuffix("_deg"): value for name, value in told.items()}
    return MethodAnswers(
        name, target, own.height, answered.height, own.height - answered.height - missed, missed,
        mean_error(answered, "error_fine_deg", frames), mean_error(answered, "error_base_deg", frames),
        _stated(answered), budget,
    )  # fmt: skip


def mean_error(answered: pl.DataFrame, column: str, frames: int | None = None) -> MeanError:
    """Return the mean of a column of errors, deg, with the interval that its frames' spread gives.

    `frames` is how many there are at each distance, those without an answer too; default those with one.
    """
    rows = answered.drop_nulls(column)
    values = rows[column].to_numpy()
    if not len(values):
        return MeanError(None, (None, None), 0, 0)
    numbers, strata = units(rows)
    answering, first = np.unique(numbers, return_index=True)
    # Frames without an answer hold no values: one more or one fewer of them moves the mean.
    empty = np.maximum((frames or 0) - np.bincount(strata[first]), 0)
    nothing = np.repeat(np.arange(len(empty)), empty)
    none, counts = np.zeros(len(nothing)), np.ones(len(values))
    low, high = mean_interval(
        np.concatenate([values, none]), np.concatenate([numbers, len(numbers) + np.arange(len(nothing))]),
        np.concatenate([strata, nothing]), np.concatenate([counts, none]),
    )  # fmt: skip
    return MeanError(float(np.mean(values)), (low if low is None else max(low, 0.0), high), len(values), len(answering))


def _stated(answered: pl.DataFrame) -> float | None:
    """Return the root mean square of the stated standard deviations, both tangent directions together, deg."""
    trace = answered.select((pl.col("cov_11") + pl.col("cov_22")).alias("trace")).drop_nulls()["trace"].to_numpy()
    return float(np.degrees(np.sqrt(np.mean(trace)))) if len(trace) else None


def _choices(rows: pl.DataFrame) -> list[Choice]:
    """Return which method is best, for each surface whose normal a method states (`simtest.validation.guide`)."""
    base = pl.col("target").fill_null("fine") == "base"
    asked = pl.concat([_asked(rows.filter(~base), "fine"), _asked(rows.filter(base), "base")])
    if asked.is_empty():
        return []
    situation = Situation("", "", tuple(map(str, asked["setting"].unique(maintain_order=True))))
    return [_choice(advice) for advice in advice_of(situation, asked)]


def _choice(advice: Advice) -> Choice:
    ties = (*advice.ties, *advice.unranked)
    by_distance = {float(setting.split()[0]): figures for setting, figures in advice.by_setting.items()}
    if advice.best is None:
        return Choice(advice.target, None, ties, (), by_distance)
    others, left = list[Difference](), [n for n, own in advice.methods.items() if own.answered and n != advice.best]
    # As in the guide: of methods that the pairs leave alike, the one that answers more comes first.
    left.sort(key=lambda name: -advice.methods[name].answered)
    while left:
        name = best_of(advice.pairs, [name for name in left if not advice.methods[name].is_silent] or left)
        left.remove(name)
        pair = next(pair for pair in advice.pairs if {pair.first, pair.second} == {advice.best, name})
        others.append(_difference(pair, name, name in ties))
    return Choice(advice.target, advice.best, ties, tuple(others), by_distance)


def _difference(pair: Pair, other: str, tied: bool) -> Difference:
    mean, (low, high) = pair.difference_deg, pair.interval_deg
    if other != pair.first:
        mean = None if mean is None else -mean
        if low is not None and high is not None:
            low, high = -high, -low
    return Difference(other, mean, (low, high), pair.n, tied)


# Break-points: by closed-form laws, on smooth walls but for the slope of a relief -------------------------------------

NEAREST_MM = 3.0
"""A break-point nearer than this is not named: no endoscope works there."""

STREAK_KD = -0.9
"""d k at which abs(1 + d k) = 0.1, below which `curved` refuses."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean angle between a glint's normal and the base's, in slopes an axis (theory.md 7.4)."""

_HALVINGS = 60


@dataclass(frozen=True)
class BreakPoint:
    """A value of one quantity at which a law gives the error that is asked about, or spots lose their shape."""

    title: str  # what breaks, in words
    method: str  # that is concerned
    quantity: str  # that is varied
    unit: str
    value: float  # where it breaks, by the law
    law: str  # in words and symbols
    expected: float | None  # error that the law gives there, deg; None where it says that the method refuses
    also: str  # the same in other terms, such as the offset over the distance


def break_points(question: Question) -> list[BreakPoint]:
    """Return the break-points of a question by the laws."""
    return [*_offset_ignored(question), *_distance_unknown(question), *_streak_and_relief(question)]


def _offset_ignored(question: Question) -> Iterator[BreakPoint]:
    """Find the distance at which a method that ignores the light's offset errs by the bound."""
    offset = float(np.mean(question.scope.offsets_mm))
    distance = offset / math.tan(2 * math.radians(question.bound_deg))
    if distance >= NEAREST_MM:
        distance = round(distance, 3)
        yield BreakPoint(
            "a method that ignores the light's offset", "cone_axis", "distance", "mm", distance,
            "atan(eps / d) / 2", float(np.degrees(laws.offset_error(offset / distance))),
            f"eps/d = {offset / distance:.3g}, eps = {offset:.3g} mm",
        )  # fmt: skip


def _distance_unknown(question: Question) -> Iterator[BreakPoint]:
    """Find the distances between which a bisector that knows the range alone errs by less than the bound."""
    offset = float(np.mean(question.scope.offsets_mm))
    if not offset:
        return
    # The distance given is the middle of the range.
    middle = question.middle_mm

    def law_deg(distance: float) -> float:
        point = np.array([0.0, 0.0, distance])
        return float(np.degrees(laws.bisector_residual(point, np.array([offset, 0.0, 0.0]), middle / distance - 1)))

    # The error grows from the middle to either end.
    for side, end in (("below", NEAREST_MM), ("beyond", question.distances_mm[1])):
        low, high = middle, end
        if (end < middle) != (side == "below") or law_deg(end) < question.bound_deg:
            continue
        for _ in range(_HALVINGS):
            half = (low + high) / 2
            low, high = (low, half) if law_deg(half) > question.bound_deg else (half, high)
        distance = round(high, 3)
        if distance < NEAREST_MM:
            continue
        yield BreakPoint(
            f"bisector, given the range of the distance alone, {side} the middle", "bisector", "distance", "mm",
            distance, "eps / 2 * abs(1 / d - 1 / middle)", law_deg(distance),
            f"eps/d = {offset / distance:.3g}, middle = {middle:g} mm",
        )  # fmt: skip


def _streak_and_relief(question: Question) -> Iterator[BreakPoint]:
    """Find the curvature of a streak, and the slope at which a glint's normal is off the base's by the bound."""
    middle, slope = question.middle_mm, round(question.bound_deg / RAYLEIGH_MEAN, 3)
    yield BreakPoint(
        "a wall seen from near its centre of curvature: a streak", "curved", "d k", "", STREAK_KD,
        "curved refuses where abs(1 + d k) < 0.1", None,
        f"a concave radius of {-middle / STREAK_KD:.3g} mm at {middle:g} mm",
    )  # fmt: skip
    yield BreakPoint(
        "any single highlight, against the base", "brightest_point", "slope of the relief", "deg",
        slope, "1.25 slopes, whatever the method", RAYLEIGH_MEAN * slope,
        "the light at the camera",
    )  # fmt: skip


@dataclass(frozen=True)
class SpotSize:
    """Radius of a highlight at half its height, px, by the law, and where it falls below what carries a shape."""

    smooth_px: float  # of a smooth flat wall at the middle distance
    relief_px: float  # of a typical glint there
    shapeless_beyond_mm: float | None  # distance from which a typical glint is below `SMALL_SPOT_PX`; None: any


def spot_size(question: Question) -> SpotSize:
    """Return the size of highlights by the laws (theory.md 3.1 and 7.3)."""
    own = rough(question.kind, question.scope.relief)
    low, high = own.film("alpha")
    curvature = 2 / (low * high)
    smooth = question.scope.focal_px * math.sqrt(2 * math.log(2) / (curvature + 2))
    if not own.bands:
        return SpotSize(smooth, smooth, math.inf if smooth >= SMALL_SPOT_PX else None)
    # Curvature of a glint along an axis: the root of the band's mean square, slope times wave number.
    squares = [(sum(band.slope_deg) / 2) / (sum(band.wavelength_mm) / 2) for band in own.bands]
    bend = math.radians(1.0) * 2 * math.pi * math.hypot(*squares)
    farthest = (smooth / SMALL_SPOT_PX) / bend if smooth >= SMALL_SPOT_PX else None
    return SpotSize(smooth, smooth / max(1.0, question.middle_mm * bend), farthest)
