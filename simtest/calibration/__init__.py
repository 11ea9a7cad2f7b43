"""What is known of a camera beside its geometry, and how a frame is undone with it."""

from typing import Any

from simtest.calibration.calibration import Calibration, CorrectedFrame
from simtest.calibration.noise_model import NoiseModel
from simtest.calibration.priors import NO_PRIORS, Priors
from simtest.calibration.response import Response, srgb_decode, srgb_encode

__all__ = [
    "NO_PRIORS",
    "Calibration",
    "CorrectedFrame",
    "NoiseModel",
    "Priors",
    "Response",
    "srgb_decode",
    "srgb_encode",
]


def __getattr__(name: str) -> Any:
    from simtest._renamed import lookup

    return lookup(__name__, name)
