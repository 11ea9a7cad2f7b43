"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators.budget import Budget
from simtest.estimators.family import OF_MEAN, AxisErrors, IsophoteFamily, fit_isophote_family
from simtest.estimators.highlight import Fitted, OfHighlight, fit_highlight, look_at_peak, of_spot
from simtest.estimators.prior_parts import add_untold_parts
from simtest.estimators.protocol import Estimate, Law
from simtest.estimators.small_spots import SmallSpot
from simtest.geometry import Camera, Patch
from simtest.runtime.fitted import fitted_number

OF_APEX = AxisErrors(fitted_number("ripples.brightest"), OF_MEAN.bends, fitted_number("ripples.brightest_px2"))
GAP_SHARE = fitted_number("ripples.brightest_gap")

TOP_ISOVALUE = 0.9  # where the border cuts even the isophote at this value, it may cut off the peak


@dataclass(frozen=True)
class BrightestPoint(OfHighlight):
    """The reversed sightline through the peak of the smoothed patch (see `OfHighlight`).

    The estimate has one candidate and looks at the peak, of a small highlight at its fitted centre. It has the flags of
    `cone_axis` for the isophote at t = 0.5; along a streak the peak may lie anywhere. Where the border of the region,
    the frame or the view cuts that isophote, the highlight's peak may be outside: the result is a Failure where no arcs
    can be fitted either, or where the cut reaches up to `TOP_ISOVALUE`. The budget follows from the isophotes; without
    any, no uncertainty is stated.
    """

    laws: ClassVar[tuple[Law, ...]] = ("sightline",)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`)."""
        whole = look_at_peak(fit_highlight(patch, camera, self.isovalues), priors)
        if isinstance(whole, SmallSpot):
            return of_spot(whole, priors)
        if (cut := _cut_off(patch, whole)) is not None:
            return cut
        normal, family = -camera.unproject(patch.peak_px), None if isinstance(whole, Failure) else whole
        budget = None if family is None else budget_of_peak(family)
        estimate = Estimate(normal, normal[None], patch.peak_px, flags=_flags(patch, camera, family), budget=budget)
        return add_untold_parts(estimate, camera, priors, family)


def _cut_off(patch: Patch, family: Fitted) -> Failure | None:
    """Return a Failure where the peak may lie outside what the picture shows of the highlight."""
    top = HIGHLIGHT_ISOVALUE if isinstance(family, Failure) else TOP_ISOVALUE
    # Level sets are nested: where the lower one is closed, so is the upper one, and the lower one is known already.
    if patch.area_px(HIGHLIGHT_ISOVALUE) is not None or patch.area_px(top) is not None:
        return None
    return Failure(Reason.NO_CLOSED_ISOPHOTE, f"none around the peak at t = {top:g}: the border may cut it off")


def _flags(patch: Patch, camera: Camera, family: IsophoteFamily | None) -> tuple[str, ...]:
    # The isophote is one of those that the other estimators use.
    if family is not None and (flags := family.flags_at(HIGHLIGHT_ISOVALUE)) is not None:
        return flags
    alone = fit_isophote_family(patch, camera, (HIGHLIGHT_ISOVALUE,))
    if isinstance(alone, Failure):
        return ("partial_arc",) if alone.reason == Reason.NO_CLOSED_ISOPHOTE else ()
    return alone.flags


def budget_of_peak(family: IsophoteFamily) -> Budget | None:
    """Return the budget of the peak in the family's basis, which differs from the peak's by a few degrees at most."""
    if family.axes_covariance is None:
        return None
    return family.budget(family.peak_noise, OF_APEX, GAP_SHARE * np.outer(family.gap, family.gap))


brightest_point = BrightestPoint()
