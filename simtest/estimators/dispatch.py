"""Run estimators on the highlights of a frame so that whatever they do is an `Estimate` or a `Failure`."""

import contextlib
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeGuard

import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import (
    AnyEstimator,
    BatchEstimator,
    Estimate,
    Estimator,
    FrameEstimator,
    PreparedEstimator,
    RegionEstimator,
    check,
)
from simtest.geometry import Array, Camera, Patch

_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class FrameResults:
    """The results of one estimator: of each patch, and estimates of a frame, sound or refused, that no patch takes.

    A patch has None from an estimator whose estimates are of clouds of highlights, and where a table has no row.
    """

    of_patches: Sequence[Estimate | Failure | None]
    elsewhere: list[Estimate] = field(default_factory=list)
    refused: list[Failure] = field(default_factory=list)


def run(estimator: Estimator, patch: Patch | Failure, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
    """Run an estimator on a patch; a patch that is a Failure is passed on.

    What the estimator raises is a Failure ``estimator_error``: one highlight must not end a run of thousands. So is
    what it returns in another form than `Estimate` describes (`simtest.estimators.protocol`).
    """
    if isinstance(patch, Failure):
        return patch
    try:
        return check(estimator.estimate(patch, camera, priors), camera)
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
    # A protocol's isinstance is slow.
    if len(sound) > 1 and isinstance(estimator, BatchEstimator):
        results = _batch(estimator, sound, camera, priors)
    if results is None:
        results = [run(estimator, patch, camera, priors) for patch in sound]
    following = iter(results)  # failures keep their positions among the patches
    return [patch if isinstance(patch, Failure) else next(following) for patch in patches]


def prepare(estimators: Sequence[AnyEstimator], patches: Sequence[Patch | Failure], camera: Camera) -> None:
    """Let estimators fit what they share to several patches at once (`PreparedEstimator`)."""
    sound = [patch for patch in patches if not isinstance(patch, Failure)]
    for estimator in estimators:
        if len(sound) > 1 and isinstance(estimator, PreparedEstimator):
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
        return [check(result, camera) for result in results]
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
    peak first, one a patch. A malformed one is a Failure there. Where it looks at no patch, a warning says so, and it
    is the Failure of the patches without any; else that is ``no_estimate``. Estimates of clouds are of no single
    highlight, so they go to no patch, and patches get none from an estimator that states clouds alone. Where an
    estimator raises, every patch gets that Failure.
    """
    camera = frame.calibration.camera
    if isinstance(estimator, Estimator) and not isinstance(estimator, FrameEstimator | RegionEstimator):
        return FrameResults(run_each(estimator, patches, camera, priors))
    try:
        if isinstance(estimator, RegionEstimator):
            made = _of_regions(*estimator.estimate_regions(frame, patches), patches, camera)
        else:
            made = _of_frame(estimator.estimate_frame(frame, camera, priors), patches, camera)
    except Exception as error:
        # A package that a network lacks is the user's to install, and no fault of a highlight.
        if isinstance(error, InputError) and isinstance(estimator, RegionEstimator):
            raise
        made = _of_frame(_estimator_error(error), patches, camera)
    if made.refused and made.refused[0] not in made.of_patches:
        what = f"{type(estimator).__qualname__}: {len(made.refused)} malformed at no highlight"
        warnings.warn(f"{what}: {made.refused[0].detail}", RuntimeWarning, stacklevel=2)
    return made


def _of_regions(
    results: Sequence[object], elsewhere: Sequence[object], patches: Sequence[Patch | Failure], camera: Camera
) -> FrameResults:
    """Check what a `RegionEstimator` returned."""
    if len(results) != len(patches):
        raise ValueError(f"{len(results)} results for {len(patches)} regions")
    others = [check(each, camera) for each in elsewhere]
    return FrameResults(
        [None if each is None else check(each, camera) for each in results],
        [each for each in others if isinstance(each, Estimate)],
        [each for each in others if isinstance(each, Failure)],
    )


def _of_frame(returned: Sequence[object] | Failure, patches: Sequence[Patch | Failure], camera: Camera) -> FrameResults:
    """Check the estimates of a frame and assign them to its patches."""
    if isinstance(returned, Failure):
        return FrameResults([patch if isinstance(patch, Failure) else returned for patch in patches])
    numbered = [(given, check(given, camera)) for given in returned]
    results = [
        Failure(result.reason, f"estimate {number}: {result.detail}") if isinstance(result, Failure) else result
        for number, (_, result) in enumerate(numbered)
    ]
    of_clouds = [i for i, (given, _) in enumerate(numbered) if isinstance(given, Estimate) and given.cloud is not None]
    if of_clouds and len(of_clouds) == len(results):
        of_patches: list[Estimate | Failure | None] = [None] * len(patches)
        left = results
    else:
        # to patches, by the pixel that each looks at
        looks = {i: given.look_px for i, (given, _) in enumerate(numbered) if i not in of_clouds and _looks(given)}
        indices = list(looks)
        taken = {p: indices[e] for p, e in assign(list(looks.values()), patches).items()}
        left = [result for i, result in enumerate(results) if i not in taken.values()]
        refused = (each for each in left if isinstance(each, Failure))
        missing = next(refused, Failure(Reason.NO_ESTIMATE, "the estimator has none in this region"))
        of_patches = [
            results[taken[p]] if p in taken else patch if isinstance(patch, Failure) else missing
            for p, patch in enumerate(patches)
        ]
    return FrameResults(
        of_patches,
        sorted((each for each in left if isinstance(each, Estimate)), key=lambda each: each.cloud is not None),
        [each for each in left if isinstance(each, Failure)],
    )


def _looks(given: object) -> TypeGuard[Estimate]:
    """Whether a result, sound or malformed, says which pixel it looks at."""
    return isinstance(given, Estimate) and isinstance(given.look_px, np.ndarray) and given.look_px.shape == (2,)


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
    # The first entry is the call in this file.
    steps = traceback.extract_tb(error.__traceback__)[1:]
    foreign = [step.filename for step in steps if not Path(step.filename).is_relative_to(_PACKAGE)]
    file = foreign[0] if foreign else steps[0].filename if steps else None
    own = [step for step in steps if step.filename == file]
    return f" ({Path(own[-1].filename).name}:{own[-1].lineno})" if own else ""
