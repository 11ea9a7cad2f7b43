"""The noise of a sensor's linear frame at single pixels, behind all stages of its camera chain."""

import numpy as np

from simtest.calibration.calibration import mean_channel
from simtest.runtime.arrays import Array, Image, IntArray
from simtest.runtime.seeds import from_integer
from simtest.simulation.camera_chain import capture
from simtest.spec.sensor import Sensor

CELL, BLOCK = 32, 16
"""Pixels along a side of what is drawn around a pixel, and of the blocks of lossy coding, with which it keeps step: at
least 8 px are around the pixel, as far as sharpening reaches."""

UNCLIPPED = 0.7
"""Of full scale: so bright the light is made where more would be clipped, which has no noise."""

CELLS = 2**10
"""Cells of one picture."""


def noise_at(light: Image, full_scale: float, sensor: Sensor, rows: IntArray, columns: IntArray, draws: int) -> Array:
    """Return the standard deviation, radiance, of the mean of the frame's channels at pixels, shape (N,).

    Where a sensor has no stage that mixes pixels or channels, or draws no noise, the noise model has it in closed form.
    Else the light around each pixel goes through the chain `draws` times, and the deviation is that over the 3 x 3
    pixels around it, linear again. That of clipped light is the one below the clip.

    Parameters
    ----------
    light : ndarray, shape (H, W) or (H, W, 3)
        Noise-free radiance behind the lens.
    full_scale : float
        Radiance that becomes 1; where it is 0 there is no noise.
    sensor : Sensor
        The sensor.
    rows, columns : ndarray of int, shape (N,)
        The pixels.
    draws : int
        At least 2.
    """
    if full_scale <= 0 or not len(rows):
        return np.zeros(len(rows))
    colour = light if light.ndim == 3 else light[..., None]
    level = colour[rows, columns].mean(axis=1, dtype=float) / full_scale
    mixes = sensor.is_processed or sensor.mosaic is not None or sensor.colour is not None
    if not mixes or (sensor.full_well is None and sensor.noise_sigma == 0):
        noise = sensor.noise_model().at(np.minimum(level, 1) if sensor.clips else level, colour.shape[2])
        return np.asarray(noise) * full_scale
    share = np.minimum(1, UNCLIPPED / np.maximum(level, 1e-12)) if sensor.clips else np.ones(len(rows))
    plain, rng, at_once = sensor.model_copy(update={"overlay": None}), from_integer(0), max(1, CELLS // draws)
    found = []
    for first in range(0, len(rows), at_once):
        own = slice(first, first + at_once)
        # A row of equal cells for each pixel, in step with the blocks.
        down, right = ((at[own] - BLOCK // 2) // BLOCK * BLOCK for at in (rows, columns))
        inside = [np.clip(start[:, None] + np.arange(CELL), 0, size - 1)
                  for start, size in ((down, light.shape[0]), (right, light.shape[1]))]  # fmt: skip
        cells = colour[inside[0][:, :, None], inside[1][:, None, :]] * share[own, None, None, None]
        picture = np.tile(cells.reshape(-1, CELL, cells.shape[3]), (1, draws, 1)).astype(np.float32)
        frame = capture(picture if light.ndim == 3 else picture[..., 0], full_scale, plain, rng)
        linear = mean_channel(sensor.response.model().decode_picture(frame))
        variance = linear.reshape(len(cells), CELL, draws, CELL).var(axis=2, ddof=1, dtype=float)
        # Cells begin left of and above the frame where the pixel is near its border.
        number, (row, column) = np.arange(len(cells)), (rows[own] - down, columns[own] - right)
        around = [variance[number, row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        found.append(np.sqrt(np.mean(around, axis=0)) * full_scale)
    return np.concatenate(found)
