"""Lens distortion: from directions to normalised image coordinates and back.

Normalised coordinates m are those that K maps to pixels; without distortion m = (x/z, y/z). Each model is used on its
first monotone branch only, from the optical axis outwards: beyond it the lens would fold over, and one pixel would see
two directions.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from simtest.errors import InputError
from simtest.geometry.checks import check_number
from simtest.runtime.arrays import Array, Mask

Curve = Callable[[Array], tuple[Array, Array]]

NEWTON_STEPS = 100

STEEPEST = 1e6
"""Largest tangent of a field angle for which a perspective lens is evaluated."""

CLOSE = 4 * float(np.finfo(float).eps)

NEAR = 1e-6
"""Within this share of the value Newton's steps are not watched: rounding stops them from getting nearer."""

REAL_ROOT = 1e-9
"""An imaginary part below this share of a root's size is rounding."""

ERROR_STEPS, SOLVED, ROUNDING = 8, 1e-3, 1e-12
"""Newton's steps to a sightline by a lens with a radial error, and the shares of the radius to which it is found: at
least (at a fold they halve the gap), and so near that the steps end."""


def check_finite(model: Any) -> None:
    """Raise `InputError` where a coefficient of a lens, a dataclass of numbers, is not finite."""
    for name, value in ((field.name, getattr(model, field.name)) for field in fields(model)):
        check_number(f"distortion.{name}", value)


def horner(coefficients: tuple[float, ...], u: Array) -> tuple[Array, Array]:
    """Return a polynomial's values, lowest coefficient first, and its slopes, by Horner's scheme."""
    value, slope = np.zeros_like(u), np.zeros_like(u)
    for coefficient in reversed(coefficients):
        value, slope = coefficient + value * u, value + slope * u
    return value, slope


