"""From a picture, film or array to normals and what is written of them; never sees the truth.

image_io reads; choices says how a picture is taken where nobody tells it. pipeline leads from values to normals: linear
light, a detector, the estimators. description makes records of them, which output_files, overlay, constraints and
result_page write. picture does all this for one picture, sequence for a folder or a video, with tracking.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.reconstruction.picture_detection import detect_in_picture
    from simtest.reconstruction.pipeline import (
        DEFAULT_ESTIMATORS,
        Specularities,
        Specularity,
        reconstruct,
        reconstruct_colour,
    )

__getattr__, __dir__, __all__ = lazy_names(__name__)
