"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES, HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators.highlight_fit import fit_highlight, fit_highlights, fit_small
from simtest.estimators.isophote_family import IsophoteFamily
from simtest.estimators.light_offset import add_light_offset_uncertainty
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


@dataclass(frozen=True)
class BrightestPoint:
    """The reversed sightline through the peak of the smoothed patch.

    Of the priors, the lights inflate the covariance (`simtest.estimators.light_offset`).
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
            return add_light_offset_uncertainty(spot.estimate(), priors)
        normal = -camera.unproject(patch.peak_px)
        estimate = Estimate(normal, normal[None], patch.peak_px, flags=_flags(patch, camera))
        return add_light_offset_uncertainty(estimate, priors)


def _flags(patch: Patch, camera: Camera) -> tuple[str, ...]:
    # The isophote is one of those that the other estimators use.
    whole = fit_highlight(patch, camera, CONE_AXIS_ISOVALUES)
    if isinstance(whole, IsophoteFamily) and (own := whole.at(HIGHLIGHT_ISOVALUE)) is not None:
        return own.flags
    family = fit_highlight(patch, camera, (HIGHLIGHT_ISOVALUE,))
    if isinstance(family, Failure):
        return ("partial_arc",) if family.reason == Reason.NO_CLOSED_ISOPHOTE else ()
    return family.flags


brightest_point = BrightestPoint()
