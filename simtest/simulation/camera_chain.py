"""From radiance to a frame: point spread, vignetting, exposure, noise, saturation, response, quantisation."""

import numpy as np
import numpy.typing as npt

from simtest.calibration import srgb_encode
from simtest.calibration.calibration import falloff_map
from simtest.geometry import Camera, smooth
from simtest.spec.sensor import Sensor

Image = npt.NDArray[np.float32]

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and Poisson numbers end."""


def collect(radiance: Image, sensor: Sensor, camera: Camera) -> Image:
    """Give the light that reaches the sensor's pixels.

    Parameters
    ----------
    radiance : ndarray of float32, shape (H, W) or (H, W, 3)
        Linear radiance.
    sensor : Sensor
        Point spread and vignetting.
    camera : Camera
        Gives each pixel's angle from the optical axis.

    Returns
    -------
    ndarray of float32, same shape
        Radiance after the lens. The frame is mirrored at its borders for the point spread.
    """
    light = smooth(radiance, sensor.point_spread_px)
    vignetting = sensor.vignetting.model()
    if vignetting.is_uniform:
        return light
    share = falloff_map(camera, vignetting).astype(np.float32)
    return np.asarray(light * (share if light.ndim == 2 else share[:, :, None]), dtype=np.float32)


def capture(light: Image, full_scale: float, sensor: Sensor, rng: np.random.Generator | None) -> Image:
    """Give the sensor's frame.

    Parameters
    ----------
    light : ndarray of float32, shape (H, W) or (H, W, 3)
        Radiance after the lens (`collect`).
    full_scale : float
        Radiance that becomes 1. Where it is not positive no light reached the sensor: no signal.
    sensor : Sensor
        The sensor.
    rng : numpy.random.Generator or None
        Gives shot noise, then read noise, then white noise; may be None where there is no noise.

    Returns
    -------
    ndarray of float32, same shape
        As encoded, in [0, 1] where the sensor clips.

    Raises
    ------
    ValueError
        If noise is asked for without a generator.
    """
    if sensor.full_well is not None:
        light = _electrons(expose(light, full_scale, 0.0, None), sensor.full_well, sensor.read_noise, rng)
        full_scale = 1.0
    frame = expose(light, full_scale, sensor.noise_sigma, rng)
    return encode(frame, sensor) if sensor.clips else frame


def encode(frame: npt.NDArray[np.float32], sensor: Sensor) -> Image:
    """Clip a linear frame to full scale, apply the response and quantise."""
    values = sensor.response.model().encode(np.clip(frame, 0.0, 1.0))
    if sensor.bits is not None:
        largest = 2**sensor.bits - 1
        values = np.rint(values * largest) / largest
    return values.astype(np.float32)


def _electrons(frame: Image, full_well: float, read_noise: float, rng: np.random.Generator | None) -> Image:
    """Count electrons: Poisson numbers of the light's mean, plus the readout's normal noise; share of full scale."""
    if rng is None:
        raise ValueError("shot noise needs a generator")
    mean = np.maximum(frame.astype(float), 0.0) * full_well
    counts = np.where(mean > MAX_COUNT, mean, rng.poisson(np.minimum(mean, MAX_COUNT)))
    if read_noise > 0:
        counts = counts + read_noise * rng.standard_normal(counts.shape)
    return (counts / full_well).astype(np.float32)


def expose(radiance: Image, full_scale: float, noise_sigma: float, rng: np.random.Generator | None) -> Image:
    """Scale radiance to full scale 1 and add white Gaussian noise.

    Parameters
    ----------
    radiance : ndarray of float32, shape (H, W) or (H, W, 3)
        Linear radiance.
    full_scale : float
        Radiance that becomes 1. Where it is not positive, the frame is left at 0: no light reached the sensor.
    noise_sigma : float
        Standard deviation, share of full scale (theory.md section 0).
    rng : numpy.random.Generator or None
        May be None where there is no noise.

    Returns
    -------
    ndarray of float32, same shape
        Not clipped.

    Raises
    ------
    ValueError
        If noise is asked for without a generator.
    """
    # In double precision: a small full scale is 0 in single precision.
    frame = (radiance / np.float64(full_scale)).astype(np.float32) if full_scale > 0 else np.zeros_like(radiance)
    if noise_sigma > 0:
        if rng is None:
            raise ValueError("noise needs a generator")
        frame = frame + np.float32(noise_sigma) * rng.standard_normal(radiance.shape, dtype=np.float32)
    return np.asarray(frame, dtype=np.float32)


def to_uint8(frame: Image) -> npt.NDArray[np.uint8]:
    """Give the sRGB-encoded 8-bit picture of a linear frame, clipped to [0, 1]."""
    linear = np.clip(np.nan_to_num(frame, nan=0.0), 0, 1)
    return np.asarray(np.round(255 * srgb_encode(linear)), dtype=np.uint8)
