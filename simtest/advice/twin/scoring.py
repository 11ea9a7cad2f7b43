"""Scores the highlights of a rendered frame as the harness does, and weighs a bank's by likeness to a real one.

A real highlight's twins are the bank's highlights weighted by a Gaussian kernel over their features (`FEATURES`), over
the number of highlights in their frame: a frame is one draw of distance, lights and relief, and what its number of
highlights tells is among the features. The kernel is as narrow as leaves `TWINS` effective ones: the weights' squared
sum over the sum of their squares.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import Specularities, Specularity
from simtest.rendering import Session
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.statistics import mean_interval, weighted_quantile
from simtest.simulation.frame import RenderedView
from simtest.validation.scoring import mahalanobis2, match, on_instruments, peak_px
from simtest.validation.statistics import is_wrong_and_sure

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
    """A usable highlight: one whose best estimate is a normal of that highlight alone."""

    index: int  # of its specularity in the reconstruction
    peak_px: Array  # shape (2,)
    radius_px: float  # of the circle that has its area above half height
    estimator: str  # the best one
    estimate: Estimate  # its result
    features: Array  # shape (F,), what the picture shows of it (`FEATURES`)


@dataclass(frozen=True)
class ScoredSpot:
    """A usable highlight of a rendered frame with its errors.

    A glint has a lit highlight point inside its isophote at half height. A near miss has none, so the normal there
    nowhere bisects the directions to light and camera, but the noise-free frame shows a highlight there (theory.md
    7.1b). A false one shows none either, as at a pale edge.
    """

    spot: Spot
    kind: SpotKind
    error_deg: float  # to the fine normal: at the matched highlight point, or at the point looked at if there is none
    base_error_deg: float  # to the base's normal at the same point
    held: bool | None  # whether the stated 95 % region holds the normal; None where nothing is stated
    distance_mm: float = math.nan  # of the surface along the sightline; NaN where that meets none
    is_wrong: bool = False  # whether it is wrong and sure of what it states


FEATURES = (
    "radius", "axis_ratio", "peak", "clipped", "own_deviation", "crowding", "residual", "off_axis", "frame_radius",
    "frame_crowding",
)  # fmt: skip
"""Names of the features of a spot. radius, peak, own_deviation and crowding are natural logarithms: of the radius at
half height, px; of the specular peak over full scale; of the deviation by the highlight's own parts of the budget, deg;
of the distance to the third neighbour, px. off_axis is the estimated normal's angle from the optical axis, rad. The
last two are the frame's medians of radius and crowding: together its highlights tell more of the distance than one."""


def usable_spots(specularities: Specularities) -> list[Spot]:
    """Return the highlights of a reconstruction that have a normal of their own, with their features."""
    chosen = []
    for index, specularity in enumerate(specularities):
        estimate, best = specularity.best_estimate, specularity.best
        if best is not None and estimate is not None and estimate.cloud is None:
            chosen.append((index, specularity, best, estimate))
    if not chosen:
        return []
    peaks = np.array([peak_px(specularity) for _, specularity, *_ in chosen])
    radii = [_radius_px(specularity) for _, specularity, *_ in chosen]
    crowding = [_crowding_px(peaks, number) for number in range(len(chosen))]
    of_frame = np.median(np.log(np.maximum([radii, crowding], LEAST_RADIUS_PX)), axis=1)
    spots = []
    for (index, specularity, best, estimate), peak, radius, crowd in zip(chosen, peaks, radii, crowding, strict=True):
        features = np.concatenate([_features(radius, crowd, specularity, estimate), of_frame])
        spots.append(Spot(index, peak, radius, best, estimate, features))
    return spots


