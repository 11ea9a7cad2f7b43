"""The camera chain: lens, sensor and video processor, in the order of `spec.Sensor`.

`collect` is the lens, `capture` the sensor, and `encode` what follows its linear values. Images are float32, shape
(H, W) or (H, W, 3).
"""

import math
from collections.abc import Callable

import cv2
import numpy as np

from simtest.calibration import srgb_encode
from simtest.calibration.calibration import falloff_map
from simtest.geometry import Camera, smooth
from simtest.runtime.arrays import Image, Mask, Picture
from simtest.simulation import mosaic, video_processor
from simtest.simulation.coding import code
from simtest.simulation.shot_noise import poisson
from simtest.spec.sensor import Sensor

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and no Poisson numbers exist."""


METERED = 20_000
"""Pixels by which the automatic exposure measures a frame, evenly spread over it."""

CLOSE, TINY = 1e-7, 1e-30
"""Error of the automatic exposure's full scale, as a share of it, and a mean that stands for 0."""

LEVELS = (np.arange(256) / 255).astype(np.float32)
"""Values of a picture of 8 bits."""


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
        light = _electrons(expose(light, full_scale, 0.0, None), sensor, rng)
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
    if sensor.is_processed:
        return _recorded(_processed(frame, sensor, seen), sensor)
    values = sensor.response.model().encode(np.clip(frame, 0.0, 1.0) if sensor.clips else frame)
    if sensor.bits is not None:
        largest = 2**sensor.bits - 1
        values = np.rint(values * largest) / largest
    return values.astype(np.float32)


def _processed(frame: Image, sensor: Sensor, seen: Mask | None) -> Image:
    """Clip a linear frame, apply the response, sharpen, scale and draw, in this order."""
    picture = sensor.response.model().encode_picture(np.clip(frame, 0.0, 1.0) if sensor.clips else frame)
    if sensor.sharpening is not None:
        picture = video_processor.sharpen(picture, sensor.sharpening)
        picture = np.clip(picture, 0.0, 1.0) if sensor.clips else picture
    if sensor.scaling is not None:
        picture = video_processor.rescale(picture, sensor.scaling)
        picture = np.clip(picture, 0.0, 1.0) if sensor.clips else picture
    return picture if sensor.overlay is None else video_processor.draw(picture, sensor.overlay, seen)


def _recorded(picture: Image, sensor: Sensor) -> Image:
    """Quantise a processed picture and code it."""
    if sensor.bits is None:
        return picture
    if sensor.coding is None:
        largest = 2**sensor.bits - 1
        return np.asarray(np.rint(picture * np.float64(largest)) / largest, dtype=np.float32)
    coded = code(np.rint(picture * np.float32(255)).astype(np.uint8), sensor.coding)
    return np.asarray(cv2.LUT(coded, LEVELS))


def _electrons(frame: Image, sensor: Sensor, rng: np.random.Generator | None) -> Image:
    """Count electrons, Poisson about the light's mean, and add the normal noise of the readout; share of full scale."""
    full_well, read_noise = sensor.full_well, sensor.read_noise
    assert full_well is not None
    if rng is None:
        raise ValueError("shot noise needs a generator")
    if sensor.is_processed:
        # A picture to look at, in single precision; plain frames, of which errors are measured, keep NumPy's numbers.
        levels = poisson(np.maximum(frame, 0) * np.float32(full_well), rng)
        levels *= np.float32(1 / full_well)
        if read_noise > 0:
            noise = rng.standard_normal(levels.shape, dtype=np.float32)
            noise *= np.float32(read_noise / full_well)
            levels += noise
        return levels
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
    if full_scale == 1:
        frame = radiance
    else:
        # In double precision: a small full scale is 0 in single precision.
        frame = (radiance / np.float64(full_scale)).astype(np.float32) if full_scale > 0 else np.zeros_like(radiance)
    if noise_sigma > 0:
        if rng is None:
            raise ValueError("noise needs a generator")
        frame = frame + np.float32(noise_sigma) * rng.standard_normal(radiance.shape, dtype=np.float32)
    return np.asarray(frame, dtype=np.float32)


def full_scale_of_average(light: Image, average: float, sensor: Sensor) -> float:
    """Return the radiance at full scale for which the mean of the clipped, encoded light is `average`.

    `light` is noise-free, any shape; at least one value is positive. Values of 0 do not count: no surface is seen
    there, and a real scene has one everywhere. Where even the smallest full scale leaves the mean below `average`,
    since most of the light falls on few pixels, it is the smallest.
    """
    response, peak = sensor.response.model(), float(light.max())
    # An automatic exposure measures fields, not single pixels.
    values = light[light > 0]
    values = values[:: max(1, values.size // METERED)]

    def excess(log_scale: float) -> float:
        levels = response.encode_picture(np.clip(values / np.float64(math.exp(log_scale)), 0, 1).astype(np.float32))
        # In logarithms both are nearly linear: few steps lead to the zero.
        return math.log(max(float(levels.mean(dtype=np.float64)), TINY) / average)

    # Between the brightest pixel and a tiny share of it the mean falls steadily with the full scale.
    return math.exp(_zero_of(excess, math.log(peak * 1e-6), math.log(peak * 1e3)))


def _zero_of(falling: Callable[[float], float], low: float, high: float) -> float:
    """Return where a falling function is 0, to `CLOSE`, by Ridders' method; an end, where it is 0 at neither side."""
    at_low, at_high = falling(low), falling(high)
    if at_low <= 0 or at_high >= 0:
        return low if at_low <= 0 else high
    last = math.inf
    while high - low > CLOSE:
        middle = (low + high) / 2
        at_middle = falling(middle)
        # Through both ends and the middle goes an exponential times a straight line; its zero lies in the bracket.
        root = math.sqrt(at_middle**2 - at_low * at_high)
        found = middle + (middle - low) * at_middle / root if root > 0 else middle
        if abs(found - last) < CLOSE:
            return found
        last, value = found, falling(found)
        # The narrowest bracket of the four values.
        points = sorted([(low, at_low), (middle, at_middle), (found, value), (high, at_high)])
        low, at_low = max(point for point in points if point[1] > 0)
        high, at_high = min(point for point in points if point[1] <= 0)
    return (low + high) / 2


def to_uint8(frame: Image) -> Picture:
    """Return the sRGB-encoded 8-bit picture of a linear frame, clipped to [0, 1]."""
    linear = np.clip(np.nan_to_num(frame, nan=0.0), 0, 1)
    return np.asarray(np.round(255 * srgb_encode(linear)), dtype=np.uint8)


def displayed(frame: Image, sensor: Sensor) -> Image:
    """Return a frame as a screen gets it, shape (H, W, 3), float32: as the sensor encoded it, or sRGB of 8 bits."""
    values = np.clip(frame, 0, 1) if sensor.encodes else to_uint8(frame).astype(np.float32) / 255
    return np.asarray(values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2), dtype=np.float32)
