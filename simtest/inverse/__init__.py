"""The estimator that differentiates the renderer; no other estimator may import it.

`estimator` fits a `rendered_quadric`, whose radiance and derivatives come from `patch_renderer`.
"""

from simtest.inverse.estimator import InverseRendering, inverse_rendering

__all__ = ["InverseRendering", "inverse_rendering"]