def score(session: Session, view: RenderedView, specularities: Specularities) -> list[ScoredSpot]:
    """Score the usable highlights of a rendered frame; the session stands at its scene.

    Detections are matched to lit highlight points, of the fine surface, by the harness's own rule. Those on an
    instrument, and those whose sightline meets no surface, are left out.
    """
    spots = usable_spots(specularities)
    if not spots:
        return []
    found = [specularities[spot.index] for spot in spots]
    lit = [point for point in view.highlights if point.lit]
    matched = match(found, [point.bp_px for point in lit])
    metal = on_instruments(found, matched, view)
    at_look = session.exact_points(np.array([spot.estimate.look_px for spot in spots]))
    shown = _shown(found, [visible.peak_px for visible in view.visible_highlights])
    scored = []
    for i, spot in enumerate(spots):
        if metal is not None and metal[i]:
            continue
        if i in matched:
            fine, base = lit[matched[i]].normal, lit[matched[i]].normal_base
        elif at_look.valid[i]:
            fine, base = at_look.normal[i], at_look.normal_base[i]
        else:
            continue
        estimate = spot.estimate
        stated = fine if estimate.target == "fine" else base
        squared = mahalanobis2(estimate, stated)
        wrong = bool(is_wrong_and_sure(angle_deg(estimate.normal, stated), estimate.deviation_deg))
        held = None if squared is None else bool(squared <= chi_squared.quantile(0.95, 2))
        kind: SpotKind = "glint" if i in matched else "near_miss" if shown[i] else "false"
        to_fine, to_base = (float(angle_deg(estimate.normal, normal)) for normal in (fine, base))
        scored.append(ScoredSpot(spot, kind, to_fine, to_base, held, float(at_look.distance[i]), wrong))
    return scored


