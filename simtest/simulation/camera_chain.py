"""The camera chain: point spread, vignetting, exposure, noise, saturation, response, quantisation.

`collect` is the lens, `capture` the sensor. Images are float32, shape (H, W) or (H, W, 3).
"""

import numpy as np

from simtest.calibration import srgb_encode
from simtest.calibration.calibration import falloff_map
from simtest.geometry import Camera, smooth
from simtest.runtime.arrays import Image, Picture
from simtest.spec.sensor import Sensor

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and no Poisson numbers exist."""


def collect(radiance: Image, sensor: Sensor, camera: Camera) -> Image:
    """Compute the light that reaches the sensor's pixels: linear radiance after the lens.

    The camera gives each pixel's angle from the optical axis. The point spread mirrors the frame at its borders.
    """
    # Point spread, then vignetting.
    light = smooth(radiance, sensor.point_spread_px)
    vignetting = sensor.vignetting.model()
    if vignetting.is_uniform:
        return light
    share = falloff_map(camera, vignetting).astype(np.float32)
    return np.asarray(light * (share if light.ndim == 2 else share[:, :, None]), dtype=np.float32)


def capture(light: Image, full_scale: float, sensor: Sensor, rng: np.random.Generator | None) -> Image:
    """Compute the sensor's frame, as encoded: in [0, 1] where the sensor clips.

    Parameters
    ----------
    light : ndarray of float32, shape (H, W) or (H, W, 3)
        Radiance after the lens (`collect`).
    full_scale : float
        Radiance that becomes 1. Where it is not positive no light reached the sensor: no signal.
    sensor : Sensor
        The sensor.
    rng : numpy.random.Generator or None
        Draws shot noise, then read noise, then white noise; may be None where there is no noise.

    Raises
    ------
    ValueError
        If noise is asked for without a generator.
    """
    # Electrons: shot and read noise.
    if sensor.full_well is not None:
        light = _electrons(expose(light, full_scale, 0.0, None), sensor.full_well, sensor.read_noise, rng)
        full_scale = 1.0
    # White noise, then the sensor's values.
    frame = expose(light, full_scale, sensor.noise_sigma, rng)
    return encode(frame, sensor) if sensor.clips else frame


def encode(frame: Image, sensor: Sensor) -> Image:
    """Clip a linear frame to full scale, apply the response and quantise."""
    # Saturation and response, then quantisation.
    values = sensor.response.model().encode(np.clip(frame, 0.0, 1.0))
    if sensor.bits is not None:
        largest = 2**sensor.bits - 1
        values = np.rint(values * largest) / largest
    return values.astype(np.float32)


def _electrons(frame: Image, full_well: float, read_noise: float, rng: np.random.Generator | None) -> Image:
    """Count electrons, Poisson about the light's mean, and add the normal noise of the readout; share of full scale."""
    if rng is None:
        raise ValueError("shot noise needs a generator")
    # Shot noise: beyond `MAX_COUNT` the mean stands for itself.
    mean = np.maximum(frame.astype(float), 0.0) * full_well
    counts = np.where(mean > MAX_COUNT, mean, rng.poisson(np.minimum(mean, MAX_COUNT)))
    if read_noise > 0:
        counts = counts + read_noise * rng.standard_normal(counts.shape)
    return (counts / full_well).astype(np.float32)


def expose(radiance: Image, full_scale: float, noise_sigma: float, rng: np.random.Generator | None) -> Image:
    """Scale radiance to full scale 1 and add white Gaussian noise.

    Where the full scale is not positive no light reached the sensor, and the signal is 0. `noise_sigma` is a share of
    full scale (theory.md section 0); `rng` may be None where there is no noise. The frame is not clipped.

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


def to_uint8(frame: Image) -> Picture:
    """Return the sRGB-encoded 8-bit picture of a linear frame, clipped to [0, 1]."""
    linear = np.clip(np.nan_to_num(frame, nan=0.0), 0, 1)
    return np.asarray(np.round(255 * srgb_encode(linear)), dtype=np.uint8)
