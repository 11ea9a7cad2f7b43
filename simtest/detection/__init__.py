"""Where the isolated specularities are in a frame; decided from the frame alone."""

from simtest.detection.noise import estimate_noise
from simtest.detection.regions import Component, Region, contrast, detect, half_height_component
from simtest.detection.shape import PeakShape, flat_pixels, peak_shape

__all__ = [
    "Component",
    "PeakShape",
    "Region",
    "contrast",
    "detect",
    "estimate_noise",
    "flat_pixels",
    "half_height_component",
    "peak_shape",
]
