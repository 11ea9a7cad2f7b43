"""`inverse_rendering`: a quadric patch fitted by differentiating the renderer, as a reference for the others.

No other estimator may import it. `estimator` fits a quadric, whose radiance and derivatives come from `patch`.
"""

from simtest.inverse.estimator import InverseRendering, inverse_rendering

__all__ = ["InverseRendering", "inverse_rendering"]
