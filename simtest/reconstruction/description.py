"""The stage after the estimators: describe what was reconstructed, as records that files and pages are made of.

docs/reconstruct.md explains the keys. `write_json` writes a record by its `to_json`, or else by its fields.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.detection.blobs import Highlight
from simtest.detection.view_mask import View
from simtest.errors import Failure, Reason
from simtest.estimators.protocol import Estimate, drawable
from simtest.geometry import Camera
from simtest.reconstruction.pipeline import Reconstruction, Specularity
from simtest.runtime import provenance
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject
from simtest.spec import describe_camera

Points = list[list[float]]

FRAME = "camera: x right, y down, z forward; normals are unit and face the camera"

FOLLOWS_ISOPHOTES = ("bisector", "curved")
BEST = (*FOLLOWS_ISOPHOTES, "cone_axis", "brightest_point")
"""Estimators whose normal is the best one, in this order: that which knows the lights, that which follows the isophotes
to the peak, that which averages them, and the one that needs none. `circle_pose` takes a curved surface for a plane."""

UNSOUND = frozenset({"saturated", "missing_isovalues", "ambiguous_light"})
"""With these flags the estimators that follow the isophotes to the peak give way to the next."""


@dataclass(frozen=True)
class Drawing:
    """What drawings need of an estimate, px: its isophotes, each with its isovalue, and the fitted curves."""

    isophotes: list[tuple[float, Points]]
    curves: list[Points]


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
    of its `highlight`, if the detector judges any. `best` names the estimator whose normal is the best one, `track` is
    the specularity's number over the frames of a sequence; `drawings` are by estimator.
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
            "estimates": {name: _estimate_json(e, self.drawings.get(name)) for name, e in self.estimates.items()},
            **{name: value for name in ("track", "reference") if (value := getattr(self, name)) is not None},
        }

    @classmethod
    def from_json(cls, data: JsonObject) -> "SpecularityRecord":
        """Read an entry, as far as tables and tracks need it."""
        peak, sightline = (None if data[key] is None else np.array(data[key]) for key in ("peak_px", "sightline"))
        estimates = {name: _estimate_from_json(entry) for name, entry in data["estimates"].items()}
        judged = (data.get("kind"), data.get("score"))
        return cls(data["id"], tuple(data["box_px"]), peak, sightline, *judged, data["best"], estimates)


@dataclass(frozen=True)
class PictureRecord:
    """A picture and all that was reconstructed in it; `encoding` is the kind of the response that was undone."""

    image: str
    camera: Camera
    encoding: str
    detector: str
    view: View
    warnings: list[str]
    specularities: list[SpecularityRecord]
    other_highlights: Sequence[Highlight]
    reference: ComparisonRecord | None = None

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
            "view": _view_json(self.view),
            "warnings": self.warnings,
            "frame": FRAME,
            "specularities": self.specularities,
            "other_highlights": others,
            "provenance": provenance.environment(),
            **({} if self.reference is None else {"reference": self.reference}),
        }


def describe(made: Reconstruction, camera: Camera) -> list[SpecularityRecord]:
    """Describe each specularity of a reconstruction, with what the detector says of it."""
    # Estimates that no region took stand behind those of the regions, and no detector judged them.
    judged: list[Highlight | None] = [*made.detection.highlights]
    judged += [None] * (len(made.specularities) - len(judged))
    return [_describe(i, *pair, camera) for i, pair in enumerate(zip(made.specularities, judged, strict=True))]


def _describe(index: int, specularity: Specularity, highlight: Highlight | None, camera: Camera) -> SpecularityRecord:
    patch, estimates = specularity.patch, specularity.estimates
    peak = None if isinstance(patch, Failure) else patch.peak_px
    sightline = None if peak is None else camera.unproject(peak)
    # A lens sees no direction beyond its fold.
    if sightline is not None and not np.isfinite(sightline).all():
        sightline = None
    drawings = {
        name: Drawing(
            [(t, np.round(points, 3).tolist()) for t, points in result.contours(patch)],
            [drawable(isophote.ellipse_px(camera)) for isophote in result.isophotes],
        )
        for name, result in estimates.items()
        if isinstance(result, Estimate)
    }
    kind, score = (None, None) if highlight is None else (str(highlight.kind), highlight.score)
    box, best = specularity.region.box, best_of(estimates)
    return SpecularityRecord(index, box, peak, sightline, kind, score, best, estimates, highlight, drawings)


def best_of(estimates: Mapping[str, Estimate | Failure]) -> str | None:
    """Return the name of the estimator whose normal is the best one; None where all failed."""
    answered = {name: result for name, result in estimates.items() if isinstance(result, Estimate)}
    ranked = [name for name in BEST if name in answered]
    sound = [name for name in ranked if name not in FOLLOWS_ISOPHOTES or not UNSOUND & set(answered[name].flags)]
    # An unsound normal is better than none, and another package's than that.
    return next(iter((*sound, *ranked, *answered)), None)


def deviation_deg(estimate: Estimate) -> float | None:
    """Return the standard deviation of a normal, deg: the square root of the covariance's trace."""
    return None if estimate.covariance is None else float(np.degrees(np.sqrt(max(np.trace(estimate.covariance), 0))))


def _view_json(view: View) -> JsonObject | None:
    """Describe the view's border: its circle where it is round, and the outline of what is seen."""
    if view.seen is None:
        return None
    contours, _ = cv2.findContours(view.seen.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygon = cv2.approxPolyDP(max(contours, key=len), 1.0, True)[:, 0] if contours else np.empty((0, 2))
    return {"circle": view.circle, "outline": polygon + PIXEL_CENTRE}


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
    return Estimate(
        normal, candidates, look_px, entry["axis_ratio"], (), margin, flags=flags, budget=budget, target=entry["target"]
    )
