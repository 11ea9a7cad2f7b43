"""A camera with what is known of it, and the correction of its frames: response, vignetting and emission undone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, reduce

import numpy as np

from simtest.calibration.photometry import AngularProfile, NoiseModel, Response
from simtest.calibration.priors import NO_PRIORS, Priors
from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.geometry.checks import check_kind, check_number, check_numbers
from simtest.runtime.arrays import Array, Image, Mask, short_repr

OPTICAL_AXIS = (0.0, 0.0, 1.0)

MIN_FALLOFF = 0.05
"""The correction divides by at least this share of the frame's largest falloff: below it there is little but noise."""

MOST_PLANES = 4
"""Frames of more channels are not split by OpenCV."""


@dataclass(frozen=True)
class CorrectedFrame:
    """A frame in linear light, the calibration's falloff undone.

    Parameters
    ----------
    intensity : ndarray of float32, shape (H, W)
        Mean of the channels' linear values, over the known falloff.
    linear : ndarray of float32, shape (H, W)
        The same before that division, where white noise is still white.
    gain : ndarray of float32, shape (H, W), optional
        Intensity over linear; None where nothing is divided.
    saturated : ndarray of bool, shape (H, W), optional
        Where a channel is clipped; None where the level is not known.
    limited : ndarray of bool, shape (H, W), optional
        Where too little light is left for the whole correction; None where nothing is divided.
    channels : int
        Number of averaged channels.
    """

    intensity: Image
    linear: Image
    gain: Image | None = None
    saturated: Mask | None = None
    limited: Mask | None = None
    channels: int = 1

    __repr__ = short_repr


@dataclass(frozen=True)
class Calibration:
    """A camera with what is known of its response, lens, light and noise.

    Parameters
    ----------
    camera : Camera
        Geometry.
    response : Response, optional
        From light to values; None: not known, and values count as linear light.
    vignetting : AngularProfile
        Share of the light that the lens transmits, over the angle between sightline and optical axis.
    emission : AngularProfile
        Emission of a light at the camera, over the angle between sightline and `emission_axis`. Where `priors` give
        a light beside the camera it is not undone, and they must say that a falloff is left in the frame.
    noise : NoiseModel
        Of the known noise; white noise beyond it is estimated from each frame.
    saturation_level : float, optional
        Encoded value at and above which a pixel is clipped; None: not known, and no pixel counts as clipped.
    priors : Priors
        Of lights, distance, lobe, camera, falloff and relief; passed on to the estimators. Their `falloff_power` is of
        what is left in the frame beside `vignetting` and `emission`; where both are known it is None.
    emission_axis : tuple of float
        Direction in which the light shines, camera frame, unit; default the optical axis.

    Raises
    ------
    InputError
        If a part is of another type, the saturation level is no finite number > 0, or an emission that is not undone
        comes without a prior on the falloff.

    Examples
    --------
    >>> import simtest
    >>> from simtest.calibration import Priors
    >>> camera = simtest.Camera.from_fov(70.0, 640, 480)
    >>> calibration = simtest.Calibration(camera, priors=Priors(lights_mm=((3.0, 0.0, 0.0),)))
    >>> calibration.priors.lights_mm
    ((3.0, 0.0, 0.0),)
    """

    camera: Camera
    response: Response | None = None
    vignetting: AngularProfile = field(default_factory=AngularProfile)
    emission: AngularProfile = field(default_factory=AngularProfile)
    noise: NoiseModel = field(default_factory=NoiseModel)
    saturation_level: float | None = None
    priors: Priors = NO_PRIORS
    emission_axis: tuple[float, float, float] = OPTICAL_AXIS

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not isinstance(self.camera, Camera):
            raise InputError(f"calibration camera is a {type(self.camera).__name__}: must be a simtest.Camera")
        if self.response is not None:
            check_kind("calibration response", self.response, Response)
        for name in ("vignetting", "emission"):
            check_kind(f"calibration {name}", getattr(self, name), AngularProfile)
        check_kind("calibration noise", self.noise, NoiseModel)
        check_numbers("emission_axis", self.emission_axis)
        if len(self.emission_axis) != 3 or not math.isclose(math.hypot(*self.emission_axis), 1, abs_tol=1e-9):
            raise InputError(f"emission_axis = {self.emission_axis}: must be a unit vector of 3 numbers")
        if self.saturation_level is not None:
            check_number("saturation_level", self.saturation_level, above=0)
        if self.priors.falloff_power is None and not self.is_emission_undone:
            raise InputError(
                "emission: cannot be undone for lights_mm beside the camera; must come with priors.falloff_power, "
                "which says how much of it is in the frame"
            )

    @property
    def is_emission_undone(self) -> bool:
        """Whether no emission is left in the frame: from a light beside the camera it depends on the distance too."""
        return self.emission.is_uniform or not self.priors.has_light_beside

    @cached_property
    def falloff(self) -> Array | None:
        """Vignetting times emission, as far as it is undone, at each pixel's centre, shape (H, W); None: uniform."""
        emission = self.emission if self.is_emission_undone else AngularProfile()
        if self.vignetting.is_uniform and emission.is_uniform:
            return None
        return falloff_map(self.camera, self.vignetting) * falloff_map(self.camera, emission, self.emission_axis)

    def clipped(self, values: Image) -> Mask | None:
        """Return where a channel of a frame as encoded is clipped, shape (H, W); None where no level is known."""
        if self.saturation_level is None:
            return None
        return np.asarray(brightest_channel(values) >= np.float32(self.saturation_level))

    def correct(self, values: Image) -> CorrectedFrame:
        """Undo the response, average the channels, divide by the known falloff; smoothing comes after.

        The values are those of the frame as encoded, float32, finite, shape (H, W) or (H, W, C).
        """
        # clipped pixels, while the values are as encoded
        saturated = self.clipped(values)
        # linear light
        if self.response is not None and self.response.kind != "linear":
            values = self.response.decode(values).astype(np.float32)
        channels = 1 if values.ndim == 2 else values.shape[2]
        linear = mean_channel(values)
        # falloff
        falloff = self.falloff
        if falloff is None:
            return CorrectedFrame(linear, linear, saturated=saturated, channels=channels)
        least = MIN_FALLOFF * float(falloff.max())
        if least <= 0:
            # No light reaches this frame: nothing is corrected, and every pixel is marked.
            return CorrectedFrame(linear, linear, None, saturated, np.ones(linear.shape, dtype=bool), channels)
        gain = (1 / np.maximum(falloff, least)).astype(np.float32)
        return CorrectedFrame(linear * gain, linear, gain, saturated, falloff < least, channels)


