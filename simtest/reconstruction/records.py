"""The record of what was reconstructed: a specularity with its estimates and the best of them, and those of a picture.

docs/howto/pictures.md explains the keys of their JSON. It is what the tables, the overlay and the pages are made of.
"""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.detection import Region
from simtest.detection.detector import Detection, Highlight
from simtest.detection.view import View
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.estimators.budget import deviations, dominant
from simtest.estimators.protocol import Target
from simtest.geometry import Camera, Patch
from simtest.reconstruction.options import Choices
from simtest.runtime import provenance
from simtest.runtime.arrays import LONGEST, Array, clipped, short_repr, vector
from simtest.runtime.files import JsonObject
from simtest.spec import describe_camera

if TYPE_CHECKING:
    import polars as pl

Points = list[list[float]]

WITHOUT_UNCERTAINTY = ("bisector", "curved", "photometric", "cone_axis", "brightest_point")
"""Order of estimates that state no uncertainty, so that nothing else can rank them: that which knows the lights, those
which follow the lobe to its peak, that which averages isophotes, and the one that needs none. Other packages' follow,
and `circle_pose` last, which takes a curved surface for a plane."""

SIGHTLINE_RULE, SAME_COSINE = "sightline rule", 1e-9
"""What estimators are called together that give the reversed sightline of a pixel, and how near they come to it."""

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
class Specularity:
    """One region of interest and what each estimator made of it.

    Parameters
    ----------
    region : Region
        Where it is.
    patch : Patch or Failure
        The smoothed crop.
    estimates : mapping
        `Estimate` or `Failure` by estimator name; read-only, as what follows from them is kept.
    highlight : Highlight, optional
        How the detector judged it, if it judges any.
    camera : Camera, optional
        Of the frame.
    target : {"fine", "base"}
        The surface whose normal is wanted: the best estimate states it, where there is any.
    organ : mapping
        The same results as normals of the organ below its relief, whose slope is in their budgets
        (`simtest.estimators.prior_parts.to_base`).
    score : float, optional
        How much it looks like a highlight, in [0, 1]: no probability. None for clouds, and where nothing was detected.
    least_score : float
        With a smaller score it has no best estimate.
    id : int
        Its place among those of the frame.
    track : int, optional
        Its number over the frames of a sequence.
    reference : optional
        The reference's normal here and the errors against it (`simtest.validation.references`).

    Examples
    --------
    >>> import numpy as np, simtest
    >>> y, x = np.mgrid[:120, :160] + 0.5
    >>> frame = np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 200).astype(np.float32)
    >>> spot = simtest.reconstruct(frame, simtest.Camera.from_fov(60.0, 160, 120))[0]
    >>> spot.estimates["cone_axis"].normal.round(2) + 0.0
    array([ 0.,  0., -1.])
    """

    region: Region
    patch: Patch | Failure
    estimates: Mapping[str, Estimate | Failure]
    highlight: Highlight | None = None
    camera: Camera | None = None
    target: Target = "fine"
    organ: Mapping[str, Estimate] = field(default_factory=dict)
    score: float | None = None
    least_score: float = 0.0
    id: int = 0
    track: int | None = None
    reference: Any = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimates", MappingProxyType(dict(self.estimates)))

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """Return what a copy is made of: a view of a dictionary travels to no other process."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return type(self), tuple({**values, "estimates": dict(self.estimates)}.values())

    @property
    def peak_px(self) -> Array | None:
        """The peak; None where there is no patch."""
        return None if isinstance(self.patch, Failure) else self.patch.peak_px

    @property
    def position_px(self) -> Array:
        """The peak; where there is none the pixel that a cloud's estimate looks at, or the middle of the region."""
        if self.peak_px is not None:
            return self.peak_px
        x, y, width, height = self.region.box
        return np.array([x + width / 2, y + height / 2]) if self.cloud is None else self.cloud.look_px

    @property
    def cloud(self) -> Estimate | None:
        """The organ's normal from a cloud of highlights; None where it is a single highlight."""
        return next((each for each in self.normals.values() if each.cloud is not None), None)

    @property
    def kind(self) -> str | None:
        """Kind of highlight that the detector takes it for."""
        return None if self.highlight is None else str(self.highlight.kind)

    @property
    def is_doubtful(self) -> bool:
        """Whether it may be no highlight: its score is below the least one."""
        return self.score is not None and self.score < self.least_score

    @property
    def normals(self) -> dict[str, Estimate]:
        """The results of the estimators that did not fail."""
        return {name: result for name, result in self.estimates.items() if isinstance(result, Estimate)}

    @cached_property
    def _judged(self) -> tuple[str | None, str]:
        best, because = best_of(self.estimates, self.target)
        if best is not None and self.is_doubtful:
            below = f"its score {self.score:g} is below {self.least_score:g}"
            return None, f"it may be no highlight, as {below}; --least-score 0 keeps it"
        return best, because

    @property
    def best(self) -> str | None:
        """Name of the estimator whose normal is the best one; None where all failed, or it may be no highlight."""
        return self._judged[0]

    @property
    def best_because(self) -> str:
        """Why that one is."""
        return self._judged[1]

    @property
    def best_estimate(self) -> Estimate | None:
        """The result of the best estimator."""
        return None if self.best is None else self.normals[self.best]

    @cached_property
    def drawings(self) -> dict[str, Drawing]:
        """What is drawn of each estimate; the fitted curves where the camera is known."""
        # Estimators share isophotes: the curve of each is computed once.
        curves: dict[int, Points] = {}
        made = {}
        for name, result in self.normals.items():
            outlines = list[Points]()
            if (camera := self.camera) is not None:
                for isophote in result.isophotes:
                    if id(isophote) not in curves:
                        curves[id(isophote)] = drawable(isophote.ellipse_px(camera))
                    outlines.append(curves[id(isophote)])
                if result.cloud is not None:
                    look = camera.unproject(result.look_px)
                    outlines.append(drawable(camera.project(result.cloud.outline(result.normal, look))))
            isovalues = (isophote.isovalue for isophote in result.isophotes)
            traced = [] if isinstance(self.patch, Failure) else self.patch.contours(isovalues)
            made[name] = Drawing([(t, np.round(points, 3).tolist()) for t, points in traced], outlines)
        return made

    def to_json(self, drawn: bool = True) -> JsonObject:
        """Return an entry of ``specularities``; without isophotes and curves where it is not `drawn`."""
        sightline = None if self.peak_px is None or self.camera is None else self.camera.unproject(self.peak_px)
        # A lens sees no direction beyond its fold.
        if sightline is not None and not np.isfinite(sightline).all():
            sightline = None
        drawings, organ = self.drawings if drawn else {}, self.organ
        return {
            "id": self.id,
            "box_px": self.region.box,
            "peak_px": self.peak_px,
            "sightline": sightline,
            **({} if self.highlight is None else _highlight_json(self.highlight)),
            "score": self.score,
            "best": self.best,
            "best_because": self.best_because,
            "estimates": {
                name: _estimate_json(each, drawings.get(name), organ.get(name)) for name, each in self.estimates.items()
            },
            **{name: value for name in ("track", "reference") if (value := getattr(self, name)) is not None},
        }

    def clouds_json(self, drawn: bool = True) -> list[JsonObject]:
        """Describe the clouds of highlights that its estimates stand on."""
        return [
            {
                "specularity": self.id,
                "estimator": name,
                "highlights": len(cloud.points_px),
                "points_px": np.round(cloud.points_px, 2),
                "covariance": cloud.covariance,
                "axis_ratio": cloud.axis_ratio,
                "seen": cloud.seen,
                "slope_deg": {end: float(np.degrees(getattr(cloud.slope, end))) for end in ("value", "low", "high")},
                "outline": self.drawings[name].curves[0] if drawn else None,
            }
            for name, result in self.normals.items()
            if (cloud := result.cloud) is not None
        ]

    def __repr__(self) -> str:
        failed = [f"{name} ({each.reason})" for name, each in self.estimates.items() if isinstance(each, Failure)]
        x, y = self.position_px
        where = f"at ({x:.1f}, {y:.1f}) px" if self.peak_px is None else f"peak {vector(self.peak_px)} px"
        text = f"{where}, normals: {' '.join(self.normals) or 'none'}" + f", failed: {', '.join(failed)}" * bool(failed)
        return f"Specularity({clipped(text, LONGEST - 13)})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the patch with isophotes and normals, and a row for each estimator."""
        from simtest.reconstruction.page import specularity_html

        return specularity_html(self)