def first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive real root of a polynomial that is 1 at 0; inf where there is none."""
    # The reversed polynomial, whose first coefficient is that 1, has the inverse roots: tiny last coefficients then
    # make roots near 0 instead of a companion matrix with huge entries.
    inverse = np.roots(polynomial.coef)
    real = np.real(inverse)[np.abs(np.imag(inverse)) <= REAL_ROOT * np.abs(inverse)]
    most = float(max(real, default=0.0))
    return 1 / most if most > 1 / STEEPEST**2 else np.inf


def invert(curve: Curve, value: Array, top: float, reach: float) -> Array:
    """Solve curve(x) = value >= 0 for x in [0, top), by Newton steps kept inside a bracket; NaN without a solution.

    The curve, which returns value and slope, is 0 at 0 and rises to `reach`, which may be inf, at `top`.
    """
    wanted = np.ravel(value).astype(float)
    found = np.full(wanted.shape, np.nan)
    open_ = np.flatnonzero((wanted < reach) & np.isfinite(wanted))
    # start: the identity, or the middle of the bracket
    low, high, target = np.zeros(len(open_)), np.full(len(open_), top), wanted[open_]
    x = np.minimum(target, 0.5 * high)
    # gaps of the last step and of the one before
    last, earlier = np.full((2, len(open_)), np.inf)
    for _ in range(NEWTON_STEPS):
        # narrow the bracket, then take Newton's step where it stays inside and does not go to and fro, else bisect
        reached, slope = curve(x)
        gap = reached - target
        low, high = np.where(gap < 0, x, low), np.where(gap > 0, x, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            after = x - gap / slope
        nearer = np.abs(gap) < np.maximum(earlier / 2, NEAR * target)
        after = np.where((after >= low) & (after <= high) & nearer, after, (low + high) / 2)
        # points leave the iteration as they converge
        done = (np.abs(after - x) <= CLOSE * x) | (np.abs(gap) <= CLOSE * target)
        found[open_[done]] = after[done]
        parts = (open_, target, low, high, after, np.abs(gap), last)
        open_, target, low, high, x, last, earlier = (part[~done] for part in parts)
        if not len(open_):
            break
    found[open_] = x
    return found.reshape(np.shape(value))


def _field_angle(P: Array) -> Array:
    """Return the angle of directions, shape (..., 3), off the optical axis, rad; NaN of no direction."""
    return np.where(np.abs(P).max(axis=-1) > 0, np.arctan2(np.hypot(P[..., 0], P[..., 1]), P[..., 2]), np.nan)


def _share(r: Array, P: Array, theta: Array) -> Array:
    """Return radii in the image over the distance of directions from the axis, by which these are multiplied."""
    across = np.hypot(P[..., 0], P[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        # On the axis the share is 0/0; the coordinates are 0 there whatever it is.
        return np.where((across == 0) & (theta == 0), 0.0, r / across)


@dataclass(frozen=True)
class BrownConrady:
    """Radial and tangential distortion of a perspective lens: OpenCV's models of 5 and of 8 coefficients.

    With x = X/Z, y = Y/Z, u = x^2 + y^2 and R = (1 + k1 u + k2 u^2 + k3 u^3) / (1 + k4 u + k5 u^2 + k6 u^3):
    m = (x R + 2 p1 x y + p2 (u + 2 x^2), y R + p1 (u + 2 y^2) + 2 p2 x y).

    Parameters
    ----------
    k1, k2, k3, k4, k5, k6 : float
        Radial coefficients; k4 to k6 are those of the denominator.
    p1, p2 : float
        Tangential coefficients.

    Raises
    ------
    InputError
        If a coefficient is not finite.

    Examples
    --------
    >>> import simtest
    >>> lens = simtest.BrownConrady(k1=-0.2)
    >>> camera = simtest.Camera(640, 480, 500.0, 500.0, 320.0, 240.0, distortion=lens)
    >>> camera.project([[1.0, 0.0, 10.0]]).round(2)
    array([[369.9, 240. ]])
    """

    type: ClassVar = "brown_conrady"

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self)

    @cached_property
    def limit(self) -> float:
        """End of the first monotone branch of the radial part: tangent of the field angle, at most 1e6."""
        return min(*self._turn_and_pole, STEEPEST)

    @cached_property
    def _turn_and_pole(self) -> tuple[float, float]:
        """Radii at which the slope of the radial part, and its denominator, vanish first; inf where they do not."""
        u = Polynomial([0.0, 1.0])
        above = Polynomial([1.0, self.k1, self.k2, self.k3])
        below = Polynomial([1.0, self.k4, self.k5, self.k6])
        # Numerator of the slope of sqrt(u) above/below.
        slope = (above + 2 * u * above.deriv()) * below - 2 * u * above * below.deriv()
        return float(np.sqrt(first_root(slope))), float(np.sqrt(first_root(below)))

    @cached_property
    def _reach(self) -> float:
        """Supremum of the radial part on its first branch: inf where the branch ends at a pole."""
        return np.inf if self._turn_and_pole[1] <= self.limit else float(self.radial(np.array(self.limit))[0])

    @property
    def limit_angle(self) -> float:
        """Field angle at which the radial part folds over, rad; almost pi/2 where it does not."""
        return float(np.arctan(self.limit))

    def distort(self, rays: npt.ArrayLike) -> Array:
        """Return the normalised image coordinates, shape (..., 2), of directions, shape (..., 3), of any length.

        They are NaN at 90 deg off the axis and more, and beyond the first monotone branch.
        """
        P = np.asarray(rays, dtype=float)
        z = np.where(P[..., 2] > 0, P[..., 2], np.nan)
        xy = P[..., :2] / z[..., None]
        with np.errstate(over="ignore", invalid="ignore"):
            m, jacobian = self._forward(xy)
            valid = self._on_branch(xy, jacobian)
        return np.asarray(np.where(valid[..., None], m, np.nan))

    def undistort(self, m: npt.ArrayLike) -> Array:
        """Return the unit directions, shape (..., 3), of normalised image coordinates, shape (..., 2).

        Found by Newton's method; NaN where no direction of the first monotone branch is seen.
        """
        target = np.asarray(m, dtype=float)
        radius = np.linalg.norm(target, axis=-1)
        # start: the radial part alone
        tangential = self.p1 != 0 or self.p2 != 0
        reach = radius
        if tangential:
            # Tangential terms may carry a point a little beyond what the radial part alone reaches.
            reach = np.minimum(radius, 0.99 * self._reach)
        inner = invert(self.radial, reach, self.limit, self._reach)
        with np.errstate(invalid="ignore", divide="ignore"):
            xy = np.where(radius[..., None] > 0, target * (inner / radius)[..., None], target)
        # refine: the tangential terms too
        if tangential:
            xy = self._polish(xy, target)
        rays = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        rays[np.isnan(xy).any(axis=-1)] = np.nan
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))

    def radial(self, r: Array) -> tuple[Array, Array]:
        """Return the radial part r R(r^2) and its slope."""
        u = r * r
        ratio, slope = self._ratio(u)
        return r * ratio, ratio + 2 * u * slope

    def radial_by_k1(self, r: Array) -> tuple[Array, Array]:
        """Return what k1 adds to the radial part per unit, and its slope."""
        u = r * r
        below, falling = horner((1.0, self.k4, self.k5, self.k6), u)
        return r * u / below, u * (3 - 2 * u * falling / below) / below

    def _ratio(self, u: Array) -> tuple[Array, Array]:
        """Return R(u) and its slope."""
        above, rising = horner((1.0, self.k1, self.k2, self.k3), u)
        if not (self.k4 or self.k5 or self.k6):
            return above, rising
        below, falling = horner((1.0, self.k4, self.k5, self.k6), u)
        ratio = above / below
        return ratio, (rising - ratio * falling) / below

    def _forward(self, xy: Array) -> tuple[Array, Array]:
        """Return m and the three entries of its symmetric Jacobian: xx, xy, yy, shape (..., 3)."""
        x, y = xy[..., 0], xy[..., 1]
        u = x * x + y * y
        R, slope = self._ratio(u)
        p1, p2 = self.p1, self.p2
        m = np.stack([x * R + 2 * p1 * x * y + p2 * (u + 2 * x * x), y * R + p1 * (u + 2 * y * y) + 2 * p2 * x * y], -1)
        jacobian = np.stack(
            [
                R + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
                2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
                R + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
            ],
            axis=-1,
        )
        return m, jacobian

    def _on_branch(self, xy: Array, jacobian: Array) -> Mask:
        """Return which points lie on the first monotone branch."""
        xx, mixed, yy = jacobian[..., 0], jacobian[..., 1], jacobian[..., 2]
        inside = np.hypot(xy[..., 0], xy[..., 1]) < self.limit
        # Both eigenvalues are positive on the axis; the first one to vanish ends the branch.
        return np.asarray(inside & (xx * yy - mixed * mixed > 0) & (xx + yy > 0))

    def _polish(self, xy: Array, target: Array) -> Array:
        """Refine the radial solution for the tangential terms by damped Newton steps; NaN where that fails."""
        start, wanted = xy.reshape(-1, 2), target.reshape(-1, 2)
        solution, scale = np.full_like(start, np.nan), 1 + np.linalg.norm(wanted, axis=1)
        active = np.flatnonzero(np.isfinite(start).all(axis=1))
        x = start[active]
        with np.errstate(all="ignore"):
            for _ in range(NEWTON_STEPS):
                m, jacobian = self._forward(x)
                xx, mixed, yy = jacobian.T
                gap = m - wanted[active]
                step = np.stack([yy * gap[:, 0] - mixed * gap[:, 1], xx * gap[:, 1] - mixed * gap[:, 0]], axis=1)
                step /= (xx * yy - mixed * mixed)[:, None]
                # A longer step could leave the branch.
                length = np.linalg.norm(step, axis=1)
                most = 0.2 * (0.1 + np.linalg.norm(x, axis=1))
                before = np.linalg.norm(x, axis=1)
                x = x - step * np.where(length > most, most / length, 1.0)[:, None]
                # One across the fold or pole ends half-way to it.
                reached = np.linalg.norm(x, axis=1)
                x *= np.where(reached < self.limit, 1.0, (before + self.limit) / (2 * reached))[:, None]
                done = length <= CLOSE * scale[active]
                solution[active[done]] = x[done]
                active, x = active[~done], x[~done]
                if not len(active):
                    break
            solution[active] = x
            m, jacobian = self._forward(solution)
            solved = self._on_branch(solution, jacobian) & (np.linalg.norm(m - wanted, axis=1) <= 1e-13 * scale)
        return np.where(solved[:, None], solution, np.nan).reshape(xy.shape)


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

    type: ClassVar = "scaramuzza"

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
        theta = _field_angle(P)
        share = _share(invert(self._angle, theta, self.limit, self.limit_angle), P, theta)
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

    type: ClassVar = "kannala_brandt"

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
        theta = _field_angle(P)
        r = self.radial(np.where(theta < self.limit_angle, theta, np.nan))[0]
        return np.asarray(P[..., :2] * _share(r, P, theta)[..., None])

    def undistort(self, m: npt.ArrayLike) -> Array:
        """Return unit directions as `BrownConrady.undistort` does."""
        target = np.asarray(m, dtype=float)
        radius = np.hypot(target[..., 0], target[..., 1])
        top = self.limit_angle
        if not any((self.k1, self.k2, self.k3, self.k4)):
            theta = np.where(radius < top, radius, np.nan)
        else:
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


Distortion = BrownConrady | KannalaBrandt | Scaramuzza


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
