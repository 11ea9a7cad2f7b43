"""Estimators of the surface normal at a highlight; they see a frame and its calibration, never the truth.

`protocol` declares what an estimator is and returns, `names` finds it, `dispatch` runs it. Each estimator is a file of
its name. Those of single highlights share what `highlight` fits: ellipses (`isophotes`), these together, extrapolated
to the peak (`family`), or the centre of a spot of a few pixels (`small_spots`).
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.estimators.isophotes import FittedIsophote
    from simtest.estimators.names import load_estimators
    from simtest.estimators.protocol import (
        AnyEstimator,
        BatchEstimator,
        Estimate,
        EstimatedCurvature,
        Estimator,
        FrameEstimator,
    )

__all__ = [
    "AnyEstimator",
    "BatchEstimator",
    "Estimate",
    "EstimatedCurvature",
    "Estimator",
    "FittedIsophote",
    "FrameEstimator",
    "load_estimators",
]

__getattr__, __dir__, _ = lazy_names(__name__)
