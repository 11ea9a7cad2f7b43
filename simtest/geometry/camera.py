"""The pinhole camera: pixels to unit sightlines and back, pixel centres at integer + 0.5."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the OpenCV frame (x right, y down, z forward).

    Parameters
    ----------
    width, height : int
        Image size, px.
    fx, fy : float
        Focal lengths, px; positive.
    cx, cy : float
        Principal point, px, pixel centres at integer + 0.5.
    skew : float
        Skew, px.

    Raises
    ------
    InputError
        If the size is not positive, a number is not finite, or K is singular.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise InputError(f"camera.{name} = {value!r}: must be an integer >= 1")
        for name in ("fx", "fy", "cx", "cy", "skew"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float | np.number) or not np.isfinite(value):
                raise InputError(f"camera.{name} = {value!r}: must be a finite number")
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(f"camera.{name} = {getattr(self, name)!r}: must be > 0, else K is singular")

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike, width: int, height: int) -> "Camera":
        """Make a camera from its calibration matrix.

        Parameters
        ----------
        matrix : array_like, shape (3, 3)
            K, upper triangular with K[2, 2] = 1, px, pixel centres at integer + 0.5.
        width, height : int
            Image size, px.

        Raises
        ------
        InputError
            If K has another shape, is not upper triangular or is singular.
        """
        try:
            K = np.asarray(matrix, dtype=float)
        except (TypeError, ValueError):
            raise InputError("K: must be a (3, 3) array of numbers") from None
        if K.shape != (3, 3):
            raise InputError(f"K has shape {K.shape}: must be (3, 3)")
        if not np.allclose([K[1, 0], K[2, 0], K[2, 1], K[2, 2]], [0, 0, 0, 1]):
            raise InputError(f"K = {K.tolist()}: must be upper triangular with K[2][2] = 1")
        fx, fy, cx, cy, skew = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2), (0, 1)))
        return cls(width, height, fx, fy, cx, cy, skew)

    @classmethod
    def from_fov(cls, fov_deg: float, width: int, height: int) -> "Camera":
        """Make a camera with square pixels from its horizontal field of view, deg, in (0, 180).

        Raises
        ------
        InputError
            If the angle is out of range.
        """
        if isinstance(fov_deg, bool) or not isinstance(fov_deg, int | float) or not 0 < fov_deg < 180:
            raise InputError(f"fov = {fov_deg!r}: must be between 0 and 180 deg")
        focal = float(width / 2 / np.tan(np.radians(fov_deg) / 2))
        return cls(width, height, focal, focal, width / 2, height / 2)

    @cached_property
    def K(self) -> Array:
        """Calibration matrix, shape (3, 3), px."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def unproject(self, points_px: npt.ArrayLike) -> Array:
        """Give the unit sightlines of pixels.

        Parameters
        ----------
        points_px : array_like, shape (..., 2)
            Pixel positions (x, y).

        Returns
        -------
        ndarray, shape (..., 3)
            Unit vectors in the camera frame.
        """
        points = np.asarray(points_px, dtype=float)
        y = (points[..., 1] - self.cy) / self.fy
        x = (points[..., 0] - self.cx - self.skew * y) / self.fx
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def project(self, points: npt.ArrayLike) -> Array:
        """Give the pixels of points or directions in front of the camera.

        Parameters
        ----------
        points : array_like, shape (..., 3)
            Points in the camera frame, any length unit.

        Returns
        -------
        ndarray, shape (..., 2)
            Pixel positions (x, y); NaN where z <= 0.
        """
        P = np.asarray(points, dtype=float)
        z = np.where(P[..., 2] > 0, P[..., 2], np.nan)
        x, y = P[..., 0] / z, P[..., 1] / z
        return np.stack([self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy], axis=-1)

    def pixel_centres(self) -> Array:
        """Give the centres of all pixels, shape (height, width, 2), px."""
        x = np.arange(self.width) + PIXEL_CENTRE
        y = np.arange(self.height) + PIXEL_CENTRE
        return np.stack(np.meshgrid(x, y), axis=-1)

    def contains(self, points_px: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        """Tell which pixel positions, shape (..., 2), lie inside the image."""
        points = np.asarray(points_px, dtype=float)
        inside = (points >= 0) & (points <= [self.width, self.height])
        return np.asarray(inside.all(axis=-1))