class Specularities(list[Specularity]):
    """The specularities found in a frame, the brightest first, with how the frame was taken.

    Attributes
    ----------
    detection : Detection
        What the detector found, with highlights of other kinds and the view where it judges them.
    choices : Choices
        Encoding, detector, smoothing, estimators and priors; `choices.inferred` names those that nobody gave.
    image : str
        The picture's file, or its name.
    warnings : list of str
        What its user should know.
    reference : optional
        How its normals compare with a reference (`simtest.validation.references`).
    no_cloud : Failure, optional
        Why no cloud tells the organ's normal, where `cloud` ran by default.
    """

    def __init__(
        self, spots: Iterable[Specularity], detection: Detection, choices: Choices, image: str = "",
        warnings: Iterable[str] = (), reference: Any = None, no_cloud: Failure | None = None,
    ) -> None:  # fmt: skip
        super().__init__(spots)
        self.detection, self.choices = detection, choices
        self.image, self.warnings, self.reference, self.no_cloud = image, [*warnings], reference, no_cloud

    @property
    def camera(self) -> Camera:
        """The camera that the frame was taken with."""
        return self.choices.calibration.camera

    @property
    def counted(self) -> str:
        """How many there are, in words."""
        return "1 specularity" if len(self) == 1 else f"{len(self)} specularities"

    @property
    def doubts(self) -> str:
        """How many of them may be no highlights, in a sentence; an empty text where none may."""
        least = [spot.least_score for spot in self if spot.is_doubtful]
        below = f"{len(least)} of {len(self)} may be no highlights: their scores are below"
        return f"{below} {least[0]:g}; --least-score 0 keeps them" if least else ""

    @property
    def clouds(self) -> list[Specularity]:
        """Those of its specularities that are clouds, each with the organ's normal."""
        return [spot for spot in self if spot.cloud is not None]

    @property
    def of_organ(self) -> str:
        """What tells the organ's normal, in a sentence; empty where nobody asked for clouds."""
        if self.no_cloud is not None:
            return f"no cloud of highlights tells the organ's normal: {self.no_cloud.detail}"
        told = []
        for spot in self:
            if (estimate := spot.cloud) is not None and estimate.cloud is not None:
                x, y = (round(float(v)) for v in estimate.look_px)
                deviation = "" if estimate.deviation_deg is None else f" ± {estimate.deviation_deg:.2g} deg"
                count = len(estimate.cloud.points_px)
                told.append(f"at ({x}, {y}) px{deviation}, from {count} highlights (no. {spot.id})")
        return f"the organ's normal is told {'; '.join(told)}" if told else ""

    @property
    def sightline_rule(self) -> tuple[str, ...]:
        """Names of the estimators that give nothing but the reversed sightline of a pixel, as no light is told.

        They differ in the pixel alone, so none is a better method than another. Empty where there are not two of them.
        """
        if len(self.choices.calibration.priors.lights):
            return ()
        names = dict.fromkeys(name for spot in self for name in spot.normals)
        answers = {name: [spot.normals[name] for spot in self if name in spot.normals] for name in names}
        rule = tuple(name for name, own in answers.items() if all(_is_reversed(each, self.camera) for each in own))
        return rule if len(rule) > 1 else ()

    @property
    def rule_note(self) -> str:
        """Which estimators are one rule, and what would tell them apart; an empty text where none are."""
        if not (rule := self.sightline_rule):
            return ""
        return (
            f"Without a light {', '.join(rule[:-1])} and {rule[-1]} are one {SIGHTLINE_RULE}: they differ in nothing "
            "but the pixel that they look at; simtest calibrate light finds the light"
        )

    @property
    def stated(self) -> "StatedErrors | None":
        """What the best estimates state, with the medians of their budgets; None where none states anything."""
        return stated_errors([best for each in self if (best := each.best_estimate) is not None])

    @property
    def stated_of_organ(self) -> "StatedErrors | None":
        """The same of the normals of the organ below its relief."""
        return stated_errors([each.organ[best] for each in self if (best := each.best) is not None and each.organ])

    @property
    def calibrated(self) -> str:
        """How far the regions of calibrated cores' answers reach, and what says so; empty without a calibration."""
        regions = [each.calibrated for spot in self for each in spot.estimates.values()
                   if isinstance(each, Estimate) and each.calibrated is not None]  # fmt: skip
        if not regions:
            return ""
        median = statistics.median(region.radius_95_deg for region in regions)
        sources = "; ".join(dict.fromkeys(region.region_source for region in regions))
        return f"95 % within {median:.3g} deg (median of {len(regions)} answers), {sources}"

    def to_json(self, drawn: bool = True, origin: provenance.Environment | None = None) -> JsonObject:
        """Return the content of normals.json; without isophotes and curves where it is not `drawn`.

        `origin` is what a run of many frames asked for once; asking costs a call of git.
        """
        others = [
            {"box_px": h.region.box, "peak_px": [v + PIXEL_CENTRE for v in h.region.peak], **_highlight_json(h)}
            for h in self.detection.others
        ]
        return {
            "image": self.image,
            "camera": describe_camera(self.camera),
            "encoding": self.choices.encoding,
            "detector": self.choices.detector,
            "smoothing_px": self.choices.smoothing_px,
            "inferred": self.choices.inferred,
            "view": _view_json(self.detection.view),
            "warnings": self.warnings,
            "assumed": self.choices.assumed,
            "stated": self.stated,
            "stated_of_organ": self.stated_of_organ,
            "frame": FRAME,
            "specularities": [spot.to_json(drawn) for spot in self],
            "clouds": [entry for spot in self for entry in spot.clouds_json(drawn)],
            "no_cloud": None if self.no_cloud is None else self.no_cloud.detail,
            "other_highlights": others,
            "provenance": origin or provenance.environment(),
            **({} if self.reference is None else {"reference": self.reference}),
        }

    def to_polars(self) -> "pl.DataFrame":
        """Return the table of normals.csv: a row for each specularity, estimator and candidate, 0 the proposed one."""
        import polars as pl

        from simtest.reconstruction.outputs import columns_of, normals_rows

        entries = [spot.to_json(drawn=False) for spot in self]
        names = columns_of(entries)
        return pl.DataFrame([*normals_rows(entries, names)], schema=[*names], orient="row", infer_schema_length=None)

    def __repr__(self) -> str:
        answered = sum(each.best is not None for each in self)
        text = f"{self.counted}, {answered} with a best normal; {self.choices}"
        return f"<Specularities: {clipped(text, LONGEST - 18)}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the frame with the best normals, and the first rows."""
        from simtest.reconstruction.page import specularities_html

        return specularities_html(self)


