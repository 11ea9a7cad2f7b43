"""What the estimators share of a highlight: its isophotes or, where it is small, its centre; each fitted once."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget
from simtest.estimators.family import IsophoteFamily, fit_isophote_families
from simtest.estimators.isophotes import FittedIsophote, fit_isophote_of_each
from simtest.estimators.prior_parts import add_untold_parts, facing
from simtest.estimators.protocol import Estimate
from simtest.estimators.small_spots import HighlightAxis, SmallSpot, fit_small_spots, is_small
from simtest.geometry import Array, Camera, Patch
from simtest.runtime.fitted import fitted_number

Fitted = HighlightAxis | Failure

BY_GAP, BY_SIZE = fitted_number("off_peak.by_gap"), fitted_number("off_peak.by_size")


@dataclass(frozen=True)
class OfHighlight:
    """What the estimators of single highlights share: the highlight is fitted, and what the method makes of it is `of`.

    Isovalues without a closed isophote are left out and flagged ``missing_isovalues``; with fewer than 2 left it fails
    for the first one's reason. A highlight too small for isophotes (`simtest.estimators.small_spots`) has its centre
    alone, and neither axis ratio nor curvature: flag ``unresolved``. What the priors leave open is added to the budget
    (`simtest.estimators.prior_parts`).

    Parameters
    ----------
    isovalues : tuple of float
        Each t in (0, 1).
    """

    isovalues: tuple[float, ...] = CONE_AXIS_ISOVALUES

    def prepare(self, patches: Sequence[Patch], camera: Camera) -> None:
        """Fit several highlights at once (see `simtest.estimators.protocol.PreparedEstimator`)."""
        fit_highlights(patches, camera, self.isovalues)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`)."""
        highlight = look_at_peak(fit_highlight(patch, camera, self.isovalues), priors)
        return highlight if isinstance(highlight, Failure) else self.of(highlight, priors)

    def of(self, highlight: HighlightAxis, priors: Priors) -> Estimate | Failure:
        """Estimate the normal at a fitted highlight."""
        raise NotImplementedError


def along(highlight: HighlightAxis, axis: Array, budget: Budget | None, priors: Priors, **more: Any) -> Estimate:
    """State a reversed axis of a highlight with its isophotes and what the priors leave open (`add_untold_parts`)."""
    camera = highlight.camera
    seen = {"axis_ratio": highlight.axis_ratio, "isophotes": highlight.isophotes, "flags": highlight.flags}
    stated = {"look_px": camera.project(axis), **seen, **more}
    return add_untold_parts(Estimate(-axis, -axis[None], budget=budget, **stated), camera, priors, highlight)


def of_spot(spot: SmallSpot, priors: Priors) -> Estimate:
    """State the reversed sightline of a spot's centre."""
    return along(spot, spot.axis, spot.axis_budget, priors, look_px=spot.centre_px)


def fit_highlight(patch: Patch, camera: Camera, isovalues: Sequence[float]) -> Fitted:
    """Fit a highlight's isophotes, or its centre where it is small (see `fit_highlights`)."""
    return fit_highlights([patch], camera, isovalues)[0]


def fit_highlights(patches: Sequence[Patch], camera: Camera, isovalues: Sequence[float]) -> list[Fitted]:
    """Fit each highlight: its centre where it is small (`is_small`), else its isophotes (`fit_isophote_families`).

    What was fitted is kept with the patch, for the next estimator that asks.
    """
    small, name = fit_small(patches, camera), tuple(isovalues)
    pending = [
        patch
        for patch, spot in zip(patches, small, strict=True)
        if spot is None and _recall(patch, name, camera) is _NOTHING
    ]
    for patch, family in zip(pending, fit_isophote_families(pending, camera, isovalues), strict=True):
        _keep(patch, name, camera, family)
    fitted = (_recall(patch, name, camera) for patch in patches)
    return [spot or cast(IsophoteFamily | Failure, found) for found, spot in zip(fitted, small, strict=True)]


def look_at_peak(family: Fitted, priors: Priors) -> Fitted:
    """Return a family of isophotes that lead to their peak; else the peak itself, or a Failure where they are cut.

    Isophotes that follow the shading of a body carry no normal. At the peak the normal may still be off by several
    times the angle by which they miss it, since on a body of radius R it turns d/R times as fast as the sightline.
    What shines there may also be the shading's maximum, which faces a given light instead of bisecting.
    """
    share = priors.open.off_peak
    if not share > 0 or not isinstance(family, IsophoteFamily) or family.off_peak(share) <= 1:
        return family
    patch, camera = family.patch, family.camera
    gap_px = float(np.hypot(*(camera.project(family.peak_axis) - patch.peak_px)))
    if any(isophote.cut for isophote in family.isophotes):
        detail = f"the isophotes lead {gap_px:.1f} px off the peak, as those of shading do, and the border cuts them"
        return Failure(Reason.NO_ESTIMATE, detail)
    to_px = np.linalg.inv(family.basis @ camera.step_of_pixels(patch.peak_px).T)
    size, noise = (to_px @ each @ to_px.T for each in (family.seen_moments, family.peak_noise))
    # The shading moves the peak too, the more the broader the highlight is.
    facing2 = facing(camera.unproject(patch.peak_px), priors) ** 2
    pixel2 = float(np.sqrt(np.linalg.det(family.px2)))
    shape = ((BY_GAP * gap_px) ** 2 + facing2 / 2 / pixel2) * np.eye(2) + BY_SIZE**2 * size
    return SmallSpot(patch, camera, patch.peak_px, size, noise, shape, flags=("off_peak",))


def isophote_of_each(
    patches: Sequence[Patch | Failure], camera: Camera, isovalue: float
) -> list[FittedIsophote | Failure]:
    """Fit the isophote at the same value of several patches, unless one was fitted with the others of its family."""
    known = [None if isinstance(patch, Failure) else _kept_isophote(patch, camera, isovalue) for patch in patches]
    pending = [patch for patch, isophote in zip(patches, known, strict=True) if isophote is None]
    fitted = iter(fit_isophote_of_each(pending, camera, isovalue))
    return [next(fitted) if isophote is None else isophote for isophote in known]


def _kept_isophote(patch: Patch, camera: Camera, isovalue: float) -> FittedIsophote | None:
    family = _recall(patch, CONE_AXIS_ISOVALUES, camera)
    if not isinstance(family, IsophoteFamily):
        return None
    whole = (isophote for isophote in family.isophotes if not isophote.cut)
    return next((isophote for isophote in whole if isophote.isovalue == isovalue), None)


def fit_small(patches: Sequence[Patch], camera: Camera) -> list[SmallSpot | None]:
    """Fit the centres of the small highlights among some, all at once; None for the others."""
    pending = [patch for patch in patches if _recall(patch, "small", camera) is _NOTHING]
    small = [patch for patch in pending if is_small(patch)]
    for patch in pending:
        _keep(patch, "small", camera, None)
    for patch, spot in zip(small, fit_small_spots(small, camera), strict=True):
        _keep(patch, "small", camera, spot)
    found = [_recall(patch, "small", camera) for patch in patches]
    return [spot if isinstance(spot, SmallSpot) else None for spot in found]


_NOTHING = object()


def _recall(patch: Patch, name: Hashable, camera: Camera) -> object:
    """Return what was kept under a name for this camera, or `_NOTHING`."""
    of, what = patch.kept.get(name, (None, _NOTHING))
    return what if of is camera else _NOTHING


def _keep(patch: Patch, name: Hashable, camera: Camera, what: object) -> None:
    patch.kept[name] = (camera, what)
