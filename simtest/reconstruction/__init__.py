"""From a picture, film or array to normals and what is written of them; never sees the truth.

images reads; options says how a picture is taken, and what is chosen where nobody says it. pipeline leads from values
to normals: linear light, a detector, the estimators. records holds what it made, which outputs, overlay and page write.
sequence does all this for a folder or a video, with tracking.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.reconstruction.options import DEFAULT_ESTIMATORS
    from simtest.reconstruction.pipeline import detect_in_picture, reconstruct
    from simtest.reconstruction.records import Specularities, Specularity

__getattr__, __dir__, __all__ = lazy_names(__name__)
