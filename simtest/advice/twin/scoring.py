"""Scores the highlights of a rendered frame as the harness does, and describes each by what a picture shows of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import Specularities, Specularity
from simtest.rendering import Session
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.simulation.frame import RenderedView
from simtest.validation.scoring import mahalanobis2, match, on_instruments, peak_px

NEIGHBOUR = 3
"""How crowded the surroundings are: the distance to this neighbour."""

LEAST_RADIUS_PX = 0.3

ALONE_PX = 500.0
"""Distance of neighbours that a frame does not have."""

NEAR_PX = 1.5
"""A detection shows the visible highlight whose peak its isophote encloses, or lies so near to its own peak."""

SpotKind = Literal["glint", "near_miss", "false"]

OWN_PARTS = ("noise", "resolution", "shape")
"""Parts of a budget that the highlight itself decides; the others follow from what was told."""

LEAST_DEG = 1e-3
"""A stated deviation below this is as good as none, deg."""


@dataclass(frozen=True)
class Spot:
    """A usable highlight: one whose best estimate is a normal of that highlight alone.

    Parameters
    ----------
    index : int
        Of its specularity in the reconstruction.
    peak_px : ndarray, shape (2,)
        Where it is.
    radius_px : float
        Of the circle that has its area above half height.
    estimator : str
        Name of the best estimator.
    estimate : Estimate
        Its result.
    features : ndarray, shape (F,)
        What the picture shows of it (`FEATURES`).
    """

    index: int
    peak_px: Array
    radius_px: float
    estimator: str
    estimate: Estimate
    features: Array


@dataclass(frozen=True)
class ScoredSpot:
    """A usable highlight of a rendered frame with its errors.

    Parameters
    ----------
    spot : Spot
        The highlight.
    kind : {"glint", "near_miss", "false"}
        glint: a lit highlight point lies inside its isophote at half height. near_miss: none does, so the normal there
        nowhere bisects the directions to light and camera, but the noise-free frame shows a highlight there
        (theory.md 7.1b). false: it shows none either, as at a pale edge.
    error_deg : float
        Angle to the fine normal: at the matched highlight point, or at the point looked at where there is none.
    base_error_deg : float
        Angle to the base's normal at the same point.
    held : bool or None
        Whether the stated 95 % region holds the normal that the estimate states; None where nothing is stated.
    distance_mm : float
        Of the surface along the sightline; NaN where that meets none.
    """

    spot: Spot
    kind: SpotKind
    error_deg: float
    base_error_deg: float
    held: bool | None
    distance_mm: float = math.nan

    @property
    def is_near_miss(self) -> bool:
        """Whether it is a visible highlight in which the normal only comes near the bisector."""
        return self.kind == "near_miss"


FEATURES = (
    "radius", "axis_ratio", "peak", "clipped", "own_deviation", "crowding", "residual", "off_axis", "frame_radius",
    "frame_crowding",
)  # fmt: skip
"""Names of the features of a spot. radius, peak, own_deviation and crowding are natural logarithms: of the radius at
half height, px; of the specular peak over full scale; of the deviation by the highlight's own parts of the budget, deg;
of the distance to the third neighbour, px. off_axis is the sightline's angle from the optical axis, rad. The last two
are the frame's medians of radius and crowding: together its highlights tell more of the distance than one does."""


def usable_spots(made: Specularities) -> list[Spot]:
    """Return the highlights of a reconstruction that have a normal of their own, with their features."""
    chosen = []
    for index, specularity in enumerate(made):
        estimate, best = specularity.best_estimate, specularity.best
        if best is not None and estimate is not None and estimate.cloud is None:
            chosen.append((index, specularity, best, estimate))
    peaks = np.array([peak_px(specularity) for _, specularity, *_ in chosen]).reshape(-1, 2)
    radii = [_radius_px(specularity) for _, specularity, *_ in chosen]
    crowding = [_crowding_px(peaks, number) for number in range(len(chosen))]
    of_frame = np.median(np.log(np.maximum([radii, crowding], LEAST_RADIUS_PX)), axis=1) if chosen else np.empty(2)
    spots = []
    for number, (index, specularity, best, estimate) in enumerate(chosen):
        own = _features(radii[number], crowding[number], specularity, estimate)
        features = np.concatenate([own, of_frame])
        spots.append(Spot(index, peaks[number], radii[number], best, estimate, features))
    return spots


