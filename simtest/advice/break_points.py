"""Where methods fail before a scope, by the closed-form laws, and the renders at these points that confirm it.

Each break-point is a value of one quantity at which the law gives the error that is asked about, or at which spots lose
their shape. The renders are on smooth walls, where the law is exact, except where the relief itself is the quantity.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.advice.figures import MeanError, mean_error
from simtest.advice.organs import is_smooth, pale, rough
from simtest.advice.plan import Question, seen_through
from simtest.advice.scope import ends
from simtest.spec import Experiment
from simtest.validation import laws
from simtest.validation.guide import LEAST_ANSWERED
from simtest.validation.situations import SMALL_SPOT_PX

NEAREST_MM = 3.0
"""A break-point nearer than this is not rendered: no endoscope works there."""

STREAK_KD, BEYOND_KD = -0.9, -0.92
"""d k at which abs(1 + d k) = 0.1, below which `curved` refuses; and where that is rendered."""

RAYLEIGH_MEAN = math.sqrt(math.pi / 2)
"""Mean angle between a glint's normal and the base's, in slopes an axis (theory.md 7.4)."""

FRAMES, ROUGH_FRAMES = 3, 8

_HALVINGS = 60

CONFIRMED_DEG, CONFIRMED_SHARE = 0.3, 0.15
"""A render confirms a law where it differs by less than either, or where its interval holds the law's value."""


@dataclass(frozen=True)
class BreakPoint:
    """A break-point.

    Parameters
    ----------
    key : str
        Name of its group in the experiment.
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
    measures : str
        Column of the results: ``error_fine_deg`` or ``error_base_deg``.
    also : str
        The same in other terms, such as the offset over the distance.
    group : dict
        Group of the experiment.
    """

    key: str
    title: str
    method: str
    quantity: str
    unit: str
    value: float
    law: str
    expected: float | None
    measures: str
    also: str
    group: dict[str, Any]


@dataclass(frozen=True)
class Confirmed:
    """A break-point with what renders there gave."""

    point: BreakPoint
    rendered: MeanError
    asked: int  # highlights
    answered: int

    @property
    def verdict(self) -> str:
        """Whether the render agrees with the law."""
        mean, expected = self.rendered.mean_deg, self.point.expected
        if expected is None and self.asked:
            return "confirmed" if self.answered < LEAST_ANSWERED * self.asked else "differs"
        if mean is None or expected is None:
            return "no answer" if self.asked else "no highlight"
        low, high = self.rendered.interval_deg
        near = abs(mean - expected) <= max(CONFIRMED_DEG, CONFIRMED_SHARE * expected)
        inside = low is not None and high is not None and low <= expected <= high
        return "confirmed" if near or inside else "differs"

    def to_json(self) -> dict[str, Any]:
        """Return the break-point as JSON, without its group."""
        record = {key: value for key, value in asdict(self.point).items() if key != "group"}
        return {**record, "rendered": asdict(self.rendered), "asked": self.asked, "answered": self.answered,
                "verdict": self.verdict}  # fmt: skip


def break_points(question: Question) -> list[BreakPoint]:
    """Return the break-points of a question by the laws."""
    made = (_offset_ignored(question), _distance_unknown(question), _streak(question), _relief(question))
    return [point for point in made if point is not None]


def break_experiment(question: Question, points: list[BreakPoint]) -> Experiment:
    """Return the experiment that renders at break-points."""
    return Experiment.model_validate({
        "name": "breaks", "title": f"Break-points: {question.title}", "realisations": FRAMES,
        "seed": question.seed, "estimators": ("curved", "cone_axis", "brightest_point", "bisector"),
        "groups": [point.group for point in points],
    })  # fmt: skip


def confirm(points: list[BreakPoint], results: pl.DataFrame) -> list[Confirmed]:
    """Read what renders at break-points gave."""
    return [_confirmed(point, results.filter(pl.col("label") == point.key)) for point in points]


def _confirmed(point: BreakPoint, rows: pl.DataFrame) -> Confirmed:
    own = rows.filter((pl.col("estimator") == point.method) & pl.col("true_id").is_not_null())
    answered = own.filter(pl.col("status") == "ok")
    return Confirmed(point, mean_error(answered, point.measures), own.height, answered.height)


def _group(question: Question, key: str, surface: dict[str, Any], **changed: Any) -> dict[str, Any]:
    """Return a group on a smooth wall of the organ's tissue, seen through the scope."""
    film = dict(rough(question.kind, None)[0]["reflectance.film"])
    film.pop("level", None)
    told = {"reflectance.film": film, "reflectance.albedo": pale(question.kind, question.view_mm)}
    values = {"surface": surface, **told, **seen_through(question), **changed}
    return {"scene": question.kind.scene, "label": key, "set": values}


