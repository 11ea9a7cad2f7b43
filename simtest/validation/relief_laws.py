"""Laws of the glints on a gaussian relief, light and camera together (theory.md section 7).

Lengths in mm, slopes in rad per axis. The gains are m = 1 + d k of the base's principal curvatures.
"""

import math

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array

Gains = tuple[float, float]
"""1 + d k of both principal curvatures of the base."""

NODES = 48
"""Of the quadrature along each of the Hessian's three independent components."""

CENTROID_FACTORS = (1.3, 1.8)
"""What stands in place of 1.25 in `independent_centroid_error` for glints of one relief, from and to (7.5)."""


def glint_count(slope: float, wavelength: float, distance: float, gains: Gains = (1.0, 1.0)) -> float:
    """Return the expected number of glints of a whole cloud: E abs(det(M/d - H)) d^2 / abs(det M) (7.2).

    The Hessian H of an isotropic field is independent of its slope at a point. With m4 = 2 slope^2 (2 pi/wavelength)^2
    its mean (H11 + H22)/2 has variance m4/4, its half-difference and H12 have m4/8 each. The expectation is exact but
    for its quadrature.
    """
    m4 = 2 * slope**2 * (2 * math.pi / wavelength) ** 2
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    weights = weights / weights.sum()
    mean, half, mixed = np.meshgrid(
        nodes * math.sqrt(m4 / 4), nodes * math.sqrt(m4 / 8), nodes * math.sqrt(m4 / 8), indexing="ij"
    )
    first, second = (gain / distance for gain in gains)
    determinant = (first - mean - half) * (second - mean + half) - mixed**2
    expected = np.einsum("i,j,k,ijk->", weights, weights, weights, np.abs(determinant))
    return float(expected * distance**2 / abs(gains[0] * gains[1]))


def cloud_covariance(slope: float, distance: float, gains: Gains = (1.0, 1.0)) -> Array:
    """Return the covariance of a cloud of glints in the base's tangent plane, mm^2: d^2 M^-1 Sigma M^-T (7.1)."""
    return np.diag([(distance * slope / gain) ** 2 for gain in gains])


def cloud_axis_ratio(gains: Gains) -> float:
    """Return the minor over the major axis of a cloud on isotropic relief (7.1)."""
    low, high = sorted(abs(gain) for gain in gains)
    return low / high


def relief_error(slope: npt.ArrayLike) -> Array:
    """Return the mean error of a glint's fine normal against the base's at the same point, rad (7.4).

    sqrt(pi/2) s, about 1.25 s, the mean of a Rayleigh distribution: over all glints of a cloud that is wholly in view,
    whatever the estimator, the curvature and the distance. `slope` is s, the standard deviation of an isotropic
    gaussian relief's slope along one direction, rad.
    """
    return np.asarray(np.sqrt(np.pi / 2) * np.asarray(slope, float))


def relief_error_share(error: npt.ArrayLike, slope: npt.ArrayLike) -> Array:
    """Return the share of a cloud's glints whose error against the base is below `error`, rad (7.4).

    Rayleigh: 1 - exp(-(error/s)^2 / 2); `slope` as in `relief_error`.
    """
    return np.asarray(-np.expm1(-((np.asarray(error, float) / np.asarray(slope, float)) ** 2) / 2))


def independent_centroid_error(slope: npt.ArrayLike, count: npt.ArrayLike, gains: Gains = (1.0, 1.0)) -> Array:
    """Return the mean error of the mean sightline of so many glints, rad, if they were independent (7.5).

    1.25 s / sqrt(N) on a plane. A glint's sightline is off the base's highlight by M^-1 times its slope (7.1), so on a
    bent base it is E abs(M^-1 g) / sqrt(N) of a gaussian g, a complete elliptic integral. Glints of one relief are not
    independent; `CENTROID_FACTORS` hold what was measured in place of 1.25.
    """
    from scipy.special import ellipe

    low, high = sorted(abs(gain) for gain in gains)
    mean = math.sqrt(2 / math.pi) * float(ellipe(1 - (low / high) ** 2)) / low
    return np.asarray(mean * np.asarray(slope, float) / np.sqrt(np.asarray(count, float)))
