"""From a picture, film or array to normals and what is written of them; never sees the truth."""

from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, Specularity, reconstruct

__all__ = ["DEFAULT_ESTIMATORS", "Specularity", "reconstruct"]
