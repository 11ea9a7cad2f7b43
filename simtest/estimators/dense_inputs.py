"""What a dense network sees of a frame, and returns: planes on a coarse grid, of light, colour, sightlines and lights.

The frame lies in the middle of a grid of 4:3, whole; a frame of another aspect leaves cells empty, as a view mask does.
Directions are in the tangent basis of the direction to the camera that is aligned with the frame
(`simtest.estimators.spot_inputs.image_basis`).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.estimators.spot_inputs import LIGHT_SCALE_MM, image_basis, median_of_lit
from simtest.geometry import Array, Camera
from simtest.runtime.arrays import Image, Mask

GRID = (96, 128)
"""Rows and columns of the planes."""

STRIDE = 2
"""Cells of the planes, along each axis, for one cell of the outputs."""

CELLS = (GRID[0] // STRIDE, GRID[1] // STRIDE)
"""Rows and columns of the outputs."""

DARKEST = 0.02
"""Share of the lit pixels' median light that is added before the logarithm."""

LEAST_LIT = 0.1
"""Cells with less light than this share of the view's median have no colour of their own."""

LEAST_SEEN = 0.02
"""A cell of which a smaller share is seen is empty."""

PLANES = (
    "logarithm of the light over its median", "logarithm of the mean light over that mean",
    "logarithm of red over green", "logarithm of blue over green", "share seen",
    "sightline, x", "sightline, y", "mean light, first", "mean light, second", "mean light, towards",
)  # fmt: skip
"""Planes of light and colour are 0 where nothing is seen."""

CAMERA = (
    "log of the focal length along x over the grid", "log of the focal length along y over the grid",
    "principal point off the middle, x", "principal point off the middle, y",
    "mean light, x", "mean light, y", "mean light, z", "lights' spread",
)  # fmt: skip
"""What a network answers for a limited range of; lights in units of `LIGHT_SCALE_MM`."""

VIEWED = PLANES[:5]
"""The planes that change from frame to frame of one camera."""

# What a network returns

OUTPUTS = ("rotation, first", "rotation, second", "logarithm of L11", "L21", "logarithm of L22",
           "logarithm of the distance", "logarithm of that one's deviation")  # fmt: skip
"""In each cell. L is the Cholesky factor of the rotation's covariance, in units of `ROTATION_SCALE`."""

ROTATION_SCALE = 0.5
"""Rotation, rad, for an output of 1."""

DISTANCE_MM, DISTANCE_SCALE = 30.0, 0.5
"""A distance of `DISTANCE_MM` along the ray is an output of 0; an output of 1 is a logarithm of `DISTANCE_SCALE`."""


