"""Exposure to full scale, additive noise, and 8-bit pictures."""

import numpy as np
import numpy.typing as npt

from simtest.calibration import srgb_encode

Image = npt.NDArray[np.float32]


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
