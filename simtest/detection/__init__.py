"""Where the isolated specularities are in a frame; decided from the frame alone."""

from simtest.detection.noise import estimate_noise
from simtest.detection.regions import Component, Region, contrast, detect, half_height_component

__all__ = ["Component", "Region", "contrast", "detect", "estimate_noise", "half_height_component"]
