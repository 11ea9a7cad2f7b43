"""Convex or concave, for the highlights of a sequence whose camera's poses are known [Z89].

Each highlight is judged by the other frames of its track. The light must be at the camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from simtest.calibration import Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.motion_signs import CLEAR, MovedView, PoseError, RankedHypotheses, rank_by_motions
from simtest.reconstruction.description import SpecularityRecord
from simtest.reconstruction.motion_record import MotionRecord
from simtest.reconstruction.tracking import TrackedFrame
from simtest.runtime.arrays import Array

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


def check_priors(priors: Priors, camera: Path) -> None:
    """Raise `InputError` where a calibration lacks what the method needs."""
    where = f"--camera {camera}: --poses needs"
    if priors.distance_mm is None:
        raise InputError(
            f"{where} the working distance; give rig.distance_mm with distance_sd_mm, or distance_range_mm"
        )
    if priors.lobe_curvature is None:
        raise InputError(f"{where} the width of the lobe; give surface.phong_exponent or surface.lobe_curvature")
    offset = max((float(np.linalg.norm(light)) for light in priors.lights_mm), default=np.inf)
    if offset > MOST_OFFSET * priors.distance_mm.mean:
        told = "none is given" if np.isinf(offset) else f"one lies {offset:.3g} mm off"
        raise InputError(f"{where} all lights at the camera, within {MOST_OFFSET:.0%} of the distance; {told}")


def judge_by_motion(
    frames: Sequence[TrackedFrame], poses: Sequence[Array | None], error: PoseError, priors: Priors
) -> list[TrackedFrame]:
    """Judge the highlights of each frame by the other frames of their tracks.

    Parameters
    ----------
    frames : sequence of TrackedFrame
        With estimates of `NEEDED`.
    poses : sequence of ndarray, shape (4, 4), or None
        world_from_camera of each frame, mm.
    error : PoseError
        Of the motion between two frames.
    priors : Priors
        See `check_priors`.

    Returns
    -------
    list of TrackedFrame
        Whose specularities have a `motion`.
    """
    tracks: dict[int, list[tuple[TrackedFrame, Array, Estimate]]] = {}
    for frame, pose in zip(frames, poses, strict=True):
        for spot in frame.specularities:
            estimate = _normal(spot.estimates)
            if pose is not None and estimate is not None and spot.track is not None:
                tracks.setdefault(spot.track, []).append((frame, pose, estimate))
    made = []
    for frame, pose in zip(frames, poses, strict=True):
        spots = [
            replace(spot, motion=_judge(spot, frame, pose, tracks.get(-1 if spot.track is None else spot.track, []),
                                        error, priors))
            for spot in frame.specularities
        ]  # fmt: skip
        made.append(replace(frame, specularities=spots))
    return made


def fits_flipped_axes(
    judged: Sequence[TrackedFrame], poses: Sequence[Array | None], error: PoseError, priors: Priors
) -> bool:
    """Return whether the frames fit clearly better if the poses' camera axes are those of OpenGL.

    Wrong axes are not always found so: where the motion is short, or along x alone, both fit. The median over the
    highlights decides, by a squared distance that is less by the `CLEAR` of a told sign. See `judge_by_motion`, which
    made `judged`.
    """
    turned = judge_by_motion(judged, [None if pose is None else pose @ _FLIPPED for pose in poses], error, priors)
    pairs = [
        (given.motion.distance2, other.motion.distance2)
        for frame, flipped in zip(judged, turned, strict=True)
        for given, other in zip(frame.specularities, flipped.specularities, strict=True)
        if given.motion is not None and other.motion is not None
    ]
    gained = [given - other for given, other in pairs if given is not None and other is not None]
    return bool(gained) and float(np.median(gained)) > CLEAR


def _normal(estimates: Mapping[str, Estimate | Failure]) -> Estimate | None:
    """Return the normal of a highlight that judges others."""
    for name in JUDGING:
        if isinstance(found := estimates.get(name), Estimate):
            return found
    return None


def _judge(
    spot: SpecularityRecord, frame: TrackedFrame, pose: Array | None,
    track: Sequence[tuple[TrackedFrame, Array, Estimate]], error: PoseError, priors: Priors,
) -> MotionRecord:  # fmt: skip
    first = spot.estimates.get(NEEDED)
    if pose is None:
        return _undecided(Failure(Reason.NOT_KNOWN, "no pose of this frame"))
    if not isinstance(first, Estimate) or first.curvature is None:
        return _undecided(first if isinstance(first, Failure) else Failure(Reason.NOT_KNOWN, "no curvature"))
    assert priors.distance_mm is not None
    lengths = np.array([np.linalg.norm(other[:3, 3] - pose[:3, 3]) for _, other, _ in track]) / priors.distance_mm.mean
    to_others = lengths[[other is not frame for other, _, _ in track]]
    motions = (float(to_others.min()), float(to_others.max())) if len(to_others) else None
    near = np.flatnonzero((lengths >= LEAST_MOTION) & (lengths <= MOST_MOTION))
    chosen = [track[i] for i in near[np.unique(np.linspace(0, len(near) - 1, MOST_VIEWS).round().astype(int))]] \
        if len(near) else []  # fmt: skip
    if not chosen:
        told = f"{LEAST_MOTION:g} to {MOST_MOTION:g} of the distance away"
        undecided = _undecided(Failure(Reason.NO_ESTIMATE, f"its track has no other frame {told}"))
        return replace(undecided, motions=motions)
    views = [MovedView([estimate], np.linalg.inv(other) @ pose, error) for _, other, estimate in chosen]
    ranked = rank_by_motions(first, views, priors)
    indices = tuple(other.index for other, _, _ in chosen)
    record = _undecided(ranked, indices) if isinstance(ranked, Failure) else _record(ranked, indices)
    return replace(record, motions=motions)


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
