"""What is known of a camera beside its geometry, and how a frame is undone with it."""

from simtest.calibration.calibration import Calibration, CorrectedFrame
from simtest.calibration.noise_model import NoiseModel
from simtest.calibration.priors import Known
from simtest.calibration.response import Response, srgb_decode, srgb_encode

__all__ = ["Calibration", "CorrectedFrame", "Known", "NoiseModel", "Response", "srgb_decode", "srgb_encode"]
