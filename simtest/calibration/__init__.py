"""What is known of a camera beside its geometry, and beside a picture: response, falloff, noise, priors.

`calibration` undoes response and falloff (`photometry`); `frame` is a frame on that way, as detectors and estimators
see it; `priors` holds what is known of lights, distance, lobe, camera and relief, and what is assumed where nobody
told.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.calibration.calibration import Calibration, CorrectedFrame
    from simtest.calibration.frame import Frame, estimate_noise
    from simtest.calibration.photometry import AngularProfile, NoiseModel, Response, srgb_decode, srgb_encode
    from simtest.calibration.priors import (
        LIGHT_AT_CAMERA,
        NO_PRIORS,
        CameraPrior,
        Distribution,
        LogUniform,
        Normal,
        Priors,
        Uniform,
        exactly,
    )

__getattr__, __dir__, __all__ = lazy_names(__name__)