def _shown(found: Sequence[Specularity], peaks_px: Sequence[Array]) -> list[bool]:
    """Return which detections show one of the visible highlights with these peaks, px."""
    enclosed = match(found, peaks_px)
    peaks = np.array([*peaks_px]).reshape(-1, 2)
    near = [bool((np.hypot(*(peaks - peak_px(each)).T) <= NEAR_PX).any()) for each in found]
    return [i in enclosed or near[i] for i in range(len(found))]


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
    highlight, peak = specularity.highlight, specularity.region.contrast
    values: Sequence[float | None] = (
        math.log(max(radius, LEAST_RADIUS_PX)),
        estimate.axis_ratio if highlight is None else highlight.axis_ratio,
        None if not peak or peak <= 0 else math.log(peak),
        0.0 if highlight is None else highlight.clipped,
        math.log(own_deviation_deg(estimate)),
        math.log(crowding),
        None if highlight is None else highlight.residual,
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


# Twins ----------------------------------------------------------------------------------------------------------------

TWINS = 40.0
"""Effective number of twins of a highlight."""

SCALES = dict(zip(FEATURES, (0.15, 0.15, 0.4, 0.3, 0.3, 0.4, 0.03, 0.3, 0.15, 0.25), strict=True))
"""How much of each feature is one unit of unlikeness."""

OTHER_ESTIMATOR = 4.0
"""Squared unlikeness of a spot whose best estimate is another estimator's."""

UNKNOWN = 1.0
"""Squared unlikeness by a feature that only one of two spots shows."""

WIDEST = 64.0
"""The kernel's width ends here; beyond it nothing in the bank is like the spot."""

UNLIKE = 2.0
"""Unlikeness of twins above which they are called so: outside of what the bank covers."""


@dataclass(frozen=True)
class Twins:
    """What the twins of one highlight measure: those that are highlights, but for `false`."""

    rms_deg: float  # root mean square error against the fine normal
    interval_deg: tuple[float, float]  # its 95 % interval over the bank's frames
    p95_deg: float  # 95 % of the errors against the fine normal lie below
    coverage: float | None  # share whose stated 95 % region holds the truth; None where none states one
    wrong_and_sure: float | None  # share of the same
    near_misses: float  # share of near misses
    false: float  # share of false detections among all
    glint_rms_deg: float  # of the twins that are glints; NaN where there are none
    near_rms_deg: float  # of near misses
    base_rms_deg: float  # against the base's normal
    base_interval_deg: tuple[float, float]
    # Distances below which 10, 50 and 90 % of the twins stand: what the picture's look says of it, and what was told.
    # The error from a light beside the lens goes with its inverse.
    distance_mm: tuple[float, float, float]
    effective: float  # number of twins
    unlikeness: float  # root mean square over twins and features of the distance to the highlight, units of `SCALES`
    best: IntArray  # the likest in the bank, the first first

    @property
    def is_covered(self) -> bool:
        """Whether the bank holds highlights like this one."""
        return self.unlikeness <= UNLIKE


class Matcher:
    """Finds twins among a bank's highlights, at least one, each with the number of its frame."""

    def __init__(self, spots: Sequence[tuple[int, ScoredSpot]]) -> None:
        self._frames = np.array([frame for frame, _ in spots])
        # Each frame is one draw of what was not told, however many highlights it shows.
        self._shares = 1 / np.bincount(self._frames)[self._frames]
        held = [spot.held for _, spot in spots]
        self._features = np.array([spot.spot.features for _, spot in spots])
        self._estimators = np.array([spot.spot.estimator for _, spot in spots])
        self._errors = np.array([spot.error_deg for _, spot in spots])
        self._base_errors = np.array([spot.base_error_deg for _, spot in spots])
        self._distances = np.array([spot.distance_mm for _, spot in spots])
        self._near = np.array([spot.kind == "near_miss" for _, spot in spots])
        self._real = np.array([spot.kind != "false" for _, spot in spots])
        self._stated = np.array([each is not None for each in held])
        self._held = np.array([bool(each) for each in held])
        self._wrong = np.array([spot.is_wrong for _, spot in spots])

    def find(self, spot: Spot) -> Twins:
        """Measure the twins of a highlight."""
        squared = self._unlikeness(spot)
        whole = _weights(squared, self._shares, TWINS)
        # A false detection has no normal that is its own.
        weights = _weights(np.where(self._real, squared, np.inf), self._shares, TWINS)
        near, glint = weights * self._near, weights * ~self._near
        stated = weights * self._stated
        share = stated / stated.sum() if stated.sum() > 0 else None
        at = partial(weighted_quantile, self._distances, weights)
        return Twins(
            rms_deg=_rms(weights, self._errors),
            interval_deg=self._interval(weights, self._errors),
            base_rms_deg=_rms(weights, self._base_errors),
            base_interval_deg=self._interval(weights, self._base_errors),
            coverage=None if share is None else float(share @ self._held),
            wrong_and_sure=None if share is None else float(share @ self._wrong),
            near_misses=float(near.sum() / weights.sum()),
            false=float(whole @ ~self._real / whole.sum()),
            glint_rms_deg=_rms(glint, self._errors),
            near_rms_deg=_rms(near, self._errors),
            p95_deg=weighted_quantile(self._errors, weights, 0.95),
            distance_mm=(at(0.1), at(0.5), at(0.9)),
            effective=float(weights.sum() ** 2 / np.square(weights).sum()),
            unlikeness=float(np.sqrt(weights @ np.where(self._real, squared, 0.0) / weights.sum() / len(FEATURES))),
            best=np.argsort(np.where(self._real, squared, np.inf), kind="stable")[:12],
        )

    def _unlikeness(self, spot: Spot) -> Array:
        """Return the squared unlikeness of the bank's highlights, shape (N,)."""
        apart = (self._features - spot.features) / np.array([SCALES[name] for name in FEATURES])
        squares = np.square(apart)
        # Neither shows it: no difference.
        one_sided = np.isnan(self._features) ^ np.isnan(spot.features)
        squares = np.where(one_sided, UNKNOWN, np.nan_to_num(squares))
        return np.asarray(squares.sum(axis=1) + OTHER_ESTIMATOR * (self._estimators != spot.estimator))

    def _interval(self, weights: Array, errors: Array) -> tuple[float, float]:
        """Return the 95 % interval of an RMS error over the frames: their highlights share a light."""
        low, high = mean_interval(weights * np.square(errors), self._frames, counts=weights)
        if low is None or high is None:
            return np.nan, np.nan
        return float(np.sqrt(max(low, 0.0))), float(np.sqrt(high))


def _weights(squared: Array, shares: Array, wanted: float) -> Array:
    """Return shares times Gaussian weights of squared distances, shape (N,), as narrow as leave an effective number."""
    low, high = 1e-3, WIDEST
    shifted = squared - squared.min()
    # Bisection in the logarithm of the width: a wider kernel holds more.
    for _ in range(50):
        width = float(np.sqrt(low * high))
        weights = shares * np.exp(-shifted / (2 * width**2))
        if weights.sum() ** 2 / np.square(weights).sum() < wanted:
            low = width
        else:
            high = width
    return np.asarray(shares * np.exp(-shifted / (2 * high**2)))


def _rms(weights: Array, errors: Array) -> float:
    """Return a weighted root mean square; NaN without weight."""
    total = float(weights.sum())
    return float(np.sqrt(weights @ np.square(errors) / total)) if total > 0 else float("nan")
