"""Convex or concave, for the highlights of a sequence whose camera's poses are known [Z89].

Each highlight is judged by the other frames of its track. The light must be at the camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtest.calibration import Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.motion_signs import CLEAR, MovedView, PoseError, RankedHypotheses, rank_by_motions
from simtest.estimators.protocol import EstimatedCurvature
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject

MOST_VIEWS = 6
"""Other frames that judge a highlight: evenly spaced ones of all that may."""

LEAST_MOTION, MOST_MOTION = 0.002, 0.2
"""Motions that judge, as shares of the distance: shorter ones tell nothing, and after longer ones the highlight lies on
another part of the surface."""

MOST_OFFSET = 0.05
"""Farthest light from the camera, as a share of the distance."""

NEEDED = "curved"
"""Estimator of the curvatures whose signs are asked."""

JUDGING = (NEEDED, "cone_axis")
"""Estimators for a light at the camera, whose normals judge others: the first that answered."""

_FLIPPED = np.diag([1.0, -1.0, -1.0, 1.0])
"""From camera axes x right, y up, z backward, as OpenGL and Blender have them, to ours."""

_BENDS = {1: "convex", -1: "concave", 0: "undecided"}


COLUMNS = ("motion", "motion_frames", "bend_1", "bend_2", "sign_1", "sign_2", "margin_1", "margin_2")
"""Columns of timeline.csv of a sequence with poses."""


@dataclass(frozen=True)
class MotionRecord:
    """What motion tells of a highlight: "ok" where both signs are told, else the `Reason`; `detail` says more.

    `signs` are those of 1 + d k along both principal directions of the estimate `curved`, 0 where it is not told, with
    `margins`, twice the log of the likelihood ratio of each sign and the other one. `gains` are 1 + d k of the
    hypothesis that explains the `frames` best, told or not, at the squared Mahalanobis distance `distance2` with so
    many degrees of `freedom`; it `fits` where chance explains that. `motions` are the shortest and the longest one to
    another frame of its track, as shares of the distance; None where there is none.
    """

    status: str
    detail: str = ""
    frames: tuple[int, ...] = ()
    signs: tuple[int, int] = (0, 0)
    margins: tuple[float, ...] = (0.0, 0.0)
    gains: tuple[float, ...] = ()
    bends: tuple[str, str] = ("undecided", "undecided")
    distance2: float | None = None
    freedom: int = 0
    fits: bool = False
    motions: tuple[float, float] | None = None

    @property
    def shape(self) -> str:
        """The bends in a word: convex, concave, saddle, or both one by one."""
        first, second = self.bends
        if first == second:
            return first
        return "saddle" if "undecided" not in self.bends else f"{first} and {second}"

    def to_json(self) -> JsonObject:
        """Return the entry ``motion`` of a specularity."""
        return {**vars(self), "shape": self.shape}


def motion_row(entry: JsonObject) -> tuple[object, ...]:
    """Return the values of `COLUMNS` of an entry ``motion``."""
    return (entry["status"], len(entry["frames"]), *entry["bends"], *entry["signs"], *entry["margins"])


def check_priors(priors: Priors, camera: Path) -> None:
    """Raise `InputError` where a calibration lacks what the method needs."""
    where = f"--camera {camera}: --poses needs"
    if priors.distance_mm is None:
        keys = "rig.distance_mm with distance_sd_mm, or distance_range_mm"
        raise InputError(f"{where} the working distance; give {keys}")
    if priors.lobe_curvature is None:
        raise InputError(f"{where} the width of the lobe; give surface.phong_exponent or surface.lobe_curvature")
    offset = max((float(np.linalg.norm(light)) for light in priors.lights_mm), default=np.inf)
    if offset > MOST_OFFSET * priors.distance_mm.mean:
        told = "none is given" if np.isinf(offset) else f"one lies {offset:.3g} mm off"
        raise InputError(f"{where} all lights at the camera, within {MOST_OFFSET:.0%} of the distance; {told}")


@dataclass(frozen=True)
class TrackedHighlight:
    """A highlight of a sequence: the number of its frame, that of its track, and the estimates that motion needs."""

    frame: int
    track: int
    estimates: Mapping[str, Estimate | Failure]

    @classmethod
    def from_json(cls, frame: int, entry: JsonObject) -> "TrackedHighlight":
        """Read it from an entry of ``specularities`` of a frame's file."""
        answers = {name: entry["estimates"][name] for name in JUDGING if name in entry["estimates"]}
        return cls(frame, entry["track"], {name: _estimate_from_json(answer) for name, answer in answers.items()})

    @property
    def judging(self) -> Estimate | None:
        """The normal by which it judges others of its track."""
        answered = (self.estimates.get(name) for name in JUDGING)
        return next((each for each in answered if isinstance(each, Estimate)), None)


def judge_by_motion(
    highlights: Sequence[TrackedHighlight], poses: Mapping[int, Array | None], error: PoseError, priors: Priors
) -> list[MotionRecord]:
    """Judge the highlights of a sequence by the other frames of their tracks.

    `poses` are world_from_camera by the number of the frame, mm, and `error` is that of the motion between two frames;
    for the priors see `check_priors`.
    """
    tracks: dict[int, list[TrackedHighlight]] = {}
    for each in highlights:
        if poses[each.frame] is not None and each.judging is not None:
            tracks.setdefault(each.track, []).append(each)
    return [_judge(each, tracks.get(each.track, []), poses, error, priors) for each in highlights]