@dataclass(frozen=True)
class Layout:
    """Where a frame lies on the grid.

    Parameters
    ----------
    columns, rows : int
        Of the grid that the frame covers.
    left, top : int
        Cells before it.
    """

    columns: int
    rows: int
    left: int
    top: int

    @classmethod
    def of(cls, width: int, height: int) -> "Layout":
        """Return the layout of a frame of a size, px."""
        share = min(GRID[1] / width, GRID[0] / height)
        columns, rows = max(1, round(width * share)), max(1, round(height * share))
        return cls(columns, rows, (GRID[1] - columns) // 2, (GRID[0] - rows) // 2)

    def to_pixels(self, cells: Array, camera: Camera) -> Array:
        """Return the positions, px, of points of the grid, shape (..., 2): x, y, in cells of the planes."""
        offset, count = np.array([self.left, self.top]), np.array([self.columns, self.rows])
        return np.asarray((cells - offset) * [camera.width, camera.height] / count)

    def to_cells(self, points_px: Array, camera: Camera) -> Array:
        """Return the points of the grid at pixel positions, shape (..., 2): the inverse of `to_pixels`."""
        offset, count = np.array([self.left, self.top]), np.array([self.columns, self.rows])
        return np.asarray(points_px * count / [camera.width, camera.height] + offset)


def output_centres(camera: Camera) -> Array:
    """Return the pixel positions of the outputs' centres, shape (rows, columns, 2); some may lie off the frame."""
    x, y = (STRIDE * (np.arange(count) + 0.5) for count in reversed(CELLS))
    return Layout.of(camera.width, camera.height).to_pixels(np.stack(np.meshgrid(x, y), axis=-1), camera)


def camera_values(frame: Frame) -> Array:
    """Return what a network's range is checked by, in the order of `CAMERA`; the lights must be told."""
    camera, lights = frame.camera, frame.calibration.priors.lights / LIGHT_SCALE_MM
    layout = Layout.of(camera.width, camera.height)
    share = np.array([layout.columns / camera.width, layout.rows / camera.height])
    focal = np.log(share * [camera.fx, camera.fy] / GRID[1])
    off_centre = np.array([camera.cx / camera.width, camera.cy / camera.height]) - 0.5
    spread = np.sqrt(((lights - lights.mean(axis=0)) ** 2).sum(axis=1).mean())
    return np.array([*focal, *off_centre, *lights.mean(axis=0), spread])


def dense_inputs(frame: Frame) -> Image:
    """Return the planes of a frame, whose lights must be told and whose lens has no distortion, shape (10, 96, 128)."""
    camera = frame.camera
    layout = Layout.of(camera.width, camera.height)
    where = (slice(layout.top, layout.top + layout.rows), slice(layout.left, layout.left + layout.columns))
    planes = np.zeros((len(PLANES), *GRID), dtype=np.float32)
    planes[(slice(0, len(VIEWED)), *where)] = _viewed(frame, (layout.columns, layout.rows))
    x, y = (np.arange(count) + 0.5 for count in reversed(GRID))
    rays = camera.unproject(layout.to_pixels(np.stack(np.meshgrid(x, y), axis=-1), camera)).reshape(-1, 3)
    mean = frame.calibration.priors.lights.mean(axis=0) / LIGHT_SCALE_MM
    of_camera = [rays[:, 0], rays[:, 1], *(image_basis(rays) @ mean).T, -rays @ mean]
    planes[len(VIEWED) :] = np.reshape(of_camera, (-1, *GRID))
    return planes


def _viewed(frame: Frame, size: tuple[int, int]) -> Image:
    """Return the planes of light and colour on a grid of columns and rows, shape (5, rows, columns)."""
    channels = frame.channels if frame.channels.ndim == 3 else np.repeat(frame.channels[..., None], 3, axis=2)
    gain = frame.corrected.gain
    light = channels.mean(axis=2, dtype=np.float32) * (1 if gain is None else gain)
    seen = np.ones(light.shape, dtype=bool) if frame.seen is None else frame.seen
    weight = seen.astype(np.float32)
    share = _averaged(weight, size)
    known = share > LEAST_SEEN
    whole = np.where(known, share, 1.0)

    def mean(values: Image) -> Image:
        return np.asarray(_averaged(values * weight, size) / whole, dtype=np.float32)

    median = median_of_lit(light[seen])
    light = light / np.float32(median)
    logarithm = mean(np.log(light + DARKEST, dtype=np.float32))
    whole_light = mean(light)
    spread = np.log(whole_light + DARKEST) - logarithm
    lit = known & (whole_light > LEAST_LIT)
    red, green, blue = (mean(channels[..., k]) / median + DARKEST for k in range(3))
    colours = [_centred(np.log(other / green), lit) for other in (red, blue)]
    return np.asarray(np.stack([logarithm, spread, *colours, share]) * known, dtype=np.float32)


def _averaged(values: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _centred(values: Image, lit: Mask) -> Image:
    """Return values less those of the lit cells' median: albedo and white balance are no part of the shape."""
    return np.asarray(values - np.median(values[lit])) if lit.any() else values
