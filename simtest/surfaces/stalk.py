"""A pedunculated polyp: a map of space that raises a mushroom from the wall; all derivatives in closed form.

With z the height over the polyp's foot along its axis a, x the vector across it, q = |x|^2 and h the polyp's height,

    lift:     z' = z + h E(q) psi(z),   E = exp(-(tau + tau^2)/2), tau = q / (2 s^2),   psi = exp(-(z / 2h)^4)
    stricture: x' = (1 - A g(z') w(q)) x,   g = exp(-((z' - 0.3 h) / 0.3 h)^4),   w = exp(-q^2 / l^4), l = 2.4 s

The lift raises a bump with steep sides, the stricture narrows it at the height of the neck and leaves the head above.
Both are invertible: d(z')/dz > 0, as h |psi'| < 0.77, and d(|x'|)/d|x| >= 1 - A > 0. So the wall cannot intersect
itself, whatever folds are at the polyp's position, and the origin of each point can be found. Far from the polyp both
are the identity to rounding. On the polyp the surface is no radius over the centreline: the head overhangs the neck.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simtest.geometry.vectors import dot
from simtest.runtime.arrays import Array, Mask
from simtest.surfaces.jets import Jet

NECK_AT = 0.3
NECK_REACH = 0.3
"""Height and half length of the neck, as shares of the polyp's height."""

ACROSS = 2.4
"""Reach of the stricture across the axis, over the bump's width s."""

LIFT_REACH = 2.0
"""Height at which the lift has fallen to 1/e, over the polyp's height."""

FAR = 40.0
"""With an exponent beyond this an exponential is below rounding."""

_STEPS = 80
_PROFILE = np.linspace(0.01, 0.9999, 4000)
"""Heights, as shares of the polyp's, at which its widths are looked up."""


@dataclass(frozen=True)
class Stalk:
    """The map of one polyp."""

    foot: Array  # (3,): point of the wall under the polyp, mm
    axis: Array  # (3,): unit vector into the lumen
    # height, width, depth: h and s, mm, and A
    height: float
    width: float
    depth: float

    @classmethod
    def of_size(cls, foot: Array, axis: Array, height: float, head: float, neck: float) -> "Stalk":
        """Return the polyp of a height and diameters of head and neck, mm, as measured on a flat wall."""
        # The radius is s times a function of A and z / h alone, so A follows from the ratio of the two diameters.
        narrow, wide = 0.0, 1.0
        for _ in range(_STEPS):
            depth = (narrow + wide) / 2
            at_neck, at_head = _widths(depth)
            if at_neck / at_head > neck / head:
                narrow = depth
            else:
                wide = depth
        return cls(foot, axis, height, head / 2 / _widths(narrow)[1], narrow)

    def apply(self, p: Jet) -> Jet:
        """Map a surface, shape (N, 3), mm, with its derivatives."""
        near = np.flatnonzero(self.moves(p.value))
        return p.with_rows(near, self._applied(p.rows(near))) if near.size else p

    def moves(self, points: Array) -> Mask:
        """Return which points, shape (N, 3), mm, are so near that the map moves them by more than rounding."""
        z, x = self._split(points)
        # Of E and w the latter reaches farther, and of g and psi.
        across, along = math.sqrt(FAR) * (ACROSS * self.width) ** 2, FAR**0.25 * LIFT_REACH * self.height
        return np.asarray((dot(x, x) < across) & (np.abs(z) < along))

    def _applied(self, p: Jet) -> Jet:
        # coordinates about the foot
        from_foot = p.affine(1.0, -self.foot)
        z = from_foot.along(self.axis)
        x = from_foot + z.outer(-self.axis)
        q = x.squared()
        # lift, then stricture
        raised = z + self._bump(q) * self._fading(z)
        narrowed = x + self._neck(raised) * self._reach(q) * x
        return narrowed + raised.outer(self.axis).affine(1.0, self.foot)

    def undo(self, points: Array) -> Array:
        """Return where points, shape (N, 3), mm, come from, to rounding."""
        # The stricture first, at the known height z'; then the lift, at the distance from the axis found there.
        z, x = self._split(points)
        length = np.linalg.norm(x, axis=1)
        g = self.depth * np.exp(-(((z / self.height - NECK_AT) / NECK_REACH) ** 4).clip(max=700))
        across = self.width * ACROSS

        def narrowed(r: Array) -> Array:
            return r * (1 - g * np.exp(-((r / across) ** 4).clip(max=700)))

        # x' is shorter than x, by a share of at most A.
        r = _bisect(narrowed, length, length, length / (1 - self.depth) + 1e-12)
        bump = self._bump(Jet(r * r)).value

        def raised(low: Array) -> Array:
            return low + bump * self._fading(Jet(low)).value

        source = _bisect(raised, z, z - self.height * bump, z)
        moved = (length > 0) & (r > 0)
        stretch = np.where(moved, r / np.where(moved, length, 1.0), 1.0)
        return self.foot + source[:, None] * self.axis + stretch[:, None] * x

    def _split(self, points: Array) -> tuple[Array, Array]:
        """Return z and x of points."""
        from_foot = points - self.foot
        z = from_foot @ self.axis
        return z, from_foot - z[:, None] * self.axis

    def _bump(self, q: Jet) -> Jet:
        """Return E."""
        tau = q.affine(1 / (2 * self.width**2))
        return (tau + tau * tau).affine(-0.5).exp()

    def _fading(self, z: Jet) -> Jet:
        """Return h psi(z); the wall outside, z < 0, is lifted as well, which makes no two walls intersect."""
        return _quartic(z.affine(1 / (LIFT_REACH * self.height))).affine(self.height)

    def _neck(self, z: Jet) -> Jet:
        """Return -A g(z)."""
        return _quartic(z.affine(1 / (NECK_REACH * self.height), -NECK_AT / NECK_REACH)).affine(-self.depth)

    def _reach(self, q: Jet) -> Jet:
        """Return w."""
        return (q * q).affine(-1 / (self.width * ACROSS) ** 4).exp()


def _quartic(x: Jet) -> Jet:
    """Return exp(-x^4)."""
    square = x * x
    return (square * square).affine(-1.0).exp()


def _widths(depth: float) -> tuple[float, float]:
    """Return the radii of neck and head on a flat wall, over the width s."""
    z = _PROFILE
    # Radius at which the lift E equals z, narrowed by the stricture
    tau = (np.sqrt(1 - 8 * np.log(z)) - 1) / 2
    r = np.sqrt(2 * tau)
    r *= 1 - depth * np.exp(-(((z - NECK_AT) / NECK_REACH) ** 4)) * np.exp(-((r / ACROSS) ** 4))
    # The head is the widest part above the neck, the neck the narrowest below the head.
    above = z > NECK_AT + NECK_REACH / 2
    head = int(np.argmax(np.where(above, r, 0.0)))
    return float(r[(z > NECK_AT / 3) & (z <= z[head])].min()), float(r[head])


def _bisect(function: Callable[[Array], Array], target: Array, low: Array, high: Array) -> Array:
    """Solve function(x) = target for a rising function between bounds, each of shape (N,)."""
    for _ in range(_STEPS):
        middle = (low + high) / 2
        below = function(middle) < target
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2
