"""Estimators of the surface normal at a highlight; they see a frame and its calibration, never the truth.

`protocol` declares what an estimator is and returns, `registry` finds it by name, `dispatch` runs it. Each estimator is
a file of its name: `cone_axis`, `brightest_point`, `circle_pose`, `curved`, `bisector`, `photometric`, `cloud`, and the
networks `learned_spot` and `learned_dense`. Those of single highlights share `isophote_fit` (ellipses) and
`isophote_family` (the isophotes of one highlight together, extrapolated to its peak).
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.estimators.isophote_fit import FittedIsophote
    from simtest.estimators.protocol import (
        AnyEstimator,
        BatchEstimator,
        Estimate,
        EstimatedCurvature,
        Estimator,
        FrameEstimator,
    )
    from simtest.estimators.registry import load_estimators

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
