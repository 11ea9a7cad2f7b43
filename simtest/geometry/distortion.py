"""Lens distortion: from directions to normalised image coordinates and back.

Normalised coordinates m are those that K maps to pixels; without distortion m = (x/z, y/z). Each model is used on its
first monotone branch only, from the optical axis outwards: beyond it the lens would fold over, and one pixel would see
two directions.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from simtest.geometry.lens_curves import check_finite, first_root, horner, invert
from simtest.geometry.omnidirectional import Scaramuzza
from simtest.geometry.perspective import BrownConrady
from simtest.runtime.arrays import Array


@dataclass(frozen=True)
class KannalaBrandt:
    """A fisheye lens: OpenCV's fisheye model (ROS: equidistant).

    With theta the angle off the optical axis and phi the direction around it,
    m = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (cos phi, sin phi). With all coefficients 0 the
    lens is equidistant. Angles of 90 deg and more are imaged like the others.

    Parameters
    ----------
    k1, k2, k3, k4 : float
        Coefficients.

    Raises
    ------
    InputError
        If a coefficient is not finite.

    Examples
    --------
    >>> import simtest
    >>> fisheye = simtest.KannalaBrandt()
    >>> camera = simtest.Camera(640, 480, 200.0, 200.0, 320.0, 240.0, distortion=fisheye)
    >>> camera.project([[1.0, 0.0, 0.5]]).round(1)  # 63 deg off the axis
    array([[541.4, 240. ]])
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self)

    @cached_property
    def limit_angle(self) -> float:
        """End of the first monotone branch, rad; pi where it does not fold over."""
        slope = Polynomial([1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4])
        return float(min(np.pi, np.sqrt(first_root(slope))))

    def distort(self, rays: npt.ArrayLike) -> Array:
        """Return image coordinates as `BrownConrady.distort` does; NaN beyond the branch, and straight behind."""
        P = np.asarray(rays, dtype=float)
        across = np.hypot(P[..., 0], P[..., 1])
        theta = np.arctan2(across, P[..., 2])
        theta = np.where((theta < self.limit_angle) & (np.abs(P).max(axis=-1) > 0), theta, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = self.radial(theta)[0] / across
        # On the axis the share is 0/0; the coordinates are 0 there whatever it is.
        share = np.where((across == 0) & (theta == 0), 0.0, share)
        return np.asarray(P[..., :2] * share[..., None])

    def undistort(self, m: npt.ArrayLike) -> Array:
        """Return unit directions as `BrownConrady.undistort` does."""
        target = np.asarray(m, dtype=float)
        radius = np.hypot(target[..., 0], target[..., 1])
        top = self.limit_angle
        theta = invert(self.radial, radius, top, float(self.radial(np.array(top))[0]))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(radius > 0, np.sin(theta) / radius, theta)
        return np.concatenate([target * share[..., None], np.cos(theta)[..., None]], axis=-1)

    def radial(self, theta: Array) -> tuple[Array, Array]:
        """Return abs(m) at field angles, and its slope."""
        u = theta * theta
        factor, slope = horner((1.0, self.k1, self.k2, self.k3, self.k4), u)
        return theta * factor, factor + 2 * u * slope

    def radial_by_k1(self, theta: Array) -> tuple[Array, Array]:
        """Return what k1 adds to abs(m) per unit, and its slope."""
        u = theta * theta
        return theta * u, 3 * u


ERROR_STEPS, SOLVED, ROUNDING = 8, 1e-3, 1e-12
"""Newton's steps to a sightline by a lens with a radial error, and the shares of the radius to which it is found: at
least (at a fold they halve the gap), and so near that the steps end."""

Distortion = BrownConrady | KannalaBrandt | Scaramuzza

LENSES: dict[str, type[Distortion]] = {
    "brown_conrady": BrownConrady,
    "kannala_brandt": KannalaBrandt,
    "scaramuzza": Scaramuzza,
}
"""Lenses by the names that they have in files."""


def with_radial_error(lens: Distortion, error: float, edge_reach: float) -> tuple[Distortion, float]:
    """Return a lens whose k1 is larger by an error, and its focal length over the former's."""
    at_axis = float(_at_axis(np.array(error), edge_reach))
    # To first order k2 of the polynomial moves a point as k1 of the other lenses does.
    name = "k2" if isinstance(lens, Scaramuzza) else "k1"
    return replace(lens, **{name: getattr(lens, name) + error / at_axis}), at_axis


def undistort_with_errors(lens: Distortion, m: Array, errors: Array, edge_reach: float, near: Array) -> Array:
    """Return the unit directions, shape (N, 3), of image coordinates, shape (N, 2), by lenses `with_radial_error`.

    One error, shape (N,), each; NaN where its lens sees none. Tangential terms are those of the direction `near`.
    """
    at_axis = _at_axis(errors, edge_reach)
    points, shares = m / at_axis[:, None], errors / at_axis
    if isinstance(lens, Scaramuzza):
        return lens.undistort(points, shares)
    across = float(np.hypot(near[0], near[1]))
    reach = across / near[2] if isinstance(lens, BrownConrady) else np.arctan2(across, near[2])
    # An error moves a fold, but not so far as to where the lens may rise again.
    top = 1.5 * lens.limit if isinstance(lens, BrownConrady) else min(1.5 * lens.limit_angle, np.pi)
    tangential = lens.distort(near) - lens.radial(np.array(reach))[0] * near[:2] / max(across, 1e-12)
    points = points - tangential
    radius = np.hypot(*points.T)
    # Newton's steps from below, where the curves bend least
    found = np.minimum(np.full(len(m), reach / 2), radius)
    with np.errstate(all="ignore"):
        for _ in range(ERROR_STEPS):
            (value, slope), (more, steeper) = lens.radial(found), lens.radial_by_k1(found)
            gap, slope = value + shares * more - radius, slope + shares * steeper
            found = found - gap / slope
            if (np.abs(gap) <= ROUNDING * radius).all():
                break
        solved = (np.abs(gap) <= SOLVED * radius) & (slope > 0) & (found >= 0) & (found < top)
        ends = (found, np.ones(len(m))) if isinstance(lens, BrownConrady) else (np.sin(found), np.cos(found))
        shares = np.where(radius > 0, ends[0] / radius, 1.0)
        rays = np.concatenate([points * shares[:, None], ends[1][:, None]], axis=1)
        return np.where(solved[:, None], rays / np.linalg.norm(rays, axis=1, keepdims=True), np.nan)


def _at_axis(errors: Array, edge_reach: float) -> Array:
    """Return the focal lengths of lenses with radial errors over that of the lens without one."""
    return np.maximum(1 - errors * edge_reach**2, 0.3)


def lens_name(lens: Distortion) -> str:
    """Return the name that a lens has in files."""
    return next(name for name, kind in LENSES.items() if isinstance(lens, kind))