def fits_flipped_axes(
    highlights: Sequence[TrackedHighlight], judged: Sequence[MotionRecord], poses: Mapping[int, Array | None],
    error: PoseError, priors: Priors,
) -> bool:  # fmt: skip
    """Return whether the frames fit clearly better if the poses' camera axes are those of OpenGL.

    Wrong axes are not always found so: where the motion is short, or along x alone, both fit. The median over the
    highlights decides, by a squared distance that is less by the `CLEAR` of a told sign. See `judge_by_motion`, which
    made `judged`.
    """
    flipped = {frame: None if pose is None else pose @ _FLIPPED for frame, pose in poses.items()}
    turned = judge_by_motion(highlights, flipped, error, priors)
    pairs = ((given.distance2, other.distance2) for given, other in zip(judged, turned, strict=True))
    gained = [given - other for given, other in pairs if given is not None and other is not None]
    return bool(gained) and float(np.median(gained)) > CLEAR


def _judge(
    highlight: TrackedHighlight, track: Sequence[TrackedHighlight], poses: Mapping[int, Array | None],
    error: PoseError, priors: Priors,
) -> MotionRecord:  # fmt: skip
    first, pose = highlight.estimates.get(NEEDED), poses[highlight.frame]
    if pose is None:
        return _undecided(Failure(Reason.NOT_KNOWN, "no pose of this frame"))
    if not isinstance(first, Estimate) or first.curvature is None:
        return _undecided(first if isinstance(first, Failure) else Failure(Reason.NOT_KNOWN, "no curvature"))
    assert priors.distance_mm is not None
    seen = [(each.frame, other, each.judging) for each in track if (other := poses[each.frame]) is not None]
    lengths = np.array([np.linalg.norm(other[:3, 3] - pose[:3, 3]) for _, other, _ in seen]) / priors.distance_mm.mean
    to_others = lengths[[frame != highlight.frame for frame, _, _ in seen]]
    motions = (float(to_others.min()), float(to_others.max())) if len(to_others) else None
    near = np.flatnonzero((lengths >= LEAST_MOTION) & (lengths <= MOST_MOTION))
    if not len(near):
        distance = f"{LEAST_MOTION:g} to {MOST_MOTION:g} of the distance away"
        undecided = _undecided(Failure(Reason.NO_ESTIMATE, f"its track has no other frame {distance}"))
        return replace(undecided, motions=motions)
    spread = np.unique(np.linspace(0, len(near) - 1, MOST_VIEWS).round().astype(int))
    chosen = [seen[i] for i in near[spread]]
    views = [MovedView([e], np.linalg.inv(other) @ pose, error) for _, other, e in chosen if e is not None]
    ranked = rank_by_motions(first, views, priors)
    indices = tuple(frame for frame, _, _ in chosen)
    record = _undecided(ranked, indices) if isinstance(ranked, Failure) else _record(ranked, indices)
    return replace(record, motions=motions)


def _estimate_from_json(entry: JsonObject) -> Estimate | Failure:
    """Read the estimate of an entry, without its isophotes."""
    if entry["status"] != "ok":
        return Failure(Reason(entry["status"]), entry["detail"])
    normal, candidates, look_px = (np.array(entry[key], dtype=float) for key in ("normal", "candidates", "look_px"))
    budget = entry["budget"] and {name: np.array(part) for name, part in entry["budget"].items()}
    curvature = None
    if (shape := entry["curvature"]) is not None:
        gains = None if shape["gains"] is None else np.array(shape["gains"], dtype=float)
        curvature = EstimatedCurvature(np.array(shape["directions"], dtype=float), shape["axis_ratio"], gains)
    return Estimate(
        normal, candidates, look_px, entry["axis_ratio"], (), entry["choice_margin"], flags=tuple(entry["flags"]),
        budget=budget, target=entry["target"], curvature=curvature,
        axis_ratio_deviation=entry.get("axis_ratio_deviation"),
    )  # fmt: skip


def _undecided(failure: Failure, frames: tuple[int, ...] = ()) -> MotionRecord:
    return MotionRecord(str(failure.reason), failure.detail, frames)


def _record(ranked: RankedHypotheses, frames: tuple[int, ...]) -> MotionRecord:
    signs = ranked.told_signs
    status, detail = "ok", ""
    if not ranked.fits:
        status, detail = str(Reason.UNDECIDED), "no curvature explains the other frames: a wrong pose, or it moved"
    elif 0 in signs:
        which = "neither sign is" if signs == (0, 0) else "one sign is not"
        status, detail = str(Reason.UNDECIDED), f"{which} clear"
    first, second = (_BENDS[bend] for bend in ranked.told_bends())
    return MotionRecord(
        status, detail, frames, signs, tuple(ranked.sign_margins.tolist()), tuple(ranked.hypotheses[0].tolist()),
        (first, second), float(ranked.distance2[0]), ranked.freedom, ranked.fits,
    )  # fmt: skip
