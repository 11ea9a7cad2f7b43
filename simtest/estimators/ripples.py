"""Ripples: how isophotes depart from their ellipses, and what that says of an error of their centre.

Whatever disturbs a highlight's pixels, noise that demosaicing, coding or sharpening has correlated, a neighbour, a
texture or a relief below it, moves its isophotes in all harmonics of the direction phi from the centre alike, as far
as smoothing leaves them. Harmonics 0 to 2 are size, centre and ellipse, which a fit takes for the highlight's own. The
next ones remain: they are seen, and say how far the centre may be off, whatever the disturbance is.

Radii are relative to the ellipse's, so that a ripple of variance v in one direction stands for a covariance v E of the
centre, E the ellipse's second moments (its boundary is w^T E^-1 w = 1).
"""

from functools import lru_cache

import numpy as np

from simtest.geometry import Array, Index
from simtest.runtime.arrays import AnyArray

HARMONICS = np.array([4, 5, 6])
"""Harmonic 3 is left out: it comes with the drift of the centre, of which more is known, where curvature changes."""

BY_CHANCE = 2.0
"""Ripples of less than so many times the power that the sensor's noise makes say nothing: 6 % of highlights with noise
alone exceed it."""

BY_PIXELS = 3e-4
"""Power that linear interpolation between pixels leaves in a harmonic, times the fourth power of the radius in px."""

LARGEST_GAP = 3.0
"""A point of a cut isophote stands for so many mean distances between points at most."""

_ANGLES = (np.arange(256) + 0.5) * np.pi / 256


def ripples(tangents: Array, conics: Array, counts: Index) -> AnyArray:
    """Return the harmonics of isophotes' radii about their ellipses, relative to these, shape (K, 3), complex.

    Parameters
    ----------
    tangents : ndarray, shape (2, N)
        Points of all isophotes, one after the other.
    conics : ndarray, shape (K, 5)
        (a, b, c, d, e) of each isophote's a x^2 + b x y + c y^2 + d x + e y = 1.
    counts : ndarray of int, shape (K,)
        Points of each.

    Returns
    -------
    ndarray of complex, shape (K, 3)
        c - i s of the terms c cos(m phi) + s sin(m phi), m = 4, 5, 6.
    """
    a, b, c, d, e = conics.T
    h, determinant = b / 2, a * c - b * b / 4
    centre = np.array([h * e / 2 - c * d / 2, h * d / 2 - a * e / 2]) / determinant
    # In coordinates in which the ellipse is the unit circle: w = L^T (x - centre), A = L L^T.
    size = 1 - (d * centre[0] + e * centre[1]) / 2
    first = np.sqrt(a / size)
    across, last = h / size / first, np.sqrt(determinant / a / size)
    number = np.repeat(np.arange(len(counts)), counts)
    x, y = tangents - centre[:, number]
    u, v = first[number] * x + across[number] * y, last[number] * y
    phase, radius = np.arctan2(v, u), np.hypot(u, v)
    # Each point stands for half the gaps to its neighbours.
    order = np.argsort(phase + 8.0 * number)
    phase = phase[order]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ends = starts + counts - 1
    gaps = np.empty_like(phase)
    gaps[:-1] = phase[1:] - phase[:-1]
    gaps[ends] = 2 * np.pi + phase[starts] - phase[ends]
    gaps = np.minimum(gaps, (LARGEST_GAP * 2 * np.pi / counts)[number])
    before = np.roll(gaps, 1)
    before[starts] = gaps[ends]
    weighted = (gaps + before) / (2 * np.pi) * (radius[order] - 1)
    # exp(-i m phi) by products, which take a tenth of the time
    turn = ((u - 1j * v) / radius)[order]
    square = turn * turn
    fourth = square * square
    return np.asarray(np.add.reduceat(weighted * np.array([fourth, fourth * turn, fourth * square]), starts, axis=1).T)


def excess(
    each: AnyArray, weights: Array, levels: Array, by_noise: float, size_px2: float, smoothing_px: float
) -> float:
    """Return the variance of a combined centre that ripples beyond noise stand for, relative to the mean ellipse.

    Parameters
    ----------
    each : ndarray of complex, shape (K, 3)
        Of `ripples`.
    weights : ndarray, shape (K,)
        Of the isophotes' centres in the combined one.
    levels : ndarray, shape (K,)
        -ln t of each.
    by_noise : float
        Variance of the combined centre by the sensor's noise, relative to the mean ellipse.
    size_px2 : float
        Squared mean radius of the mean ellipse, px^2.
    smoothing_px : float
        Standard deviation of the smoothing, px.
    """
    # A contour's radius is relative to its own ellipse, whose size goes with the root of the level.
    share = np.sqrt(np.maximum(levels / levels.mean(), 0.0))
    power = np.abs((weights * share) @ each) ** 2 / 2
    radius2 = size_px2 / smoothing_px**2 if smoothing_px > 0 else np.inf
    known = BY_CHANCE * by_noise * spectrum(radius2) + BY_PIXELS / size_px2**2
    return max(float(np.mean(power - known)), 0.0)


def spectrum(radius2: float) -> Array:
    """Return the power of white noise in the harmonics over that in the first one, shape (3,).

    `radius2` is the squared radius over the squared width of the smoothing; inf where nothing was smoothed.

    Smoothed by a Gaussian of width s, noise on a circle of radius r has the correlation exp(-z (1 - cos phi)) with
    z = r^2 / 2 s^2. Its Fourier series are modified Bessel functions, I_m(z) / I_1(z).
    """
    if not np.isfinite(radius2) or radius2 > 2e4:
        return np.ones(len(HARMONICS))
    z = max(radius2 / 2, 1e-6)
    terms = _cosines() @ np.exp(z * (np.cos(_ANGLES) - 1))
    return np.asarray(np.maximum(terms[1:] / terms[0], 0.0))


@lru_cache(maxsize=1)
def _cosines() -> Array:
    return np.cos(np.outer(np.append(1, HARMONICS), _ANGLES))
