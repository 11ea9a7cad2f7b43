"""The perspective lens: OpenCV's radial and tangential distortion."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial

from simtest.geometry.lens_curves import CLOSE, NEWTON_STEPS, STEEPEST, check_finite, first_root, horner, invert
from simtest.runtime.arrays import Array, Mask


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
