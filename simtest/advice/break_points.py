"""Where methods fail before a scope, by the closed-form laws: on smooth walls, but for the slope of a relief.

Each break-point is a value of one quantity at which the law gives the error that is asked about, or at which spots lose
their shape.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.advice.organs import rough
from simtest.advice.plan import Question
from simtest.validation import laws
from simtest.validation.situations import SMALL_SPOT_PX

NEAREST_MM = 3.0
"""A break-point nearer than this is not named: no endoscope works there."""

STREAK_KD = -0.9
"""d k at which abs(1 + d k) = 0.1, below which `curved` refuses."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean angle between a glint's normal and the base's, in slopes an axis (theory.md 7.4)."""

_HALVINGS = 60


@dataclass(frozen=True)
class BreakPoint:
    """A break-point.

    Parameters
    ----------
    title : str
        What breaks, in words.
    method : str
        The method concerned.
    quantity, unit : str
        What is varied.
    value : float
        Where it breaks, by the law.
    law : str
        The law, in words and symbols.
    expected : float or None
        Error that the law gives there, deg; None where it says that the method refuses.
    also : str
        The same in other terms, such as the offset over the distance.
    """

    title: str
    method: str
    quantity: str
    unit: str
    value: float
    law: str
    expected: float | None
    also: str


def break_points(question: Question) -> list[BreakPoint]:
    """Return the break-points of a question by the laws."""
    made = (_offset_ignored(question), *_distance_unknown(question), _streak(question), _relief(question))
    return [point for point in made if point is not None]


def _offset_ignored(question: Question) -> BreakPoint | None:
    """Find the distance at which a method that ignores the light's offset errs by the bound."""
    offset = float(np.mean(question.scope.offsets_mm))
    ratio = math.tan(2 * math.radians(question.bound_deg))
    if offset / ratio < NEAREST_MM:
        return None
    distance = round(offset / ratio, 3)
    return BreakPoint(
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
        if law_deg(end) < question.bound_deg:
            continue
        for _ in range(_HALVINGS):
            half = (low + high) / 2
            low, high = (low, half) if law_deg(half) > question.bound_deg else (half, high)
        distance = round(high, 3)
        yield BreakPoint(
            f"bisector, given the range of the distance alone, {side} the middle", "bisector", "distance", "mm",
            distance, "eps / 2 * abs(1 / d - 1 / middle)", law_deg(distance),
            f"eps/d = {offset / distance:.3g}, middle = {middle:g} mm",
        )  # fmt: skip


def _streak(question: Question) -> BreakPoint:
    """Find the curvature at which a concave wall's isophotes become streaks."""
    middle = question.middle_mm
    return BreakPoint(
        "a wall seen from near its centre of curvature: a streak", "curved", "d k", "", STREAK_KD,
        "curved refuses where abs(1 + d k) < 0.1", None,
        f"a concave radius of {-middle / STREAK_KD:.3g} mm at {middle:g} mm",
    )  # fmt: skip


def _relief(question: Question) -> BreakPoint:
    """Find the slope at which a single glint's normal is off the base's by the bound."""
    slope = round(question.bound_deg / RAYLEIGH_MEAN, 3)
    return BreakPoint(
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
    held, drawn = rough(question.kind, question.scope.relief)
    low, high = drawn.get("reflectance.film.alpha", (held["reflectance.film"]["alpha"],) * 2)
    curvature = 2 / (low * high)
    focal = question.scope.focal_px
    smooth = focal * math.sqrt(2 * math.log(2) / (curvature + 2))
    if "surface.relief" not in held:
        return SpotSize(smooth, smooth, math.inf if smooth >= SMALL_SPOT_PX else None)
    # Curvature of a glint along an axis: the root of the band's mean square, slope times wave number.
    bands = enumerate(held["surface.relief"]["bands"])
    squares = [_middle(n, band, "slope_deg", drawn) / _middle(n, band, "wavelength_mm", drawn) for n, band in bands]
    bend = math.radians(1.0) * 2 * math.pi * math.hypot(*squares)
    farthest = (smooth / SMALL_SPOT_PX) / bend if smooth >= SMALL_SPOT_PX else None
    return SpotSize(smooth, smooth / max(1.0, question.middle_mm * bend), farthest)


def _middle(number: int, band: dict[str, Any], name: str, drawn: dict[str, Any]) -> float:
    return sum(drawn.get(f"surface.relief.bands.{number}.{name}", (band[name],) * 2)) / 2