def _is_reversed(estimate: Estimate, camera: Camera) -> bool:
    """Return whether an estimate is the reversed sightline of the pixel that it looks at."""
    return estimate.cloud is None and bool(estimate.normal @ camera.unproject(estimate.look_px) < -1 + SAME_COSINE)


def drawable(curve: Array) -> Points:
    """Return a curve, shape (N, 2), px, as lists for a JSON file, without points that the lens does not image."""
    return np.round(curve[np.isfinite(curve).all(axis=1)], 3).tolist()


def cloud_members(spots: Sequence[Specularity]) -> dict[int, int]:
    """Return the specularity of the cloud that each single highlight belongs to, by the highlight's id.

    A highlight belongs to a cloud where one of the cloud's glints lies within `SAME_GLINT_PX` of its peak.
    """
    members: dict[int, int] = {}
    single = [spot for spot in spots if spot.peak_px is not None]
    peaks = np.array([spot.peak_px for spot in single]).reshape(-1, 2)
    for spot in spots:
        for result in spot.normals.values():
            if result.cloud is not None and single:
                apart = np.linalg.norm(peaks[:, None] - result.cloud.points_px[None], axis=2).min(axis=1)
                members |= {single[i].id: spot.id for i in np.flatnonzero(apart < SAME_GLINT_PX)}
    return members


