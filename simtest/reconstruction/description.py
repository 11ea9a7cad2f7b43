"""The stage after the estimators: describe what was reconstructed, as records that files and pages are made of.

docs/howto/reconstruct.md explains the keys. `write_json` writes a record by its `to_json`, or else by its fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.detection.detector import Highlight
from simtest.detection.view import View
from simtest.errors import Failure, Reason
from simtest.estimators.protocol import Estimate, EstimatedCurvature, Target, drawable
from simtest.geometry import Camera
from simtest.reconstruction.assumptions import Assumption
from simtest.reconstruction.motion_record import MotionRecord
from simtest.reconstruction.pipeline import Reconstruction, Specularity
from simtest.reconstruction.ranking import StatedErrors, best_of, stated_errors
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, short_repr
from simtest.runtime.files import JsonObject
from simtest.spec import describe_camera

Points = list[list[float]]

SAME_GLINT_PX = 2.5
"""A glint of a cloud and a highlight whose peaks are nearer to each other are the same: two detectors found them."""

FRAME = "camera: x right, y down, z forward; normals are unit and face the camera"


@dataclass(frozen=True)
class Drawing:
    """What drawings need of an estimate, px: its isophotes, each with its isovalue, and the fitted curves."""

    isophotes: list[tuple[float, Points]]
    curves: list[Points]

    __repr__ = short_repr


@dataclass(frozen=True)
class ErrorRecord:
    """Angle to a reference, deg: of the proposed normal, and of the better candidate."""

    error_deg: float
    error_oracle_deg: float


@dataclass(frozen=True)
class ReferenceRecord:
    """The reference's normal at a specularity, and each estimator's error; None where the sightline misses it."""

    normal: Array | None
    errors: dict[str, ErrorRecord]

    def to_json(self) -> JsonObject | None:
        """Return the entry ``reference`` of a specularity."""
        return None if self.normal is None else vars(self)


@dataclass(frozen=True)
class ErrorSummary:
    """An estimator's errors against a reference, deg; a single one has no spread."""

    n: int
    mean_deg: float
    std_deg: float | None
    mean_oracle_deg: float
    std_oracle_deg: float | None


@dataclass(frozen=True)
class ComparisonRecord:
    """How normals compare with a reference: its file, what is wrong with it, and each estimator's errors."""

    source: str
    problems: list[str]
    compared: int
    missed: int
    estimators: dict[str, ErrorSummary]


@dataclass(frozen=True)
class SpecularityRecord:
    """A specularity, described: its region and peak, px, its sightline, and what each estimator made of it.

    There is no peak where there is no patch, and no sightline where the lens images none. `kind` and `score` are those
    of its `highlight`, if the detector judges any. `best` names the estimator whose normal is the best one,
    `best_because` says why; `track` is the specularity's number over the frames of a sequence; `drawings` are by
    estimator; `motion` is what the other frames of its track tell of its curvature, where the poses are known.
    """

    id: int
    box_px: tuple[int, int, int, int]
    peak_px: Array | None
    sightline: Array | None
    kind: str | None
    score: float | None
    best: str | None
    estimates: Mapping[str, Estimate | Failure]
    highlight: Highlight | None = None
    drawings: Mapping[str, Drawing] = field(default_factory=dict)
    track: int | None = None
    reference: ReferenceRecord | None = None
    best_because: str = ""
    motion: MotionRecord | None = None

    __repr__ = short_repr

    @property
    def normals(self) -> dict[str, Estimate]:
        """The results of the estimators that did not fail."""
        return {name: result for name, result in self.estimates.items() if isinstance(result, Estimate)}

    @property
    def best_estimate(self) -> Estimate | None:
        """The result of the best estimator."""
        return None if self.best is None else self.normals[self.best]

    @property
    def position_px(self) -> Array:
        """The peak, or the middle of the region where there is none."""
        x, y, width, height = self.box_px
        return np.array([x + width / 2, y + height / 2]) if self.peak_px is None else self.peak_px

    def to_json(self) -> JsonObject:
        """Return an entry of ``specularities``."""
        return {
            "id": self.id,
            "box_px": self.box_px,
            "peak_px": self.peak_px,
            "sightline": self.sightline,
            **({} if self.highlight is None else _highlight_json(self.highlight)),
            "best": self.best,
            "best_because": self.best_because,
            "estimates": {name: _estimate_json(e, self.drawings.get(name)) for name, e in self.estimates.items()},
            **{name: value for name in ("track", "reference", "motion") if (value := getattr(self, name)) is not None},
        }

    @classmethod
    def from_json(cls, data: JsonObject) -> "SpecularityRecord":
        """Read an entry, as far as tables and tracks need it."""
        peak, sightline = (None if data[key] is None else np.array(data[key]) for key in ("peak_px", "sightline"))
        estimates = {name: _estimate_from_json(entry) for name, entry in data["estimates"].items()}
        judged = (data.get("kind"), data.get("score"))
        best, because = data["best"], data["best_because"]
        return cls(
            data["id"], tuple(data["box_px"]), peak, sightline, *judged, best, estimates, best_because=because
        )  # fmt: skip


