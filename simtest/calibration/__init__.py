"""What is known of a camera beside its geometry, and beside a picture: response, falloff, noise, priors.

`calibration` undoes response and falloff; `frame` is a frame on that way, as detectors and estimators see it; `priors`
holds what is known of lights, distance, lobe, camera and relief, and what is assumed where nobody told
(`distributions`).
"""

from typing import TYPE_CHECKING, Any

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.calibration.calibration import Calibration, CorrectedFrame
    from simtest.calibration.distributions import Distribution, LogUniform, Normal, Uniform, exactly
    from simtest.calibration.frame import Frame
    from simtest.calibration.noise_estimate import estimate_noise
    from simtest.calibration.noise_model import NoiseModel
    from simtest.calibration.priors import LIGHT_AT_CAMERA, NO_PRIORS, CameraPrior, Priors
    from simtest.calibration.response import Response, srgb_decode, srgb_encode

_named, __dir__, _ = lazy_names(__name__)

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


def __getattr__(name: str) -> Any:
    if name != "Known":
        return _named(name)
    import warnings

    warnings.warn(
        "simtest.calibration.Known is now simtest.calibration.Priors; the old name goes in 0.3.0",
        DeprecationWarning,
        2,
    )
    return _known


def _known(
    lights_mm: tuple[tuple[float, float, float], ...] = (),
    distance_mm: float | None = None,
    distance_sd_mm: float = 0.0,
    lobe_curvature: float | None = None,
) -> "Priors":
    """Return the priors of bare numbers, as `Known` took them."""
    from simtest.calibration.distributions import Normal, exactly
    from simtest.calibration.priors import Priors

    distance = None if distance_mm is None else Normal(distance_mm, distance_sd_mm)
    return Priors(lights_mm, distance, None if lobe_curvature is None else exactly(lobe_curvature))
