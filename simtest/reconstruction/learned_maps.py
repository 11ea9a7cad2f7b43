"""The maps of `learned_dense` of a picture: in its view alone, and checked at the highlights that it shows."""

import numpy as np

from simtest.calibration import Calibration, Frame
from simtest.detection.detector import Detector, load_detector, run_detector
from simtest.detection.view import find_view
from simtest.errors import Failure
from simtest.estimators.learned_dense import DenseMaps, LearnedDense, learned_dense
from simtest.reconstruction.options import complete
from simtest.runtime.arrays import Image

SMOOTHING_PX = 1.0
"""Of the detection, as in the dataset that the shipped network learned from."""


def learned_maps(
    picture: Image, calibration: Calibration, network: LearnedDense = learned_dense, detector: str | Detector = "colour"
) -> DenseMaps | Failure:
    """Compute normals and distances all over a picture, or say why there are none.

    The view's border is found in the picture where the camera has no view mask; what lies outside has no normal. A
    picture whose normals contradict the law of reflection at four or more detected highlights is refused.

    Parameters
    ----------
    picture : ndarray of float32, shape (H, W, 3)
        Values as encoded, in [0, 1].
    calibration : Calibration
        Camera, lights, response and falloff; without a response sRGB.
    network : LearnedDense
        Default: the shipped one.
    detector : str or Detector
        Finds the highlights.
    """
    seen = find_view(picture).seen if calibration.camera.seen is None else calibration.camera.seen
    known = complete(calibration, None)
    finder = load_detector(detector) if isinstance(detector, str) else detector
    found = run_detector(finder, Frame(picture, known, SMOOTHING_PX, seen))
    patches = [found.frame.patch(region.box, region.peak) for region in found.regions]
    peaks = [patch.peak_px for patch in patches if not isinstance(patch, Failure)]
    return network.maps(picture, known, np.array(peaks, dtype=float).reshape(-1, 2), seen)
