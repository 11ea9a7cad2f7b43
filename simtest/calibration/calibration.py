"""What is known of a camera, and the frame that it gives once response, vignetting and emission are undone."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.calibration.noise_model import NoiseModel
from simtest.calibration.priors import Priors
from simtest.calibration.response import Response
from simtest.errors import InputError
from simtest.geometry.angular_profile import AngularProfile
from simtest.geometry.camera import Camera
from simtest.geometry.checks import check_kind, check_number

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

MIN_FALLOFF = 0.05
"""Where less of the light is left, as a share of the frame's most, the correction stays at this: the rest is noise."""


@dataclass(frozen=True)
class CorrectedFrame:
    """A frame with everything undone that the calibration knows.

    Parameters
    ----------
    intensity : ndarray of float32, shape (H, W)
        Mean of the channels' linear values, over the known falloff.
    linear : ndarray of float32, shape (H, W)
        The same before that division: here white noise is still white.
    gain : ndarray of float32, shape (H, W), optional
        Intensity over linear; None where nothing is divided.
    saturated : ndarray of bool, shape (H, W), optional
        Where a channel is clipped; None where the level is not known.
    limited : ndarray of bool, shape (H, W), optional
        Where too little light is left for the whole correction; None where nothing is divided.
    channels : int
        How many were averaged.
    """

    intensity: Image
    linear: Image
    gain: Image | None = None
    saturated: Mask | None = None
    limited: Mask | None = None
    channels: int = 1


@dataclass(frozen=True)
class Calibration:
    """A camera with what is known of its response, its lens, its light and its noise.

    Parameters
    ----------
    camera : Camera
        Geometry.
    response : Response, optional
        How light became values; None: not stated.
    vignetting : AngularProfile
        Share of the light that the lens passes, over the angle between sightline and optical axis.
    emission : AngularProfile
        Emission of a light at the camera that shines along the optical axis, over the same angle.
    noise : NoiseModel
        What is known of the noise; white noise beyond it is estimated from each frame.
    saturation_level : float, optional
        Value, as encoded, at and above which a pixel is clipped; None: not known, no pixel counts as clipped.
    priors : Priors
        What is known of lights, distance and lobe: passed on to the estimators that ask for it.

    Raises
    ------
    InputError
        If a part is of another type, or the saturation level is no finite number > 0.
    """

    camera: Camera
    response: Response | None = None
    vignetting: AngularProfile = field(default_factory=AngularProfile)
    emission: AngularProfile = field(default_factory=AngularProfile)
    noise: NoiseModel = field(default_factory=NoiseModel)
    saturation_level: float | None = None
    priors: Priors = field(default_factory=Priors)

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise InputError(f"calibration camera is a {type(self.camera).__name__}: must be a simtest.Camera")
        if self.response is not None:
            check_kind("calibration response", self.response, Response)
        for name in ("vignetting", "emission"):
            check_kind(f"calibration {name}", getattr(self, name), AngularProfile)
        check_kind("calibration noise", self.noise, NoiseModel)
        if self.saturation_level is not None:
            check_number("saturation_level", self.saturation_level, above=0)

    @cached_property
    def falloff(self) -> npt.NDArray[np.float64] | None:
        """Vignetting times emission at each pixel's centre, shape (H, W); None where both are uniform."""
        if self.vignetting.is_uniform and self.emission.is_uniform:
            return None
        return falloff_map(self.camera, self.vignetting) * falloff_map(self.camera, self.emission)

    def correct(self, values: Image) -> CorrectedFrame:
        """Undo the response, average the channels, divide by the known falloff; smoothing comes after.

        Parameters
        ----------
        values : ndarray of float32, shape (H, W) or (H, W, C)
            The frame as encoded, finite.

        Returns
        -------
        CorrectedFrame
        """
        saturated = None
        if self.saturation_level is not None:
            brightest = values if values.ndim == 2 else values.max(axis=2)
            saturated = np.asarray(brightest >= np.float32(self.saturation_level))
        if self.response is not None and self.response.kind != "linear":
            values = self.response.decode(values).astype(np.float32)
        channels = 1 if values.ndim == 2 else values.shape[2]
        linear = values if values.ndim == 2 else values.mean(axis=2, dtype=np.float32)
        falloff = self.falloff
        if falloff is None:
            return CorrectedFrame(linear, linear, saturated=saturated, channels=channels)
        least = MIN_FALLOFF * float(falloff.max())
        if least <= 0:
            # No light can reach this frame: nothing is corrected, and all of it is marked.
            return CorrectedFrame(linear, linear, None, saturated, np.ones(linear.shape, dtype=bool), channels)
        gain = (1 / np.maximum(falloff, least)).astype(np.float32)
        return CorrectedFrame(linear * gain, linear, gain, saturated, falloff < least, channels)


def falloff_map(camera: Camera, profile: AngularProfile) -> npt.NDArray[np.float64]:
    """Give a profile about the optical axis at each pixel's centre, shape (H, W); 0 where there is no sightline."""
    x, y, cosine = np.moveaxis(camera.unproject(camera.pixel_centres()), -1, 0)
    return np.where(np.isfinite(cosine), profile.at(cosine, np.hypot(x, y)), 0.0)