def _offset_ignored(question: Question) -> BreakPoint | None:
    """Find the distance at which a method that ignores the light's offset errs by the bound."""
    offset = float(np.mean(question.scope.offsets_mm))
    ratio = math.tan(2 * math.radians(question.bound_deg))
    if offset / ratio < NEAREST_MM:
        return None
    distance = round(offset / ratio, 3)
    surface = {"type": "plane", "distance_mm": distance}
    return BreakPoint(
        "light-offset", "a method that ignores the light's offset", "cone_axis", "distance", "mm", distance,
        "atan(eps / d) / 2", float(np.degrees(laws.offset_error(offset / distance))), "error_fine_deg",
        f"eps/d = {offset / distance:.3g}, eps = {offset:.3g} mm", _group(question, "light-offset", surface),
    )  # fmt: skip


def _distance_unknown(question: Question) -> BreakPoint | None:
    """Find the distance below which a bisector that knows the range alone errs by the bound."""
    offset = float(np.mean(question.scope.offsets_mm))
    if not offset:
        return None
    # The told distance is the middle of the range.
    middle = question.middle_mm

    def law_deg(distance: float) -> float:
        point = np.array([0.0, 0.0, distance])
        return float(np.degrees(laws.bisector_residual(point, np.array([offset, 0.0, 0.0]), middle / distance - 1)))

    # The error falls from the nearest distance to the middle.
    low, high = NEAREST_MM, middle
    if law_deg(low) < question.bound_deg:
        return None
    for _ in range(_HALVINGS):
        half = (low + high) / 2
        low, high = (half, high) if law_deg(half) > question.bound_deg else (low, half)
    distance = round(low, 3)
    return BreakPoint(
        "distance-unknown", "bisector, told the range of the distance alone", "bisector", "distance", "mm", distance,
        "eps / 2 * abs(1 / d - 1 / middle)", law_deg(distance), "error_fine_deg",
        f"eps/d = {offset / distance:.3g}, middle = {middle:g} mm",
        _group(question, "distance-unknown", {"type": "plane", "distance_mm": distance}),
    )  # fmt: skip


def _streak(question: Question) -> BreakPoint:
    """Find the curvature at which a concave wall's isophotes become streaks."""
    middle = question.middle_mm
    surface = {"type": "cylinder", "side": "inside", "distance_mm": middle, "radius_mm": round(-middle / BEYOND_KD, 3)}
    group = _group(question, "curvature", surface, rig={"preset": "colocated"}) | {"isolated": False}
    return BreakPoint(
        "curvature", "a wall seen from near its centre of curvature: a streak", "curved", "d k", "", STREAK_KD,
        "curved refuses where abs(1 + d k) < 0.1", None, "error_fine_deg",
        f"a concave radius of {-middle / STREAK_KD:.3g} mm at {middle:g} mm; rendered at {BEYOND_KD:g}", group,
    )  # fmt: skip


def _relief(question: Question) -> BreakPoint:
    """Find the slope at which a single glint's normal is off the base's by the bound."""
    slope = round(question.bound_deg / RAYLEIGH_MEAN, 3)
    wave = wavelength_mm(question)
    surface = {"type": "plane", "distance_mm": question.middle_mm,
               "relief": {"bands": [{"slope_deg": slope, "wavelength_mm": wave}]}}  # fmt: skip
    group = _group(question, "relief-slope", surface, rig={"preset": "colocated"})
    group |= {"isolated": False, "realisations": ROUGH_FRAMES}
    return BreakPoint(
        "relief-slope", "any single highlight, against the base", "brightest_point", "slope of the relief", "deg",
        slope, "1.25 slopes, whatever the method", RAYLEIGH_MEAN * slope, "error_base_deg",
        f"wavelength {wave:g} mm; the light at the camera", group,
    )  # fmt: skip


def wavelength_mm(question: Question) -> float:
    """Return a wavelength of the relief, mm: the middle of what the scope states, else of the organ's longest band."""
    relief = question.scope.relief
    if relief is not None and not is_smooth(question.kind, relief):
        return sum(ends(relief.wavelength_mm)) / 2
    held, drawn = rough(question.kind, None)
    if "surface.relief" not in held:
        return 2.0
    first = held["surface.relief"]["bands"][0]["wavelength_mm"]
    return round(sum(drawn.get("surface.relief.bands.0.wavelength_mm", (first, first))) / 2, 3)


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
