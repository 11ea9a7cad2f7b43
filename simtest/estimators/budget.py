"""An estimate's uncertainty as a budget: named parts, each a covariance of the normal, and their sum.

A part is the covariance of the normal distribution whose 95 % region holds 95 % of the errors of that kind. For errors
that are normal this is their covariance; for a prior with heavy tails, such as that of a light somewhere beside the
camera, it is a little more (`equivalent_covariance`).
"""

import math
from collections.abc import Mapping

import numpy as np

from simtest.geometry import Array, chi_squared
from simtest.runtime.statistics import CONFIDENCE

PARTS = ("noise", "resolution", "shape", "light_offset", "camera", "distance", "response", "relief")
"""Names of the parts.

noise: the sensor's. resolution: pixel, smoothing, point spread, demosaicing and coding, as seen in the residuals.
shape: the drift over isovalues, where curvature changes inside the highlight. light_offset: a light beside the camera,
where it is not told. camera: focal length, centre and distortion, where they are guesses. distance: of the surface from
the camera. response: sharpening, encoding and falloff that nobody told. relief: its slope, where the base's normal is
stated from a single highlight.
"""

STATED = "stated"
"""Name of the one part of an estimate that states a covariance without a budget, as other packages' may."""

MISPLACED = ("noise", "resolution", "shape", "response", STATED)
"""Parts that stand for a highlight's brightest point lying elsewhere than where the normal looks."""

LARGEST_VARIANCE = math.pi**2
"""rad^2; no direction is less certain. What states more has other units."""

Budget = Mapping[str, Array]
"""Covariance of each part, shape (2, 2), rad^2, in the basis ``tangent_basis(normal)``."""


def total(budget: Budget) -> Array:
    """Return the sum of the parts, shape (2, 2), rad^2."""
    if not budget:
        return np.zeros((2, 2))
    # One by one, which for a few parts takes a third of the time of a sum over an axis.
    first, *others = budget.values()
    whole = np.array(first)
    for part in others:
        whole = whole + part
    return whole


def bounded(part: Array) -> Array:
    """Return a part of a budget, scaled down where it says more than that nothing is known of the direction."""
    size = float(np.abs(part).max())
    return part if not size > LARGEST_VARIANCE else part * (LARGEST_VARIANCE / size)


def dominant(budget: Budget) -> str:
    """Return the name of the largest part, by its trace."""
    return max(budget, key=lambda name: float(np.trace(budget[name])))


def deviations(budget: Budget) -> dict[str, float]:
    """Return the standard deviation of each part, rad: the square root of its trace."""
    return {name: float(np.sqrt(max(np.trace(part), 0.0))) for name, part in budget.items()}


def equivalent_covariance(moves: Array) -> Array:
    """Return the covariance whose 95 % region about 0 holds 95 % of moves of the normal, shape (N, 2), rad.

    It has the shape of their mean square.
    """
    square = moves.T @ moves / len(moves)
    # Moves along one line have a singular mean square.
    floor = 1e-9 * float(np.trace(square))
    if floor <= 0:
        return np.zeros((2, 2))
    distances = np.einsum("ni,ni->n", moves, np.linalg.solve(square + floor * np.eye(2), moves.T).T)
    return np.asarray(square * (quantile(distances, CONFIDENCE) / chi_squared.quantile(CONFIDENCE, 2)))


def quantile(values: Array, share: float) -> float:
    """Return the value below which a share of numbers, shape (n,), lies, as `np.quantile`, which loads `numpy.ma`."""
    if np.isnan(values.max()):
        return math.nan
    place = share * (len(values) - 1)
    below = int(place)
    low, high = np.partition(values, (below, min(below + 1, len(values) - 1)))[[below, min(below + 1, len(values) - 1)]]
    left = place - below
    return float(high - (high - low) * (1 - left) if left >= 0.5 else low + (high - low) * left)


def equivalent_variance(moves: Array) -> float:
    """Return the variance of errors along one line, shape (N,), rad, so that the region of a budget holds 95 % of them.

    Across the line the budget's other parts are met by normal errors, which take their share of the region's 95 %: with
    x the error and v the variance, x^2 / v plus a chi-squared variable of one degree of freedom stays below the
    quantile. For normal errors v is their variance.
    """
    squares = np.square(moves)
    if not squares.max() > 0:
        return 0.0
    limit = chi_squared.quantile(CONFIDENCE, 2)
    low, high = 0.0, float(squares.max())
    # Bisection: more variance holds more.
    for _ in range(60):
        v = (low + high) / 2
        left = limit - squares / max(v, 1e-300)
        held = float(np.mean(_below(left)))
        low, high = (v, high) if held < CONFIDENCE else (low, v)
    return high


def line_covariance(moves: Array) -> Array:
    """Return the covariance of moves that lie all but along one line, shape (N, 2), rad (see `equivalent_variance`)."""
    square = moves.T @ moves / len(moves)
    values, vectors = np.linalg.eigh(square)
    along = np.outer(vectors[:, 1], vectors[:, 1])
    return np.asarray(equivalent_variance(moves @ vectors[:, 1]) * along + square - values[1] * along)


_ROOTS = np.linspace(0.0, 4.0, 401)
_SHARES = np.array([math.erf(root / math.sqrt(2)) for root in _ROOTS.tolist()])


def _below(values: Array) -> Array:
    """Return the probability that a chi-squared variable of one degree of freedom stays below each value."""
    return np.interp(np.sqrt(np.maximum(values, 0.0)), _ROOTS, _SHARES)
