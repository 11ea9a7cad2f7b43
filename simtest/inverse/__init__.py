"""The estimator that differentiates the renderer; no other estimator may import it."""

from simtest.inverse.estimator import inverse_rendering

__all__ = ["inverse_rendering"]
