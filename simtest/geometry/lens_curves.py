"""Curves of lenses: their first fold, and their inverse by Newton's method."""

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial

from simtest.geometry.checks import check_number
from simtest.runtime.arrays import Array

Curve = Callable[[Array], tuple[Array, Array]]

NEWTON_STEPS = 100
STEEPEST = 1e6
"""Largest tangent of a field angle for which a perspective lens is evaluated."""

CLOSE = 4 * float(np.finfo(float).eps)
NEAR = 1e-6
"""Within this share of the value Newton's steps are not watched: rounding stops them from getting nearer."""

REAL_ROOT = 1e-9
"""An imaginary part below this share of a root's size is rounding."""


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
