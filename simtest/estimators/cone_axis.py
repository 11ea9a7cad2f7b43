"""`cone_axis`: the axis of the isophotes' back-projected cones carries the normal (theory.md section 3, item 4)."""

from dataclasses import dataclass
from typing import ClassVar

from simtest.calibration import Priors
from simtest.estimators.highlight import OfHighlight, along
from simtest.estimators.protocol import Estimate, Law
from simtest.estimators.small_spots import HighlightAxis


@dataclass(frozen=True)
class ConeAxis(OfHighlight):
    """The mean of the cones' axes over several isovalues (see `OfHighlight`).

    The estimate has one candidate and looks along the axis. Its covariance is that of the noise and, where the axis
    drifts with the isovalue by more than noise, of the drift.
    """

    laws: ClassVar[tuple[Law, ...]] = ("sightline", "axis_ratio_seen")

    def of(self, highlight: HighlightAxis, priors: Priors) -> Estimate:
        """Estimate the normal at a fitted highlight."""
        return along(highlight, highlight.axis, highlight.axis_budget, priors)


cone_axis = ConeAxis()
