"""From radiance to the light that reaches the sensor: point spread and vignetting."""

import numpy as np
import numpy.typing as npt

from simtest.calibration.calibration import falloff_map
from simtest.geometry import Camera, smooth
from simtest.spec.sensor import Sensor

Image = npt.NDArray[np.float32]


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
