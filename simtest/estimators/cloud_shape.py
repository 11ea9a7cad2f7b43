"""What the extent of a cloud tells: the axis ratio of the base's gains, and the slope of the relief (theory.md 7.1).

A cloud's covariance in the picture is M^-1 Sigma M^-T, M = I + dS of the base: one cloud does not tell M and Sigma
apart. With the gains 1 + d k told it gives the slope; with an isotropic relief its axis ratio is that of the gains.
"""

import math
from dataclasses import dataclass

import numpy as np

from simtest.calibration import Distribution, Uniform
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across
from simtest.runtime import chi_squared
from simtest.runtime.arrays import short_repr
from simtest.runtime.statistics import CONFIDENCE

BASE_KD = Uniform(-0.5, 1.0)
"""Distance times curvature of the base along both principal directions, where nobody told: a lumen's wall from inside
to a fold."""

LOBE_SHARE = 1.2
"""Spots are where the misfit is least, which is not always 0: their slopes' variance is the relief's and so many times
1 / c of the lobe."""

LOBE_RAD2 = Uniform(0.0, math.radians(1.5) ** 2)
"""1 / c of a lobe that nobody told: its variance along one direction."""

OUTLINE = 2.0
"""A cloud is drawn with so many standard deviations: 86 % of it is inside."""

SHARES = (np.arange(20) + 0.5) / 20
"""At these shares distributions are sampled."""

LEAST_SLOPE = math.radians(0.2)
"""No smaller slope is told from the lobe's width."""


@dataclass(frozen=True)
class Slope:
    """Slope of an isotropic relief along one direction, standard deviation, rad, with its 95 % interval.

    `told` says whether the base's gains were told; else they are a prior (`BASE_KD`).
    """

    value: float
    low: float
    high: float
    told: bool


@dataclass(frozen=True)
class CloudShape:
    """The cloud of highlights that an estimate of the base's normal stands on.

    Parameters
    ----------
    points_px : ndarray, shape (N, 2)
        The spots that belong to it, px.
    covariance : ndarray, shape (2, 2)
        Of one light's spots in the plane across the reversed normal at unit distance, rad^2, in
        ``basis_across(-normal)``.
    independent : float
        How many independent spots tell as much as these do.
    seen : float
        Part of the cloud that is in the view.
    lobe : Distribution
        1 / c of the lobe, rad^2.
    slope : Slope
        Of the relief.
    """

    points_px: Array
    covariance: Array
    independent: float
    seen: float
    lobe: Distribution
    slope: Slope

    __repr__ = short_repr

    @property
    def axis_ratio(self) -> float:
        """Minor over major axis of the cloud."""
        small, large = np.linalg.eigvalsh(self.covariance)
        return float(np.sqrt(small / large))

    def outline(self, normal: Array, look: Array) -> Array:
        """Return sightlines around the cloud, shape (N, 3): the ellipse of `OUTLINE` standard deviations.

        `normal` and `look` are the estimate's normal and the sightline that it looks along, unit, shape (3,).
        """
        values, vectors = np.linalg.eigh(self.covariance)
        phase = np.linspace(0, 2 * np.pi, 73)
        ring = np.stack([np.cos(phase), np.sin(phase)], axis=1)
        across = OUTLINE * ring @ (np.sqrt(values)[:, None] * vectors.T) @ basis_across(-normal)
        around = look / (look @ -normal) + across
        return np.asarray(around / np.linalg.norm(around, axis=1)[:, None])


def slope_of(
    covariance: Array, independent: float, lobe: Distribution, gains: tuple[float, float] | None = None
) -> Slope:
    """Return the slope of an isotropic relief from a cloud's covariance, shape (2, 2), rad^2.

    `independent`: number of independent spots; `lobe`: 1 / c of the lobe; `gains`: 1 + d k of the base; the larger one
    lies across the cloud's longer axis. None: not told.
    """
    small, large = np.linalg.eigvalsh(covariance)
    freedom = max(2 * round(independent - 1), 2)
    if gains is not None:
        low, high, weights = *(np.array([gain]) for gain in sorted(abs(gain) for gain in gains)), np.ones(1)
    else:
        first, second = (grid.ravel() for grid in np.meshgrid(*[1 + BASE_KD.quantile(SHARES)] * 2))
        low, high = np.minimum(first, second), np.maximum(first, second)
        # Gains that fit the axis ratio count most: its log has about this variance.
        off = np.log(small / large) / 2 + np.log(high / low)
        weights = np.exp(-(off**2) * freedom / 4)
    squares = (small * high**2 + large * low**2) / 2
    # The sample's variance over the true one is chi-squared.
    chance = freedom / np.array([chi_squared.quantile(share, freedom) for share in SHARES])
    all_squares = squares[:, None, None] * chance[:, None] - LOBE_SHARE * lobe.quantile(SHARES)
    all_weights = np.broadcast_to(weights[:, None, None], all_squares.shape).ravel()
    order = np.argsort(all_squares, axis=None)
    share = np.cumsum(all_weights[order]) / all_weights.sum()
    ends = all_squares.ravel()[order][np.searchsorted(share, [(1 - CONFIDENCE) / 2, 0.5, (1 + CONFIDENCE) / 2])]
    lower, middle, upper = np.sqrt(np.maximum(ends, LEAST_SLOPE**2)).tolist()
    return Slope(middle, lower, upper, gains is not None)
