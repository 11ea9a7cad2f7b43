"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from dataclasses import dataclass

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators.isophote_family import IsophoteFamily, fit_isophote_family
from simtest.estimators.prior_parts import add_untold_parts
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


@dataclass(frozen=True)
class BrightestPoint:
    """The reversed sightline through the peak of the smoothed patch.

    What the priors leave open is added to the budget (`simtest.estimators.prior_parts`).
    """

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate:
        """Estimate the normal (see `simtest.estimators.Estimator`).

        The estimate has one candidate and looks at the peak. It has the flags of `cone_axis` for the isophote at
        t = 0.5: where that runs into the border the peak itself may be cut off, and along a streak it may lie anywhere.
        """
        normal = -camera.unproject(patch.peak_px)
        family = fit_isophote_family(patch, camera, (HIGHLIGHT_ISOVALUE,))
        estimate = Estimate(normal, normal[None], patch.peak_px, flags=_flags(family))
        return add_untold_parts(estimate, camera, priors, None if isinstance(family, Failure) else family)


def _flags(family: IsophoteFamily | Failure) -> tuple[str, ...]:
    if isinstance(family, Failure):
        return ("partial_arc",) if family.reason == Reason.NO_CLOSED_ISOPHOTE else ()
    return family.flags


brightest_point = BrightestPoint()
