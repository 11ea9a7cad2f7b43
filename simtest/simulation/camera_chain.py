"""The camera chain: lens, sensor and video processor, in the order of `spec.Sensor`.

`collect` is the lens, `capture` the sensor, and `encode` what follows its linear values. Images are float32, shape
(H, W) or (H, W, 3).
"""

import math

import numpy as np

from simtest.calibration import srgb_encode
from simtest.calibration.calibration import falloff_map
from simtest.geometry import Camera, smooth
from simtest.runtime.arrays import Image, Mask, Picture
from simtest.simulation import mosaic, video_processor
from simtest.simulation.coding import code
from simtest.spec.sensor import Sensor

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and no Poisson numbers exist."""


METERED = 20_000
"""Pixels by which the automatic exposure measures a frame, evenly spread over it."""


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


def capture(
    light: Image, full_scale: float, sensor: Sensor, rng: np.random.Generator | None, seen: Mask | None = None
) -> Image:
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
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.

    Returns
    -------
    ndarray of float32
        Of the light's shape, (H, W, 3) with a mosaic or colour processing.

    Raises
    ------
    InputError
        If a package for the coding is missing.
    ValueError
        If noise is asked for without a generator.
    """
    # The sensor's own colours, each pixel behind its filter.
    if sensor.colour is not None or sensor.mosaic is not None:
        light, full_scale = expose(light, full_scale, 0.0, None), 1.0
        light = light if sensor.colour is None else video_processor.as_seen_by_sensor(light, sensor.colour)
        light = light if sensor.mosaic is None else mosaic.sample(light, sensor.mosaic)
    # Electrons: shot and read noise.
    if sensor.full_well is not None:
        light = _electrons(expose(light, full_scale, 0.0, None), sensor.full_well, sensor.read_noise, rng)
        full_scale = 1.0
    # White noise, then the sensor's values.
    frame = expose(light, full_scale, sensor.noise_sigma, rng)
    # The picture's colours.
    if sensor.mosaic is not None:
        frame = mosaic.demosaic(frame, sensor.mosaic)
    if sensor.colour is not None:
        frame = video_processor.develop(frame, sensor.colour, sensor.clips)
    return encode(frame, sensor, seen) if sensor.clips or sensor.is_processed else frame


def encode(frame: Image, sensor: Sensor, seen: Mask | None = None) -> Image:
    """Turn a linear frame into the picture: clip, apply the response, process, quantise and code it.

    `seen`, shape (H, W), are the pixels inside the camera's view mask, default all.
    """
    values = sensor.response.model().encode(np.clip(frame, 0.0, 1.0) if sensor.clips else frame)
    if sensor.is_processed:
        values = np.asarray(_processed(values.astype(np.float32), sensor, seen), dtype=float)
    if sensor.bits is not None:
        largest = 2**sensor.bits - 1
        values = np.rint(values * largest) / largest
    if sensor.coding is not None:
        values = code(np.rint(values * 255).astype(np.uint8), sensor.coding) / 255
    return values.astype(np.float32)


def _processed(picture: Image, sensor: Sensor, seen: Mask | None) -> Image:
    """Sharpen, scale and draw, in this order."""
    if sensor.sharpening is not None:
        picture = video_processor.sharpen(picture, sensor.sharpening)
        picture = np.clip(picture, 0.0, 1.0) if sensor.clips else picture
    if sensor.scaling is not None:
        picture = video_processor.rescale(picture, sensor.scaling)
        picture = np.clip(picture, 0.0, 1.0) if sensor.clips else picture
    return picture if sensor.overlay is None else video_processor.draw(picture, sensor.overlay, seen)


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


def full_scale_of_average(light: Image, average: float, sensor: Sensor) -> float:
    """Return the radiance at full scale for which the mean of the clipped, encoded light is `average`.

    `light` is noise-free, any shape; at least one value is positive. Where even the smallest full scale leaves the mean
    below `average`, since too few pixels receive light, it is the smallest.
    """
    response, peak = sensor.response.model(), float(light.max())
    # An automatic exposure measures fields, not single pixels.
    values = light.ravel()[:: max(1, light.size // METERED)]

    def excess(log_scale: float) -> float:
        return float(response.encode(np.clip(values / math.exp(log_scale), 0.0, 1.0)).mean()) - average

    # Between the brightest pixel and a tiny share of it the mean falls steadily with the full scale.
    low, high = math.log(peak * 1e-6), math.log(peak * 1e3)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.exp((low + high) / 2)


def to_uint8(frame: Image) -> Picture:
    """Return the sRGB-encoded 8-bit picture of a linear frame, clipped to [0, 1]."""
    linear = np.clip(np.nan_to_num(frame, nan=0.0), 0, 1)
    return np.asarray(np.round(255 * srgb_encode(linear)), dtype=np.uint8)