# Which estimate is the best one --------------------------------------------------------------------------------------


def best_of(estimates: Mapping[str, Estimate | Failure], target: Target = "fine") -> tuple[str | None, str]:
    """Return the name of the estimator whose normal is the best one, and why; None where all failed.

    The best one has the smallest expected error, the square root of the covariance's trace, of those that state the
    wanted surface's normal, or else of all. Estimates without uncertainty are worse than any with one.
    """
    answered = {name: result for name, result in estimates.items() if isinstance(result, Estimate)}
    if not answered:
        return None, "no estimator answered"
    wanted = {name: result for name, result in answered.items() if result.target == target} or answered
    stated = {name: expected for name, result in wanted.items() if (expected := result.deviation_deg) is not None}
    if not stated:
        best = min(wanted, key=_rank)
        return best, "no estimator reports an uncertainty; chosen by the estimators' order"
    # The first of equal ones; so the result does not depend on rounding alone.
    best = min(stated, key=lambda name: (stated[name], _rank(name)))
    others = sorted((expected, name) for name, expected in stated.items() if name != best)
    budget = wanted[best].budget or {}
    # The largest part of a budget is named where it has several.
    mostly = f", mostly {dominant(budget)}" if len(budget) > 1 else ""
    because = f"smallest expected error, {stated[best]:.2g} deg{mostly}"
    if others:
        return best, f"{because}; next {others[0][1]} with {others[0][0]:.2g} deg"
    return best, f"{because}; " + ("the only answer" if len(wanted) == 1 else "the others report no uncertainty")


