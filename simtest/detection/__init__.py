"""Detection of isolated specularities, from the frame alone.

`detector` declares what a detector is and finds it by name. Two are built in: `peaks` takes peaks of the mean of the
channels; `colour` goes by the tissue's colour, with the `spots` of specular light, which `classify` judges. `view`
finds what of a picture shows tissue.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.calibration import estimate_noise
    from simtest.detection.detector import Detection, Detector, Region, load_detector
    from simtest.detection.peaks import (
        Component,
        PeakShape,
        contrast,
        detect,
        flat_pixels,
        half_height_component,
        peak_shape,
    )

__getattr__, __dir__, __all__ = lazy_names(__name__)
