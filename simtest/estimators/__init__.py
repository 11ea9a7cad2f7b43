"""Estimators of the surface normal at a highlight; they see a frame and its calibration, never the truth."""

from simtest.estimators.protocol import Estimate, EstimatedCurvature, Estimator, FittedIsophote
from simtest.estimators.registry import available, load_estimators

__all__ = ["Estimate", "EstimatedCurvature", "Estimator", "FittedIsophote", "available", "load_estimators"]
