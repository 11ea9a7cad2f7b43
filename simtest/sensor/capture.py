"""From the light on the sensor to its frame: exposure, noise, saturation, response, quantisation."""

import numpy as np
import numpy.typing as npt

from simtest.sensor.exposure import Image, expose
from simtest.spec.sensor import Sensor

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and Poisson numbers end."""


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
