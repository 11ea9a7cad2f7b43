"""Detection of isolated specularities, from the frame alone.

`detector` declares what a detector is and finds it by name. Two are built in: `peaks` (with `regions` and `shape`)
takes peaks of the mean of the channels; `colour` (with `light_split`, `blobs` and `view_mask`) goes by the tissue's
colour.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.calibration import estimate_noise
    from simtest.detection.detector import Detection, Detector, load_detector
    from simtest.detection.regions import Component, Region, contrast, detect, half_height_component
    from simtest.detection.shape import PeakShape, flat_pixels, peak_shape

__all__ = [
    "Component",
    "Detection",
    "Detector",
    "PeakShape",
    "Region",
    "contrast",
    "detect",
    "estimate_noise",
    "flat_pixels",
    "half_height_component",
    "load_detector",
    "peak_shape",
]

__getattr__, __dir__, _ = lazy_names(__name__)
