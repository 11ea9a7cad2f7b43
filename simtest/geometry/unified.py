"""Mei's lens for omnidirectional cameras, as OpenCV's omnidir module and Kalibr's omni have it."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry.lens_curves import check_finite
from simtest.geometry.perspective import BrownConrady
from simtest.runtime.arrays import Array


@dataclass(frozen=True)
class Mei:
    """An omnidirectional lens: a point of the unit sphere, seen from xi behind its centre, through a perspective lens.

    The unit direction (x, y, z) is imaged at (x, y) / (z + xi), which the radial and tangential terms of `BrownConrady`
    distort (Mei and Rives 2007). With xi 0 it is that lens; with xi 1 it is stereographic.

    Parameters
    ----------
    xi : float
        Distance of the projection centre behind the sphere's; not negative.
    k1, k2, p1, p2 : float
        As of `BrownConrady`.

    Raises
    ------
    InputError
        If a number is not finite, or xi is negative.

    Examples
    --------
    >>> import simtest
    >>> lens = simtest.Mei(xi=1.0)
    >>> camera = simtest.Camera(640, 480, 250.0, 250.0, 320.0, 240.0, distortion=lens)
    >>> camera.project([[1.0, 0.0, 0.0]])  # tan(45 deg) = 1
    array([[570., 240.]])
    """

    xi: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self)
        if self.xi < 0:
            raise InputError(f"distortion.xi = {self.xi:g}: must be >= 0")

    @cached_property
    def _flat(self) -> BrownConrady:
        """The perspective lens behind the sphere."""
        return BrownConrady(self.k1, self.k2, self.p1, self.p2)

    @property
    def _lowest(self) -> float:
        """Cosine of the field angle at which the sphere's image folds over, or goes to infinity."""
        return -1 / self.xi if self.xi > 1 else -self.xi

    @cached_property
    def limit_angle(self) -> float:
        """End of the first monotone branch, rad."""
        r, most = self._flat.limit, math.acos(self._lowest)
        under = 1 + (1 - self.xi**2) * r * r
        if under < 0:
            return most
        share = (self.xi + math.sqrt(under)) / (1 + r * r)
        return min(most, math.atan2(share * r, share - self.xi))

    def distort(self, rays: npt.ArrayLike) -> Array:
        """Return image coordinates as `BrownConrady.distort` does; NaN beyond the branch."""
        P = np.asarray(rays, dtype=float)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = P / np.linalg.norm(P, axis=-1, keepdims=True)
        seen = unit[..., 2] > self._lowest
        shifted = unit + np.array([0.0, 0.0, self.xi])
        return self._flat.distort(np.where(seen[..., None], shifted, np.nan))

    def undistort(self, m: npt.ArrayLike) -> Array:
        """Return unit directions as `BrownConrady.undistort` does; NaN where no direction is seen."""
        flat = self._flat.undistort(m)
        x, y = flat[..., 0] / flat[..., 2], flat[..., 1] / flat[..., 2]
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            share = (self.xi + np.sqrt(1 + (1 - self.xi**2) * r2)) / (1 + r2)
        return np.stack([share * x, share * y, share - self.xi], axis=-1)