@dataclass(frozen=True)
class PictureRecord:
    """A picture and all that was reconstructed in it.

    `encoding` is the kind of the response that was undone, `smoothing_px` the width of the Gaussian; `inferred` names
    those of these and of detector, estimators and saturation level that nobody gave, and `assumed` is what else nobody
    gave, and how it was taken.
    """

    image: str
    camera: Camera
    encoding: str
    detector: str
    view: View
    warnings: list[str]
    specularities: list[SpecularityRecord]
    other_highlights: Sequence[Highlight]
    reference: ComparisonRecord | None = None
    assumed: Sequence[Assumption] = ()
    smoothing_px: float | None = None
    inferred: Sequence[str] = ()

    __repr__ = short_repr

    @property
    def stated(self) -> StatedErrors | None:
        """What the best estimates state, with the medians of their budgets; None where none states anything."""
        return stated_errors([best for each in self.specularities if (best := each.best_estimate) is not None])

    def to_json(self) -> JsonObject:
        """Return the content of normals.json."""
        others = [
            {"box_px": h.region.box, "peak_px": [v + PIXEL_CENTRE for v in h.region.peak], **_highlight_json(h)}
            for h in self.other_highlights
        ]
        return {
            "image": self.image,
            "camera": describe_camera(self.camera),
            "encoding": self.encoding,
            "detector": self.detector,
            "smoothing_px": self.smoothing_px,
            "inferred": self.inferred,
            "view": _view_json(self.view),
            "warnings": self.warnings,
            "assumed": self.assumed,
            "stated": self.stated,
            "frame": FRAME,
            "specularities": self.specularities,
            "clouds": [entry for spot in self.specularities for entry in _clouds_json(spot)],
            "other_highlights": others,
            "provenance": provenance.environment(),
            **({} if self.reference is None else {"reference": self.reference}),
        }


def describe(made: Reconstruction, camera: Camera, target: Target = "fine") -> list[SpecularityRecord]:
    """Describe each specularity of a reconstruction, with what the detector says of it.

    The best estimate is one that states the target's normal, where there is any.
    """
    # Estimates that no region took stand behind those of the regions, and no detector judged them.
    judged: list[Highlight | None] = [*made.detection.highlights]
    judged += [None] * (len(made.specularities) - len(judged))
    pairs = zip(made.specularities, judged, strict=True)
    return [_describe(i, *pair, camera, target) for i, pair in enumerate(pairs)]


def _describe(
    index: int, specularity: Specularity, highlight: Highlight | None, camera: Camera, target: Target
) -> SpecularityRecord:
    patch, estimates = specularity.patch, specularity.estimates
    peak = None if isinstance(patch, Failure) else patch.peak_px
    sightline = None if peak is None else camera.unproject(peak)
    # A lens sees no direction beyond its fold.
    if sightline is not None and not np.isfinite(sightline).all():
        sightline = None
    answered = {name: result for name, result in estimates.items() if isinstance(result, Estimate)}
    # Estimators share isophotes: each is drawn once.
    shared = {id(isophote): isophote for result in answered.values() for isophote in result.isophotes}
    curves = {of: drawable(isophote.ellipse_px(camera)) for of, isophote in shared.items()}
    drawings = {
        name: Drawing(
            [(t, np.round(points, 3).tolist()) for t, points in result.contours(patch)],
            [curves[id(isophote)] for isophote in result.isophotes] + _cloud_outline(result, camera),
        )
        for name, result in answered.items()
    }
    kind, score = (None, None) if highlight is None else (str(highlight.kind), highlight.score)
    best, because = best_of(estimates, target)
    return SpecularityRecord(
        index, specularity.region.box, peak, sightline, kind, score, best, estimates, highlight, drawings,
        best_because=because,
    )  # fmt: skip


def _view_json(view: View) -> JsonObject | None:
    """Describe the view's border: its circle where it is round, and the outline of what is seen."""
    if view.seen is None:
        return None
    contours, _ = cv2.findContours(view.seen.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygon = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 1.0, True)[:, 0] if contours else np.empty((0, 2))
    return {"circle": view.circle, "outline": polygon + PIXEL_CENTRE}