def score(session: Session, view: RenderedView, made: Specularities) -> list[ScoredSpot]:
    """Score the usable highlights of a rendered frame; the session stands at its scene.

    Detections are matched to lit highlight points, of the fine surface, by the harness's own rule. Those on an
    instrument, and those whose sightline meets no surface, are left out.
    """
    spots = usable_spots(made)
    found = [made[spot.index] for spot in spots]
    lit = [point for point in view.highlights if point.lit]
    matched = match(found, [point.bp_px for point in lit])
    metal = on_instruments(found, matched, view)
    looks = np.array([spot.estimate.look_px for spot in spots]).reshape(-1, 2)
    at_look = session.exact_points(looks) if len(looks) else None
    shown = _shown(found, [visible.peak_px for visible in view.visible_highlights])
    scored = []
    for i, spot in enumerate(spots):
        if metal is not None and metal[i]:
            continue
        if i in matched:
            fine, base = lit[matched[i]].normal, lit[matched[i]].normal_base
        elif at_look is not None and at_look.valid[i]:
            fine, base = at_look.normal[i], at_look.normal_base[i]
        else:
            continue
        kind: SpotKind = "glint" if i in matched else "near_miss" if shown[i] else "false"
        distance = math.nan if at_look is None else float(at_look.distance[i])
        scored.append(_scored(spot, kind, fine, base, distance))
    return scored


def _shown(found: Sequence[Specularity], peaks_px: Sequence[Array]) -> list[bool]:
    """Return which detections show one of the visible highlights with these peaks, px."""
    enclosed = match(found, peaks_px)
    peaks = np.array([*peaks_px]).reshape(-1, 2)
    near = [bool((np.hypot(*(peaks - peak_px(each)).T) <= NEAR_PX).any()) for each in found]
    return [i in enclosed or near[i] for i in range(len(found))]


def _scored(spot: Spot, kind: SpotKind, fine: Array, base: Array, distance_mm: float) -> ScoredSpot:
    estimate = spot.estimate
    squared = mahalanobis2(estimate, fine if estimate.target == "fine" else base)
    held = None if squared is None else bool(squared <= chi_squared.quantile(0.95, 2))
    to_fine, to_base = (float(angle_deg(estimate.normal, normal)) for normal in (fine, base))
    return ScoredSpot(spot, kind, to_fine, to_base, held, distance_mm)


def _radius_px(specularity: Specularity) -> float:
    """Return the radius of the circle that has the area above half height, px."""
    if specularity.highlight is not None:
        return math.sqrt(specularity.highlight.area_px / math.pi)
    contour = None if isinstance(specularity.patch, Failure) else specularity.patch.isophote(HIGHLIGHT_ISOVALUE)
    if contour is None or isinstance(contour, Failure):
        return math.sqrt(specularity.region.box[2] * specularity.region.box[3] / math.pi) / 2
    x, y = contour.T
    return math.sqrt(abs(float(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / 2 / math.pi)


def _features(radius: float, crowding: float, specularity: Specularity, estimate: Estimate) -> Array:
    """Return the features of a spot but for those of its frame; NaN where it does not show one."""
    highlight = specularity.highlight
    ratio = estimate.axis_ratio if highlight is None else highlight.axis_ratio
    peak = specularity.region.contrast
    residual = None if highlight is None else highlight.residual
    values: Sequence[float | None] = (
        math.log(max(radius, LEAST_RADIUS_PX)),
        ratio,
        None if not peak or peak <= 0 else math.log(peak),
        0.0 if highlight is None else highlight.clipped,
        math.log(own_deviation_deg(estimate)),
        math.log(crowding),
        residual,
        math.acos(float(np.clip(-estimate.normal[2], -1, 1))),
    )
    return np.array([math.nan if value is None else value for value in values], dtype=float)


def own_deviation_deg(estimate: Estimate) -> float:
    """Return the deviation of a normal by the highlight's own parts of the budget, deg."""
    parts = [part for name, part in (estimate.budget or {}).items() if name in OWN_PARTS]
    return max(math.degrees(math.sqrt(max(sum(float(np.trace(part)) for part in parts), 0.0))), LEAST_DEG)


def _crowding_px(peaks: Array, number: int) -> float:
    """Return the distance from a spot to its third neighbour, px."""
    away = np.sort(np.hypot(*(peaks - peaks[number]).T))
    return max(float(away[NEIGHBOUR]) if len(away) > NEIGHBOUR else ALONE_PX, 1.0)
