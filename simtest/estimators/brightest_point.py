"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES, HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators.family_fit import fit_isophote_family
from simtest.estimators.highlight_fit import fit_highlight, fit_highlights, fit_small
from simtest.estimators.isophote_family import IsophoteFamily
from simtest.estimators.prior_parts import add_untold_parts
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


@dataclass(frozen=True)
class BrightestPoint:
    """The reversed sightline through the peak of the smoothed patch.

    What the priors leave open is added to the budget (`simtest.estimators.prior_parts`).
    """

    def prepare(self, patches: Sequence[Patch], camera: Camera) -> None:
        """Fit the isophotes of several highlights at once (see `simtest.estimators.protocol.PreparedEstimator`)."""
        fit_highlights(patches, camera, CONE_AXIS_ISOVALUES)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate:
        """Estimate the normal (see `simtest.estimators.Estimator`).

        The estimate has one candidate and looks at the peak. It has the flags of `cone_axis` for the isophote at
        t = 0.5: where that runs into the border the peak itself may be cut off, and along a streak it may lie anywhere.
        In a highlight too small for isophotes it looks at the fitted centre instead, flagged ``unresolved``.
        """
        if (spot := fit_small([patch], camera)[0]) is not None:
            return add_untold_parts(spot.estimate(), camera, priors, spot)
        normal = -camera.unproject(patch.peak_px)
        family = _half_height(patch, camera)
        estimate = Estimate(normal, normal[None], patch.peak_px, flags=_flags(family))
        return add_untold_parts(estimate, camera, priors, None if isinstance(family, Failure) else family)


def _half_height(patch: Patch, camera: Camera) -> IsophoteFamily | Failure:
    """Return the isophote at t = 0.5, which is one of those that the other estimators use."""
    whole = fit_highlight(patch, camera, CONE_AXIS_ISOVALUES)
    own = whole.at(HIGHLIGHT_ISOVALUE) if isinstance(whole, IsophoteFamily) else None
    return own or fit_isophote_family(patch, camera, (HIGHLIGHT_ISOVALUE,))


def _flags(family: IsophoteFamily | Failure) -> tuple[str, ...]:
    if isinstance(family, Failure):
        return ("partial_arc",) if family.reason == Reason.NO_CLOSED_ISOPHOTE else ()
    return family.flags


brightest_point = BrightestPoint()
