"""The pixels of a frame that glint, and those where a glint could be seen, counted in cells of the picture."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.runtime.arrays import Array, Image, Mask

BACKGROUND_SHARE = 1 / 24
"""Side of the median that is the light around, over the frame's width."""

CELL_SHARE = 1 / 52
"""Side of a cell over the frame's width."""

CONTRAST, LEAST_RISE = 0.5, 0.03
"""A pixel glints where its weakest channel stands above the light around by this share of it, and by so much of full
scale."""

CENSORED = 0.93
"""Where a glint would have to exceed this share of full scale none can be seen."""

LEAST_USABLE = 0.25
"""Cells of which a smaller share is usable are left out."""


@dataclass(frozen=True)
class Cells:
    """Cells of a frame.

    Parameters
    ----------
    sightlines : ndarray, shape (M, 3)
        Unit, of the cells' centres.
    pixels_px : ndarray, shape (M, 2)
        Centres.
    glints, usable : ndarray, shape (M,)
        Pixels that glint, and those where a glint could be seen; all cells, 0 where nothing could.
    area_px : float
        Pixels of a whole cell.
    shape : tuple of int
        Rows and columns of cells.
    """

    sightlines: Array
    pixels_px: Array
    glints: Array
    usable: Array
    area_px: float
    shape: tuple[int, int]

    @property
    def dispersion(self) -> float:
        """Variance of a cell's count over its mean, from differences of neighbours: glints are clumps of pixels."""
        share = np.where(self.usable > 0, self.glints / np.maximum(self.usable, 1), np.nan).reshape(self.shape)
        usable = self.usable.reshape(self.shape)
        values = []
        for first, second, n, m in (
            (share[:, 1:], share[:, :-1], usable[:, 1:], usable[:, :-1]),
            (share[1:], share[:-1], usable[1:], usable[:-1]),
        ):
            mean = (first * n + second * m) / np.maximum(n + m, 1)
            variance = mean * (1 / np.maximum(n, 1) + 1 / np.maximum(m, 1))
            kept = np.isfinite(first) & np.isfinite(second) & (mean > 0)
            values.append(((first - second)[kept] ** 2, variance[kept]))
        squares, expected = (np.concatenate(part) for part in zip(*values, strict=True))
        return max(1.0, float(squares.sum() / expected.sum())) if len(squares) else 1.0


def count_cells(frame: Frame) -> Cells:
    """Count the glinting and the usable pixels of a frame in cells."""
    glints, usable = glinting(frame)
    camera = frame.camera
    side = max(4, round(camera.width * CELL_SHARE))
    rows, columns = camera.height // side, camera.width // side
    counts = [
        mask[: rows * side, : columns * side].reshape(rows, side, columns, side).sum(axis=(1, 3)).ravel().astype(float)
        for mask in (glints, usable)
    ]
    y, x = np.mgrid[:rows, :columns]
    pixels = (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * side
    sightlines = np.nan_to_num(camera.unproject(pixels))
    kept = (counts[1] >= LEAST_USABLE * side**2) & (np.linalg.norm(sightlines, axis=1) > 0.5)
    return Cells(sightlines, pixels, counts[0] * kept, counts[1] * kept, float(side**2), (rows, columns))


def glinting(frame: Frame) -> tuple[Mask, Mask]:
    """Return the pixels that glint, and those where a glint could be seen, both (H, W)."""
    light = weakest(frame)
    around = background(light)
    needed = around + np.maximum(CONTRAST * around, LEAST_RISE)
    usable = needed < CENSORED
    if frame.seen is not None:
        usable &= frame.seen
    return (light > needed) & usable, usable


def weakest(frame: Frame) -> Image:
    """Return the linear light of the weakest channel: what a wet surface mirrors is white, tissue is not."""
    channels = frame.channels
    return channels if channels.ndim == 2 else channels.min(axis=2)


def background(light: Image) -> Image:
    """Return the median of the light around each pixel, of a picture that is small enough to be quick."""
    side = light.shape[1] * BACKGROUND_SHARE
    factor = max(1.0, side / 5)
    size = (max(5, round(light.shape[1] / factor)), max(5, round(light.shape[0] / factor)))
    small = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    middle = cv2.medianBlur(np.ascontiguousarray(small, dtype=np.float32), 5)
    return np.asarray(cv2.resize(middle, light.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)
