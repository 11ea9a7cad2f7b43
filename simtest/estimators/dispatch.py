"""Run estimators on the highlights of a frame so that whatever they do is an `Estimate` or a `Failure`."""

import contextlib
import math
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.budget import total
from simtest.estimators.protocol import (
    AnyEstimator,
    BatchEstimator,
    Estimate,
    Estimator,
    FrameEstimator,
    PreparedEstimator,
    RegionEstimator,
)
from simtest.geometry import Array, Camera, Patch

UNIT_TOLERANCE = 1e-6

LEAST_VARIANCE = 1e-24
"""rad^2; below it a normal is more certain than its own digits."""

LEAST_SHARE = 1e-12
"""Of the largest variance squared: a determinant below it is rounding."""

_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class FrameResults:
    """The results of one estimator: of each patch, and estimates of a frame that no patch takes.

    A patch has None from an estimator whose estimates are of clouds of highlights, and where a table has no row.
    """

    of_patches: Sequence[Estimate | Failure | None]
    elsewhere: list[Estimate] = field(default_factory=list)


def run(estimator: Estimator, patch: Patch | Failure, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
    """Run an estimator on a patch; a patch that is a Failure is passed on.

    What the estimator raises, or returns in another form than `Estimate` describes, is a Failure ``estimator_error``
    (one highlight must not end a run of thousands); values that are not finite are a Failure ``not_finite``.
    """
    if isinstance(patch, Failure):
        return patch
    try:
        return _checked(estimator.estimate(patch, camera, priors), camera, patch.peak_px)
    except Exception as error:
        return _estimator_error(error)


def run_each(
    estimator: Estimator, patches: Sequence[Patch | Failure], camera: Camera, priors: Priors = NO_PRIORS
) -> list[Estimate | Failure]:
    """Run an estimator on several patches, in one batch where it takes batches, else one by one (see `run`).

    A batch that raises, or returns another number of results, warns with the estimator and the error; each patch is
    then run alone, so that one of them spoils no other.
    """
    sound = [patch for patch in patches if not isinstance(patch, Failure)]
    results: Sequence[Estimate | Failure] | None = None
    if isinstance(estimator, BatchEstimator) and len(sound) > 1:
        results = _batch(estimator, sound, camera, priors)
    if results is None:
        results = [run(estimator, patch, camera, priors) for patch in sound]
    following = iter(results)  # failures keep their positions among the patches
    return [patch if isinstance(patch, Failure) else next(following) for patch in patches]


def prepare(estimators: Sequence[AnyEstimator], patches: Sequence[Patch | Failure], camera: Camera) -> None:
    """Let estimators fit what they share to several patches at once (`PreparedEstimator`)."""
    sound = [patch for patch in patches if not isinstance(patch, Failure)]
    for estimator in estimators:
        if isinstance(estimator, PreparedEstimator) and len(sound) > 1:
            # What fails here fails again, with its reason, at the highlight that it comes from.
            with contextlib.suppress(Exception):
                estimator.prepare(sound, camera)


def _batch(
    estimator: BatchEstimator, patches: Sequence[Patch], camera: Camera, priors: Priors
) -> list[Estimate | Failure] | None:
    """Run a batch and check its results; None, with a warning, where it fails as a whole."""
    try:
        results = list(estimator.estimate_batch(patches, camera, priors))
        if len(results) != len(patches):
            raise ValueError(f"{len(results)} results for {len(patches)} patches")
        return [_checked(result, camera, patch.peak_px) for patch, result in zip(patches, results, strict=True)]
    except Exception as error:
        warnings.warn(
            f"{type(estimator).__qualname__}.estimate_batch failed, and each highlight is estimated alone: "
            f"{type(error).__name__}: {error}", RuntimeWarning, stacklevel=3,
        )  # fmt: skip
        return None


def run_in_frame(
    estimator: AnyEstimator, frame: Frame, patches: Sequence[Patch | Failure], priors: Priors = NO_PRIORS
) -> FrameResults:
    """Run an estimator on the patches of a frame or, if it is a `FrameEstimator`, on the frame.

    Estimates of a frame go to patches: each to the one that holds the pixel it looks at, the nearest to the patch's
    peak first, one a patch. A patch without any gets a Failure ``no_estimate``. Those of clouds are of no single
    highlight, so they go to no patch, and patches get none from an estimator that states clouds alone. Where
    `estimate_frame` raises, or one of its estimates is malformed, its results are refused as a whole: every patch gets
    that Failure.
    """
    camera = frame.calibration.camera
    if not isinstance(estimator, FrameEstimator):
        return FrameResults(run_each(estimator, patches, camera, priors))
    if isinstance(estimator, RegionEstimator):
        of_patches, elsewhere = estimator.estimate_regions(frame, patches)
        return FrameResults([None if each is None else _checked(each, camera) for each in of_patches], [*elsewhere])
    try:
        returned = estimator.estimate_frame(frame, camera, priors)
        results: Failure | list[Estimate] = returned if isinstance(returned, Failure) else _all_sound(returned, camera)
    except Exception as error:
        results = _estimator_error(error)
    if isinstance(results, Failure):
        return FrameResults([patch if isinstance(patch, Failure) else results for patch in patches])
    of_clouds = [estimate for estimate in results if estimate.cloud is not None]
    if of_clouds and len(of_clouds) == len(results):
        return FrameResults([None] * len(patches), of_clouds)
    made = _assigned([estimate for estimate in results if estimate.cloud is None], patches)
    return FrameResults(made.of_patches, [*made.elsewhere, *of_clouds])


def _all_sound(returned: Sequence[object], camera: Camera) -> list[Estimate] | Failure:
    """Return the estimates of a frame, or what is wrong with the first malformed one."""
    estimates: list[Estimate] = []
    for number, given in enumerate(returned):
        result = _checked(given, camera)
        if not isinstance(result, Failure) and not camera.contains(result.look_px):
            result = Failure(Reason.ESTIMATOR_ERROR, f"look_px = {result.look_px.tolist()}: must lie in the frame")
        if isinstance(result, Failure):
            return Failure(result.reason, f"estimate {number}: {result.detail}")
        estimates.append(result)
    return estimates


def _assigned(estimates: Sequence[Estimate], patches: Sequence[Patch | Failure]) -> FrameResults:
    """Assign the estimates of a frame to its patches."""
    taken = assign([estimate.look_px for estimate in estimates], patches)
    missing = Failure(Reason.NO_ESTIMATE, "the estimator has none in this region")
    of_patches = [
        estimates[taken[p]] if p in taken else patch if isinstance(patch, Failure) else missing
        for p, patch in enumerate(patches)
    ]
    return FrameResults(of_patches, [each for e, each in enumerate(estimates) if e not in taken.values()])


def assign(points_px: Sequence[Array], patches: Sequence[Patch | Failure]) -> dict[int, int]:
    """Return the index of a point, px, by index of the patch that holds it: the nearest to the patch's peak first.

    Each patch has one point at most, and each point one patch.
    """
    # candidates: pairs of a patch and a point in it, with the distance from the peak
    pairs = []
    for p, patch in enumerate(patches):
        if not isinstance(patch, Failure):
            gaps = [float(np.hypot(*(point - patch.peak_px))) for point in points_px]
            pairs += [(gap, p, e) for e, gap in enumerate(gaps) if _holds(patch, points_px[e])]
    # the nearest first, each patch and each point once
    taken: dict[int, int] = {}
    for _, p, e in sorted(pairs):
        if p not in taken and e not in taken.values():
            taken[p] = e
    return taken


def _holds(patch: Patch, point: Array) -> bool:
    height, width = patch.values.shape
    x, y = point - patch.origin_px
    return bool(0 <= x < width and 0 <= y < height)


def _estimator_error(error: Exception) -> Failure:
    return Failure(Reason.ESTIMATOR_ERROR, f"{type(error).__name__}: {error}{_place(error)}")


def _place(error: Exception) -> str:
    """Return the innermost line of the estimator's own file that the exception came through: `` (my_core.py:11)``.

    What was raised before the estimator's first line, such as a wrong number of arguments, has no place.
    """
    # The first entry is the call in this file. Between it and a plain function stands a wrapper of this package.
    steps = traceback.extract_tb(error.__traceback__)[1:]
    foreign = [step.filename for step in steps if not Path(step.filename).is_relative_to(_PACKAGE)]
    file = foreign[0] if foreign else steps[0].filename if steps else None
    own = [step for step in steps if step.filename == file]
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""


def _checked(result: object, camera: Camera, peak_px: Array | None = None) -> Estimate | Failure:
    """Return an estimator's result, or a Failure where it is not what `Estimate` describes."""
    if isinstance(result, Failure):
        return result
    if not isinstance(result, Estimate):
        return Failure(Reason.ESTIMATOR_ERROR, f"gave a {type(result).__name__}; must be an Estimate or a Failure")
    return _malformed(result) or _singular(result) or _facing_away(result, camera, peak_px) or result


def _malformed(estimate: Estimate) -> Failure | None:
    """Return what is wrong with the shape, type or value of an estimate's parts, or None."""
    # the budget before its sum
    if (wrong := _malformed_budget(estimate)) is not None:
        return wrong
    # shapes and finite values
    shapes = (
        ("normal", estimate.normal, (3,)),
        ("candidates", estimate.candidates, (max(len(estimate.candidates), 1), 3)),
        ("look_px", estimate.look_px, (2,)),
        ("covariance", estimate.covariance, (2, 2)),
    )
    for name, value, shape in shapes:
        if name == "covariance" and value is None:
            continue
        if not isinstance(value, np.ndarray) or value.shape != shape:
            return Failure(Reason.ESTIMATOR_ERROR, f"{name}: must be an array of shape {shape}")
        if name != "look_px" and not _is_finite(value):
            return Failure(Reason.NOT_FINITE, f"{name} holds NaN or infinity")
    for name in ("axis_ratio", "axis_ratio_deviation", "choice_margin"):
        number = getattr(estimate, name)
        if number is not None and not np.isfinite(number):
            return Failure(Reason.NOT_FINITE, f"{name} is {number}")
    if estimate.region is not None and not np.isfinite(estimate.region.statistic(estimate.candidates)).all():
        return Failure(Reason.NOT_FINITE, "region: the statistic of a candidate is not finite")
    # unit vectors, the proposed one first
    vectors = np.concatenate([estimate.normal[None], estimate.candidates])
    lengths = np.sqrt(np.sum(vectors * vectors, axis=1))
    if np.abs(lengths - 1).max() > UNIT_TOLERANCE:
        return Failure(Reason.ESTIMATOR_ERROR, f"normal or candidate of length {lengths.max():g}: must be unit vectors")
    if np.abs(estimate.candidates[0] - estimate.normal).max() > UNIT_TOLERANCE:
        return Failure(Reason.ESTIMATOR_ERROR, "the first candidate must be the proposed normal")
    if not isinstance(estimate.flags, tuple) or not all(isinstance(flag, str) for flag in estimate.flags):
        return Failure(Reason.ESTIMATOR_ERROR, "flags: must be a tuple of text")
    return None


def _malformed_budget(estimate: Estimate) -> Failure | None:
    """Return what is wrong with the parts of an estimate's budget or with its target, or None."""
    if estimate.target not in ("fine", "base"):
        return Failure(Reason.ESTIMATOR_ERROR, f"target {estimate.target!r}: must be fine or base")
    budget = estimate.budget or {}
    for name, part in budget.items():
        if not isinstance(part, np.ndarray) or part.shape != (2, 2):
            return Failure(Reason.ESTIMATOR_ERROR, f"budget {name}: must be an array of shape (2, 2)")
    # One test of the sum; only where it fails are the parts looked at one by one.
    whole = total(budget)
    if not _is_finite(whole):
        bad = next((name for name, part in budget.items() if not _is_finite(part)), "")
        return Failure(Reason.NOT_FINITE, f"budget {bad} holds NaN or infinity")
    if estimate.covariance is not None and not _equal(whole, estimate.covariance):
        return Failure(Reason.ESTIMATOR_ERROR, "covariance: must be the sum of the budget's parts")
    return None


def _is_finite(values: Array) -> bool:
    """Return whether all of a few numbers are finite; `np.isfinite` takes three times as long."""
    return all(map(math.isfinite, values.ravel().tolist()))


def _singular(estimate: Estimate) -> Failure | None:
    """Return a Failure where a covariance has no variance in a direction: it would escape the coverage."""
    if estimate.covariance is None:
        return None
    # Plain numbers: this is done for each estimate.
    (first, mixed), (_, second) = estimate.covariance.tolist()
    if not is_singular(first, mixed, second):
        return None
    return Failure(Reason.ESTIMATOR_ERROR, "covariance: singular; must have a variance in each direction")


def is_singular(first: float, mixed: float, second: float) -> bool:
    """Return whether a covariance of these elements 11, 12 and 22, rad^2, has no variance in a direction."""
    least, largest = min(first, second), max(first, second)
    return least <= LEAST_VARIANCE or first * second - mixed * mixed <= LEAST_SHARE * largest * largest


def _equal(one: Array, other: Array) -> bool:
    """Return whether two covariances are equal but for rounding; `np.allclose` takes ten times as long."""
    return bool((np.abs(one - other) <= 1e-6 * np.abs(other) + 1e-18).all())


def _facing_away(estimate: Estimate, camera: Camera, peak_px: Array | None) -> Failure | None:
    """Return a Failure where the camera sees the surface from behind, at the pixel looked at or else at the peak."""
    look = estimate.look_px if peak_px is None or _is_finite(estimate.look_px) else peak_px
    if estimate.normal @ camera.unproject(look) >= 0:
        return Failure(Reason.ESTIMATOR_ERROR, "the normal faces away from the camera")
    return None
