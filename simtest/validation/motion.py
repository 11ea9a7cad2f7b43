"""Motion as a method: the signs of a first view's curvatures, told by where its highlights lie in further views [Z89].

The truth is used afterwards, to judge the signs; the views are matched by what the hypotheses predict.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from simtest.conventions import MOTION
from simtest.errors import Failure, Reason
from simtest.estimators import AnyEstimator, Estimate
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.motion_signs import EXACT, MovedView, PoseError, RankedHypotheses, rank_by_motions
from simtest.geometry.vectors import rotation
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import Experiment, Scene
from simtest.spec.camera import Moved, Views
from simtest.validation.cases import Case
from simtest.validation.columns import Row


@dataclass(frozen=True)
class FurtherView:
    """A rendered further view, and where its camera stands."""

    moved: Moved
    view: RenderedView


def further_views(session: Session, scene: Scene) -> list[FurtherView]:
    """Render the further views of a scene; the session is then at the last of them."""
    made = []
    for moved in () if scene.views is None else scene.views.moved():
        camera = scene.camera.model_copy(update={"moved": moved})
        made.append(FurtherView(moved, render_view(session, scene.model_copy(update={"camera": camera}))))
    return made


@dataclass(frozen=True)
class MotionResult:
    """What motion tells of one realisation's highlights.

    Parameters
    ----------
    specularities : list of Specularity
        With an estimate called `MOTION`.
    ranked : dict
        The ranked hypotheses by the specularity's index; those that have none are left out.
    """

    specularities: list[Specularity]
    ranked: dict[int, RankedHypotheses]

    def columns(self, row: Row, scene: Scene, truths: Sequence[HighlightPoint]) -> Row:
        """Return `MOTION_COLUMNS` of a row; those that are not known are left out.

        `motion_sign_i` is the told sign of 1 + d k along the estimated principal direction i, 0 where it is not told,
        and `motion_gain_i` the true 1 + d k along that direction (Euler's formula).
        """
        assert scene.views is not None
        number, true_id = row.get("specularity"), row.get("true_id")
        truth = truths[true_id] if isinstance(true_id, int) else None
        values: Row = {}
        if truth is not None:
            values["motion_over_d"] = scene.views.length_mm / truth.distance
        if isinstance(number, int) and (ranked := self.ranked.get(number)) is not None:
            for i, (sign, margin) in enumerate(zip(ranked.told_signs, ranked.sign_margins.tolist(), strict=True), 1):
                values |= {f"motion_sign_{i}": float(sign), f"motion_margin_{i}": margin}
            values |= {"motion_distance2": float(ranked.distance2[0]), "motion_fits": float(ranked.fits)}
            first = first_estimate(self.specularities[number].estimates)
            if truth is not None and isinstance(first, Estimate) and first.curvature is not None:
                gains = true_gains(first.curvature.directions, truth).tolist()
                values |= {f"motion_gain_{i}": gain for i, gain in enumerate(gains, 1)}
        return values


def with_motion(
    experiment: Experiment, case: Case, number: int, view: RenderedView, further: Sequence[FurtherView],
    specularities: Sequence[Specularity],
) -> MotionResult:  # fmt: skip
    """Add to each specularity of a realisation what motion makes of it."""
    told = view.scene.views
    assert told is not None
    rng = generator(experiment.seed, experiment.name, case.name, number, Stage.POSE)
    seen = [_seen(each, told, case, rng) for each in further]
    made, ranked = [], {}
    for i, specularity in enumerate(specularities):
        first = first_estimate(specularity.estimates)
        result = first
        if isinstance(first, Estimate):
            judged = rank_by_motions(first, seen, view.calibration.priors)
            result = judged if isinstance(judged, Failure) else decided(first, judged)
            if isinstance(judged, RankedHypotheses):
                ranked[i] = judged
        made.append(replace(specularity, estimates={**specularity.estimates, MOTION: result}))
    return MotionResult(made, ranked)


def first_estimate(estimates: Mapping[str, Estimate | Failure]) -> Estimate | Failure:
    """Return the first estimate that states a curvature, or why there is none."""
    for each in estimates.values():
        if isinstance(each, Estimate) and each.curvature is not None:
            return each
    failed = estimates.get("curved")
    if isinstance(failed, Failure):
        return failed
    return Failure(Reason.NOT_KNOWN, "needs an estimator of curvature, such as curved, that has not failed")


def decided(first: Estimate, ranked: RankedHypotheses) -> Estimate | Failure:
    """Return the first estimate with its curvatures as motion ranks them, or a Failure where a sign is not told."""
    if not ranked.fits:
        text = f"squared distance {ranked.distance2[0]:.3g}; no hypothesis explains the further pictures"
        return Failure(Reason.UNDECIDED, text)
    told = ranked.told_signs
    if 0 in told:
        margins = " and ".join(f"{margin:.3g}" for margin in ranked.sign_margins)
        return Failure(Reason.UNDECIDED, f"margins of the two signs {margins}")
    assert first.curvature is not None
    curvature = replace(first.curvature, hypotheses=ranked.hypotheses)
    return replace(first, curvature=curvature, choice_margin=ranked.margin)


def true_gains(directions: Array, truth: HighlightPoint) -> Array:
    """Return the true 1 + d k along two directions, shape (2, 3)."""
    second = np.cross(truth.normal, truth.direction_min)
    first, other = directions @ truth.direction_min, directions @ second
    return np.asarray(1 + (truth.kd_min * first**2 + truth.kd_max * other**2) / (first**2 + other**2))


def told_pose(views: Views, true: Moved, rng: np.random.Generator) -> Array:
    """Return view_from_first, shape (4, 4), as it is told: the true motion with an error drawn."""
    pose = true.pose()
    pose[:3, 3] += views.translation_error * views.length_mm * rng.standard_normal(3)
    pose[:3, :3] = pose[:3, :3] @ rotation(np.radians(views.rotation_error_deg) * rng.standard_normal(3))
    return np.asarray(np.linalg.inv(pose))


def _seen(further: FurtherView, told: Views, case: Case, rng: np.random.Generator) -> MovedView:
    """Expose and reconstruct a further view; its pose is told with an error."""
    pose = told_pose(told, further.moved, rng)
    frame = further.view.frame(int(rng.integers(2**62)))
    error = EXACT
    if told.errors_told:
        error = PoseError(told.translation_error, float(np.radians(told.rotation_error_deg)))
    if further.view.full_scale <= 0:
        return MovedView([], pose, error)
    estimators: dict[str, AnyEstimator] = {"cone_axis": cone_axis}
    found = reconstruct(frame, further.view.calibration, estimators, isolated=case.isolated)
    estimates = [each.estimates["cone_axis"] for each in found]
    return MovedView([each for each in estimates if isinstance(each, Estimate)], pose, error)
