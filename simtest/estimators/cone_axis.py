"""`cone_axis`: the axis of the isophotes' back-projected cones carries the normal (theory.md section 3, item 4)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure
from simtest.estimators.highlight import fit_highlight, fit_highlights
from simtest.estimators.prior_parts import add_untold_parts
from simtest.estimators.protocol import Estimate, Law
from simtest.geometry import Camera, Patch


@dataclass(frozen=True)
class ConeAxis:
    """The mean of the cones' axes over several isovalues.

    What the priors leave open is added to the budget (`simtest.estimators.prior_parts`).

    Parameters
    ----------
    isovalues : tuple of float
        Each t in (0, 1).
    """

    isovalues: tuple[float, ...] = CONE_AXIS_ISOVALUES
    laws: ClassVar[tuple[Law, ...]] = ("sightline", "axis_ratio_seen")

    def prepare(self, patches: Sequence[Patch], camera: Camera) -> None:
        """Fit several highlights at once (see `simtest.estimators.protocol.PreparedEstimator`)."""
        fit_highlights(patches, camera, self.isovalues)

    def estimate(self, patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
        """Estimate the normal (see `simtest.estimators.Estimator`).

        The estimate has one candidate and looks along the axis. Isovalues without a closed isophote are left out and
        flagged ``missing_isovalues``; with fewer than 2 left it fails for the first one's reason. The covariance is
        that of the noise and, where the axis drifts with the isovalue by more than noise, of the drift. A highlight
        too small for isophotes gets the normal of its centre, without axis ratio, flagged ``unresolved``
        (`simtest.estimators.small_spots`).
        """
        family = fit_highlight(patch, camera, self.isovalues)
        if isinstance(family, Failure):
            return family
        estimate = Estimate(
            normal=-family.axis,
            candidates=-family.axis[None],
            look_px=camera.project(family.axis),
            axis_ratio=family.axis_ratio,
            isophotes=family.isophotes,
            budget=family.axis_budget,
            flags=family.flags,
        )
        return add_untold_parts(estimate, camera, priors, family)


cone_axis = ConeAxis()