def _rank(name: str) -> int:
    if name in WITHOUT_UNCERTAINTY:
        return WITHOUT_UNCERTAINTY.index(name)
    return len(WITHOUT_UNCERTAINTY) + (name == "circle_pose")


@dataclass(frozen=True)
class StatedErrors:
    """How many best estimates of a picture state an uncertainty, and how many do not; the medians of those, deg.

    They are of the square root of the covariance's trace, and of each part of the budget, the largest first.
    """

    count: int
    silent: int
    median_deg: float
    parts_deg: dict[str, float]

    @property
    def shown_parts_deg(self) -> dict[str, float]:
        """The parts without those below a hundredth of the whole, which change nothing that is shown."""
        return {name: value for name, value in self.parts_deg.items() if value >= 0.01 * self.median_deg}

    def __str__(self) -> str:
        parts = ", ".join(f"{name} {value:.2g}" for name, value in self.shown_parts_deg.items())
        left = f"; {self.silent} report none" if self.silent else ""
        return f"median ± {self.median_deg:.2g} deg of {self.count} best normals ({parts}){left}"


def stated_errors(best: Sequence[Estimate]) -> StatedErrors | None:
    """Summarise the uncertainties of a picture's best estimates; None where none states any."""
    stated = [each for each in best if each.covariance is not None]
    if not stated:
        return None
    parts: dict[str, list[float]] = {}
    for each in stated:
        for name, value in deviations(each.budget or {}).items():
            parts.setdefault(name, []).append(float(np.degrees(value)))
    # A part that some estimates do not have is 0 there.
    medians = {name: statistics.median(values + [0.0] * (len(stated) - len(values))) for name, values in parts.items()}
    median = statistics.median([deviation for each in stated if (deviation := each.deviation_deg) is not None])
    ordered = dict(sorted(medians.items(), key=lambda item: -item[1]))
    return StatedErrors(len(stated), len(best) - len(stated), median, ordered)


# JSON ----------------------------------------------------------------------------------------------------------------


def _view_json(view: View) -> JsonObject | None:
    """Describe the view's border: its circle where it is round, and the outline of what is seen."""
    if view.seen is None:
        return None
    contours, _ = cv2.findContours(view.seen.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygon = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 1.0, True)[:, 0] if contours else np.empty((0, 2))
    return {"circle": view.circle, "outline": polygon + PIXEL_CENTRE}


def _highlight_json(highlight: Highlight) -> JsonObject:
    return {
        "kind": highlight.kind,
        "area_px": highlight.area_px,
        "peaks": max(len(highlight.peaks), 1),
        "clipped": round(highlight.clipped, 3),
        "specular_peak": highlight.region.contrast,
        "shape": {name: getattr(highlight, name) for name in ("axis_ratio", "residual", "wander", "tint", "clutter")},
        "outline": np.round(highlight.outline, 2),
    }


def _estimate_json(result: Estimate | Failure, drawing: Drawing | None, organ: Estimate | None) -> JsonObject:
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
        "organ_covariance": None if organ is None else organ.covariance,
        "budget": result.budget,
        "curvature": None,
        "flags": result.flags,
    }
    if result.axis_ratio_deviation is not None:
        entry["axis_ratio_deviation"] = result.axis_ratio_deviation
    if (shape := result.curvature) is not None:
        entry["curvature"] = {"directions": shape.directions, "axis_ratio": shape.axis_ratio, "gains": shape.hypotheses}
    if result.calibrated is not None:
        entry |= asdict(result.calibrated)
    if drawing is not None:
        entry["isophotes"] = [{"t": t, "points": points} for t, points in drawing.isophotes]
        entry["ellipses"] = [isophote.conic.image for isophote in result.isophotes if isophote.conic is not None]
        entry["cones"] = [isophote.cone for isophote in result.isophotes]
        entry["curves"] = drawing.curves
    return entry