def _cloud_outline(result: Estimate, camera: Camera) -> list[Points]:
    """Return the outline of an estimate's cloud, px, as curves to draw; none where it has no cloud."""
    if result.cloud is None:
        return []
    look = camera.unproject(result.look_px)
    return [drawable(camera.project(result.cloud.outline(result.normal, look)))]


def members(spots: Sequence[SpecularityRecord]) -> dict[int, int]:
    """Return the specularity of the cloud that each single highlight belongs to, by the highlight's id.

    A highlight belongs to a cloud where one of the cloud's glints lies within `SAME_GLINT_PX` of its peak.
    """
    found: dict[int, int] = {}
    single = [spot for spot in spots if spot.peak_px is not None]
    peaks = np.array([spot.peak_px for spot in single]).reshape(-1, 2)
    for spot in spots:
        for result in spot.normals.values():
            if result.cloud is not None and single:
                apart = np.linalg.norm(peaks[:, None] - result.cloud.points_px[None], axis=2).min(axis=1)
                near = np.flatnonzero(apart < SAME_GLINT_PX)
                found |= {single[i].id: spot.id for i in near}
    return found


def _clouds_json(spot: SpecularityRecord) -> list[JsonObject]:
    """Describe the clouds of highlights that estimates of a specularity stand on."""
    return [
        {
            "specularity": spot.id,
            "estimator": name,
            "highlights": len(cloud.points_px),
            "points_px": np.round(cloud.points_px, 2),
            "covariance": cloud.covariance,
            "axis_ratio": cloud.axis_ratio,
            "seen": cloud.seen,
            "slope_deg": {end: float(np.degrees(getattr(cloud.slope, end))) for end in ("value", "low", "high")},
            "outline": spot.drawings[name].curves[0] if name in spot.drawings else None,
        }
        for name, result in spot.normals.items()
        if (cloud := result.cloud) is not None
    ]


def _highlight_json(highlight: Highlight) -> JsonObject:
    return {
        "kind": highlight.kind,
        "score": highlight.score,
        "area_px": highlight.area_px,
        "peaks": max(len(highlight.peaks), 1),
        "clipped": round(highlight.clipped, 3),
        "specular_peak": highlight.region.contrast,
        "shape": {name: getattr(highlight, name) for name in ("axis_ratio", "residual", "wander", "tint", "clutter")},
        "outline": np.round(highlight.outline, 2),
    }


def _estimate_json(result: Estimate | Failure, drawing: Drawing | None) -> JsonObject:
    if isinstance(result, Failure):
        return {"status": result.reason, "detail": result.detail}
    entry: JsonObject = {
        "status": "ok",
        "normal": result.normal,
        "candidates": result.candidates,
        "choice_margin": result.choice_margin,
        "look_px": [float(v) if np.isfinite(v) else None for v in result.look_px],
        "axis_ratio": result.axis_ratio,
        "isovalues": [isophote.isovalue for isophote in result.isophotes],
        "target": result.target,
        "covariance": result.covariance,
        "budget": result.budget,
        "curvature": None,
        "flags": result.flags,
    }
    if result.axis_ratio_deviation is not None:
        entry["axis_ratio_deviation"] = result.axis_ratio_deviation
    if (shape := result.curvature) is not None:
        entry["curvature"] = {"directions": shape.directions, "axis_ratio": shape.axis_ratio, "gains": shape.hypotheses}
    if drawing is not None:
        entry["isophotes"] = [{"t": t, "points": points} for t, points in drawing.isophotes]
        entry["ellipses"] = [isophote.conic.image for isophote in result.isophotes if isophote.conic is not None]
        entry["cones"] = [isophote.cone for isophote in result.isophotes]
        entry["curves"] = drawing.curves
    return entry


def _estimate_from_json(entry: JsonObject) -> Estimate | Failure:
    if entry["status"] != "ok":
        return Failure(Reason(entry["status"]), entry["detail"])
    normal, candidates, look_px = (np.array(entry[key], dtype=float) for key in ("normal", "candidates", "look_px"))
    margin, flags = entry["choice_margin"], tuple(entry["flags"])
    budget = entry["budget"] and {name: np.array(part) for name, part in entry["budget"].items()}
    curvature = None
    if (shape := entry.get("curvature")) is not None:
        gains = None if shape["gains"] is None else np.array(shape["gains"], dtype=float)
        curvature = EstimatedCurvature(np.array(shape["directions"], dtype=float), shape["axis_ratio"], gains)
    return Estimate(
        normal, candidates, look_px, entry["axis_ratio"], (), margin, flags=flags, budget=budget,
        target=entry["target"], curvature=curvature, axis_ratio_deviation=entry.get("axis_ratio_deviation"),
    )  # fmt: skip
