"""From a picture, film or array to normals and what is written of them; never sees the truth.

image_io reads. pipeline leads from values to normals, through linear_light, detectors and the estimators. description
makes records of them, which output_files, overlay, constraints and result_page write. picture does all this for one
picture, sequence for a folder or a video, with tracking.
"""

from simtest.reconstruction.detectors import detect_in_picture
from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, Specularity, reconstruct, reconstruct_colour

__all__ = ["DEFAULT_ESTIMATORS", "Specularity", "detect_in_picture", "reconstruct", "reconstruct_colour"]
