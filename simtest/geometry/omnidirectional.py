"""Scaramuzza's lens for omnidirectional cameras, as OCamCalib, MATLAB's fisheye calibration and C3VD have it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from simtest.errors import InputError
from simtest.geometry.lens_curves import STEEPEST, check_finite, first_root, invert
from simtest.runtime.arrays import Array


@dataclass(frozen=True)
class Scaramuzza:
    """An omnidirectional lens: a polynomial gives the direction of each image point, and a matrix shears the image.

    The image point p = (x, y) sees the direction (x, y, f), f = 1 + k2 r^2 + k3 r^3 + k4 r^4 with r = abs(p), and lies
    at m = (c x + d y, e x + y) (Scaramuzza, Martinelli and Siegwart 2006, equations 3 to 6). In pixels that model is
    a0 + a2 r^2 + a3 r^3 + a4 r^4: so fx = fy = a0, k2 = a2 a0, k3 = a3 a0^2, k4 = a4 a0^3. With all k 0, c 1, d and e
    0 the lens is a pinhole. Angles of 90 deg and more are imaged like the others.

    Parameters
    ----------
    k2, k3, k4 : float
        Coefficients of the polynomial.
    c, d, e : float
        Entries of the matrix ((c, d), (e, 1)).

    Raises
    ------
    InputError
        If a number is not finite, or the matrix mirrors or flattens the image: c - d e is not positive.

    Examples
    --------
    >>> import simtest
    >>> lens = simtest.Scaramuzza(k2=-0.5)
    >>> camera = simtest.Camera(640, 480, 250.0, 250.0, 320.0, 240.0, distortion=lens)
    >>> camera.unproject([[570.0, 240.0]]).round(3)  # r = 1: the direction (1, 0, 1 - 0.5)
    array([[0.894, 0.   , 0.447]])
    """

    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    c: float = 1.0
    d: float = 0.0
    e: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self)
        if not self.c - self.d * self.e > 0:
            raise InputError(
                f"distortion.c = {self.c:g}, d = {self.d:g}, e = {self.e:g}: c - d e must be > 0, else the image is "
                "mirrored or flat"
            )

    @cached_property
    def limit(self) -> float:
        """End of the first monotone branch, as a radius r; at most 1e6."""
        # The angle atan2(r, f) rises while f - r f' > 0.
        return float(min(first_root(Polynomial([1.0, 0.0, -self.k2, -2 * self.k3, -3 * self.k4])), STEEPEST))

    @cached_property
    def limit_angle(self) -> float:
        """Field angle at the end of the first monotone branch, rad."""
        return float(self._angle(np.array(self.limit))[0])

    def distort(self, rays: npt.ArrayLike) -> Array:
        """Return image coordinates as `BrownConrady.distort` does, by Newton's method; NaN beyond the branch."""
        P = np.asarray(rays, dtype=float)
        across = np.hypot(P[..., 0], P[..., 1])
        theta = np.where(np.abs(P).max(axis=-1) > 0, np.arctan2(across, P[..., 2]), np.nan)
        r = invert(self._angle, theta, self.limit, self.limit_angle)
        with np.errstate(divide="ignore", invalid="ignore"):
            # On the axis the share is 0/0; the coordinates are 0 there whatever it is.
            share = np.where((across == 0) & (theta == 0), 0.0, r / across)
        x, y = P[..., 0] * share, P[..., 1] * share
        return np.stack([self.c * x + self.d * y, self.e * x + y], axis=-1)

    def undistort(self, m: npt.ArrayLike, errors: Array | float = 0.0) -> Array:
        """Return unit directions as `BrownConrady.undistort` does: exactly, by the polynomial itself.

        `errors` are added to k2, one for all or one for each.
        """
        u, v = np.moveaxis(np.asarray(m, dtype=float), -1, 0)
        determinant = self.c - self.d * self.e
        x, y = (u - self.d * v) / determinant, (self.c * v - self.e * u) / determinant
        r = np.hypot(x, y)
        r = np.where(r < self.limit, r, np.nan)
        rays = np.stack([x, y, self._polynomial(r) + errors * r * r], axis=-1)
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    @cached_property
    def _polynomial(self) -> Polynomial:
        return Polynomial([1.0, 0.0, self.k2, self.k3, self.k4])

    @cached_property
    def _slope(self) -> Polynomial:
        return self._polynomial.deriv()

    def _angle(self, r: Array) -> tuple[Array, Array]:
        """Return the field angles of radii, rad, and their slope."""
        f = self._polynomial(r)
        return np.arctan2(r, f), (f - r * self._slope(r)) / (r * r + f * f)
