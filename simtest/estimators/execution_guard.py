"""Running an estimator, of this package or another, so that whatever it does is an `Estimate` or a `Failure`."""

import inspect
from collections.abc import Sequence

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.protocol import BatchEstimator, Estimate, Estimator
from simtest.geometry import Camera, Patch

UNIT_TOLERANCE = 1e-6


def run(estimator: Estimator, patch: Patch | Failure, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
    """Run an estimator on a patch.

    Parameters
    ----------
    estimator : callable
        See `Estimator`.
    patch : Patch or Failure
        A Failure is passed on.
    camera : Camera
        Calibration.
    priors : Priors
        Passed on to an estimator that has a parameter of that name.

    Returns
    -------
    Estimate or Failure
        What the estimator raises, or gives in another form than `Estimate` describes, is a Failure
        ``estimator_error`` (one highlight must not end a run of thousands); values that are not finite ``not_finite``.
    """
    if isinstance(patch, Failure):
        return patch
    try:
        result = estimator(patch, camera, priors=priors) if _asks(estimator) else estimator(patch, camera)
        return _checked(result, patch, camera)
    except Exception as error:
        return Failure(Reason.ESTIMATOR_ERROR, f"{type(error).__name__}: {error}")


def run_each(
    estimator: Estimator, patches: Sequence[Patch | Failure], camera: Camera, priors: Priors = NO_PRIORS
) -> list[Estimate | Failure]:
    """Run an estimator on several patches: all at once where it has a way of its own (`each`), else one by one.

    See `run` for the parameters and what is given of each patch. Where the estimator's own way raises, or loses count,
    each patch is run alone, so that one of them spoils no other.
    """
    each: BatchEstimator | None = getattr(estimator, "each", None)
    if each is not None and len(patches) > 1:
        try:
            results = each(patches, camera)
            return [
                patch if isinstance(patch, Failure) else _checked(result, patch, camera)
                for patch, result in zip(patches, results, strict=True)
            ]
        except Exception:
            pass
    return [run(estimator, patch, camera, priors) for patch in patches]


def one_by_one(estimator: Estimator, priors: Priors = NO_PRIORS) -> BatchEstimator:
    """Give an estimator that takes several patches, each run as by `run`."""
    return lambda patches, camera: [run(estimator, patch, camera, priors) for patch in patches]


def _checked(result: object, patch: Patch, camera: Camera) -> Estimate | Failure:
    """Give what an estimator gave, or a Failure where that is not what `Estimate` describes."""
    if isinstance(result, Failure):
        return result
    if not isinstance(result, Estimate):
        return Failure(Reason.ESTIMATOR_ERROR, f"gave a {type(result).__name__}; must be an Estimate or a Failure")
    return _problem(result, patch, camera) or result


def _asks(estimator: Estimator) -> bool:
    """Tell whether an estimator has a parameter `known`; one whose parameters cannot be told has none."""
    try:
        return "priors" in inspect.signature(estimator).parameters
    except (TypeError, ValueError):
        return False


def _problem(estimate: Estimate, patch: Patch, camera: Camera) -> Failure | None:
    """Tell what is wrong with an estimate, or None."""
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
        if name != "look_px" and not np.isfinite(value).all():
            return Failure(Reason.NOT_FINITE, f"{name} holds NaN or infinity")
    for name, number in (("axis_ratio", estimate.axis_ratio), ("choice_margin", estimate.choice_margin)):
        if number is not None and not np.isfinite(number):
            return Failure(Reason.NOT_FINITE, f"{name} is {number}")
    if estimate.region is not None and not np.isfinite(estimate.region.statistic(estimate.candidates)).all():
        return Failure(Reason.NOT_FINITE, "region: the statistic of a candidate is not finite")
    lengths = np.linalg.norm(np.concatenate([estimate.normal[None], estimate.candidates]), axis=1)
    if np.abs(lengths - 1).max() > UNIT_TOLERANCE:
        return Failure(Reason.ESTIMATOR_ERROR, f"normal or candidate of length {lengths.max():g}: must be unit vectors")
    if np.abs(estimate.candidates[0] - estimate.normal).max() > UNIT_TOLERANCE:
        return Failure(Reason.ESTIMATOR_ERROR, "the first candidate must be the proposed normal")
    if not isinstance(estimate.flags, tuple) or not all(isinstance(flag, str) for flag in estimate.flags):
        return Failure(Reason.ESTIMATOR_ERROR, "flags: must be a tuple of text")
    look = estimate.look_px if np.isfinite(estimate.look_px).all() else patch.peak_px
    if estimate.normal @ camera.unproject(look) >= 0:
        return Failure(Reason.ESTIMATOR_ERROR, "the normal faces away from the camera")
    return None
