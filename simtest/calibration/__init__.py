"""What is known of a camera beside its geometry, and beside a picture: response, falloff, noise, priors.

`calibration` undoes response and falloff; `frame` is a frame on that way, as detectors and estimators see it; `priors`
holds what is known of lights, distance, lobe, camera and relief, and what is assumed where nobody told
(`distributions`).
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.calibration.calibration import Calibration, CorrectedFrame
    from simtest.calibration.distributions import Distribution, LogUniform, Normal, Uniform, exactly
    from simtest.calibration.frame import Frame
    from simtest.calibration.noise_estimate import estimate_noise
    from simtest.calibration.noise_model import NoiseModel
    from simtest.calibration.priors import LIGHT_AT_CAMERA, NO_PRIORS, CameraPrior, Priors
    from simtest.calibration.response import Response, srgb_decode, srgb_encode

_HOMES = {
    "simtest.calibration.calibration": (
        "Calibration",
        "CorrectedFrame",
    ),
    "simtest.calibration.distributions": (
        "Distribution",
        "LogUniform",
        "Normal",
        "Uniform",
        "exactly",
    ),
    "simtest.calibration.frame": ("Frame",),
    "simtest.calibration.noise_estimate": ("estimate_noise",),
    "simtest.calibration.noise_model": ("NoiseModel",),
    "simtest.calibration.priors": (
        "LIGHT_AT_CAMERA",
        "NO_PRIORS",
        "CameraPrior",
        "Priors",
    ),
    "simtest.calibration.response": (
        "Response",
        "srgb_decode",
        "srgb_encode",
    ),
}
__getattr__, __dir__ = lazy_names(__name__, _HOMES)

__all__ = [
    "LIGHT_AT_CAMERA",
    "NO_PRIORS",
    "Calibration",
    "CameraPrior",
    "CorrectedFrame",
    "Distribution",
    "Frame",
    "LogUniform",
    "NoiseModel",
    "Normal",
    "Priors",
    "Response",
    "Uniform",
    "estimate_noise",
    "exactly",
    "srgb_decode",
    "srgb_encode",
]