def brightest_channel(values: Image) -> Image:
    """Return the largest value of each pixel, shape (H, W), of a frame (H, W) or (H, W, C)."""
    # Several times faster than a maximum along the last axis.
    return values if values.ndim == 2 else reduce(np.maximum, _planes(values))


def mean_channel(values: Image) -> Image:
    """Return the mean of each pixel's channels, shape (H, W), of a frame (H, W) or (H, W, C)."""
    if values.ndim == 2:
        return values
    if values.shape[2] != 3 or values.dtype != np.float32:
        return values.mean(axis=2, dtype=np.float32)
    # Several times faster than a mean along the last axis, and the same bits.
    first, second, third = _planes(values)
    return np.asarray((first + second + third) / np.float32(3))


def _planes(values: Image) -> Sequence[Image]:
    """Return the channels of a frame (H, W, C), each of shape (H, W)."""
    if values.dtype != np.float32 or values.shape[2] > MOST_PLANES:
        return list(np.moveaxis(values, -1, 0))
    # Imported here: a calibration alone needs no OpenCV.
    import cv2

    return [np.asarray(plane) for plane in cv2.split(values)]


def falloff_map(camera: Camera, profile: AngularProfile, axis: tuple[float, float, float] = OPTICAL_AXIS) -> Array:
    """Evaluate a profile about a unit axis at each pixel's centre, shape (H, W); 0 where there is no sightline."""
    cosine, sine = _angles(camera, tuple(axis))
    return np.where(np.isfinite(cosine), profile.at(cosine, sine), 0.0)


@lru_cache(maxsize=2)
def _angles(camera: Camera, axis: tuple[float, float, float]) -> tuple[Array, Array]:
    """Return cosine and sine of the angle to a unit axis at each pixel's centre: a frame asks several times."""
    rays = camera.unproject(camera.pixel_centres())
    if axis == OPTICAL_AXIS:
        return rays[..., 2].copy(), np.hypot(rays[..., 0], rays[..., 1])
    return rays @ np.array(axis), np.linalg.norm(np.cross(rays, axis), axis=-1)
