"""Bands of glitter by maximum quasi-likelihood: a flat background and gaussian rates of glinting pixels.

The share of glinting pixels is lambda = b + sum_k A_k exp(-|t|^2 / 2), t = v + T(v, v) / 2, v = L (u - u0): u are
angles in the plane across a band's centre, L its inverse extent, and T the gradient of a symmetric cubic, since the
curvature of an organ changes. What is minimised is sum (n lambda - y ln(n lambda)) / phi, phi the dispersion of the
counts; steps are Fisher's, damped.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import Array
from studies.bands.cells import Cells

MOST_BANDS = 6
LEAST_GAIN = 25.0
"""Twice the gain in log likelihood that another band must bring."""

CUBIC_SD = 0.25
"""Prior of each term of the cubic."""

START_RAD = (math.radians(4.0), math.radians(9.0))
"""Extents that a band starts from."""

LARGEST_RAD, SMALLEST_RAD = math.radians(35.0), math.radians(1.0)
FRONT = 0.3
"""A sightline whose cosine with a band's centre is below this is not in its plane."""

STEPS, CLOSE = 60, 1e-4
PER_BAND = 10
"""ln A, two of u0, three of L, four of T."""


@dataclass(frozen=True)
class Band:
    """A band: amplitude, unit sightline of its centre, shape in the plane across it, and what is known of these.

    `L`, (2, 2): lower triangular, rad^-1; `cubic`, (4,): T_111, T_112, T_122, T_222; `covariance`, (2, 2): of the
    centre in ``basis_across(centre)``, rad^2.
    """

    amplitude: float
    centre: Array
    L: Array
    cubic: Array
    covariance: Array

    def terms(self, sightlines: Array) -> tuple[Array, Array, Array, Array]:
        """Return u, v, t, shape (M, 2), and exp(-|t|^2 / 2), 0 where a sightline is not in front."""
        cosine = sightlines @ self.centre
        front = cosine > FRONT
        u = sightlines @ basis_across(self.centre).T / np.where(front, cosine, 1.0)[:, None]
        v = u @ self.L.T
        t = v + 0.5 * quadratic(self.cubic, v)
        rate = np.where(front, np.exp(-0.5 * np.minimum((t**2).sum(axis=1), 80.0)), 0.0)
        return u, v, t, rate

    @property
    def extents(self) -> Array:
        """Standard deviations along the principal directions, rad, the smaller first."""
        return np.asarray(1 / np.linalg.svd(self.L)[1])


def quadratic(cubic: Array, v: Array) -> Array:
    """Return T(v, v), shape (M, 2)."""
    a, b, c, d = cubic
    x, y = v.T
    return np.stack([a * x**2 + 2 * b * x * y + c * y**2, b * x**2 + 2 * c * x * y + d * y**2], axis=1)


@dataclass(frozen=True)
class Fit:
    """Bands over a background, and the log likelihood."""

    background: float
    bands: tuple[Band, ...]
    likelihood: float
    dispersion: float

    def rates(self, sightlines: Array) -> tuple[Array, Array]:
        """Return the rate of each band, shape (K, M), and the whole, shape (M,)."""
        each = np.array([band.amplitude * band.terms(sightlines)[3] for band in self.bands])
        each = each.reshape(len(self.bands), len(sightlines))
        return each, self.background + each.sum(axis=0)


def fit_bands(cells: Cells) -> Fit:
    """Add bands while each brings `LEAST_GAIN`, the best of several starts at a time."""
    phi = cells.dispersion
    n, y = cells.usable, cells.glints
    share = y.sum() / max(n.sum(), 1.0)
    fit = Fit(max(share, 1e-6), (), 0.0, phi)
    fit = replace(fit, likelihood=likelihood(cells, fit))
    while len(fit.bands) < MOST_BANDS and y.sum() > 0:
        tried = [refine(cells, with_start(fit, start)) for start in starts(cells, fit)]
        best = max(tried, key=lambda each: each.likelihood, default=fit)
        if 2 * (best.likelihood - fit.likelihood) < LEAST_GAIN:
            break
        fit = best
    return fit


def likelihood(cells: Cells, fit: Fit) -> float:
    """Return the log quasi-likelihood, with the prior of the cubics."""
    kept = cells.usable > 0
    rate = np.clip(fit.rates(cells.sightlines[kept])[1], 1e-9, None)
    n, y = cells.usable[kept], cells.glints[kept]
    value = float((y * np.log(rate) - n * rate).sum()) / fit.dispersion
    return value - sum(float((band.cubic**2).sum()) for band in fit.bands) / (2 * CUBIC_SD**2)


def with_start(fit: Fit, start: tuple[float, Array, float]) -> Fit:
    """Return a fit with one more round band: amplitude, centre, extent."""
    amplitude, centre, extent = start
    band = Band(amplitude, centre, np.eye(2) / extent, np.zeros(4), np.zeros((2, 2)))
    return replace(fit, bands=(*fit.bands, band))


def starts(cells: Cells, fit: Fit) -> list[tuple[float, Array, float]]:
    """Return where the counts exceed the fit most, smoothed to each extent: amplitude, centre, extent."""
    made = []
    rate = fit.rates(cells.sightlines)[1]
    excess = cells.glints - cells.usable * rate
    for extent in START_RAD:
        sample = cells.sightlines[::3]
        weights = np.exp((sample @ cells.sightlines.T - 1) / extent**2)
        expected = weights @ (cells.usable * np.maximum(rate, 1e-6))
        surprise = np.where(expected > 0, weights @ excess / np.sqrt(np.maximum(expected, 1e-9)), -np.inf)
        surprise[weights @ (cells.usable > 0) < 3] = -np.inf
        at = int(np.argmax(surprise))
        amplitude = float(weights[at] @ excess / max(weights[at] @ cells.usable, 1.0))
        made.append((max(1.5 * amplitude, 1e-3), sample[at], extent))
    return made


def refine(cells: Cells, fit: Fit) -> Fit:
    """Return the fit of most likelihood near a start, with the covariance of each centre."""
    kept = cells.usable > 0
    s, n, y = cells.sightlines[kept], cells.usable[kept], cells.glints[kept]
    fit, damping = replace(fit, likelihood=likelihood(cells, fit)), 1e-2
    for _ in range(STEPS):
        J, rate = jacobian(fit, s)
        score = J.T @ (y / rate - n) / fit.dispersion
        information = (J * (n / rate)[:, None]).T @ J / fit.dispersion
        for k, band in enumerate(fit.bands):
            at = slice(1 + PER_BAND * k + 6, 1 + PER_BAND * (k + 1))
            score[at] -= band.cubic / CUBIC_SD**2
            information[at, at] += np.eye(4) / CUBIC_SD**2
        gained = -1.0
        while damping < 1e6:
            step = np.linalg.solve(information + damping * np.diag(np.diag(information) + 1e-9), score)
            moved = stepped(fit, np.asarray(step, dtype=float))
            moved = replace(moved, likelihood=likelihood(cells, moved))
            gained = moved.likelihood - fit.likelihood
            if gained > 0:
                fit, damping = moved, max(damping / 5, 1e-6)
                break
            damping *= 5
        if not gained > CLOSE:
            break
    return with_covariances(fit, s, n)


def jacobian(fit: Fit, s: Array) -> tuple[Array, Array]:
    """Return d lambda over ln b and each band's terms, shape (M, 1 + 10 K), and lambda."""
    columns, rate = [np.full(len(s), fit.background)], np.full(len(s), fit.background)
    for band in fit.bands:
        u, v, t, value = band.terms(s)
        g = band.amplitude * value
        rate = rate + g
        a, b, c, d = band.cubic
        x, y = v.T
        # dt / dv, applied to t from the left.
        w = np.stack(
            [t[:, 0] * (1 + a * x + b * y) + t[:, 1] * (b * x + c * y),
             t[:, 0] * (b * x + c * y) + t[:, 1] * (1 + c * x + d * y)], axis=1,
        )  # fmt: skip
        columns.append(g)
        columns += list((g[:, None] * (w @ band.L)).T)
        columns += [-g * w[:, 0] * u[:, 0] * band.L[0, 0], -g * w[:, 1] * u[:, 0],
                    -g * w[:, 1] * u[:, 1] * band.L[1, 1]]  # fmt: skip
        columns += [
            -g * 0.5 * (t[:, 0] * x**2), -g * 0.5 * (2 * t[:, 0] * x * y + t[:, 1] * x**2),
            -g * 0.5 * (t[:, 0] * y**2 + 2 * t[:, 1] * x * y), -g * 0.5 * (t[:, 1] * y**2),
        ]  # fmt: skip
    return np.stack(columns, axis=1), np.maximum(rate, 1e-9)


def stepped(fit: Fit, step: Array) -> Fit:
    """Return a fit with its parameters moved: ln b, and each band's ln A, u0, ln L_11, L_21, ln L_22, T."""
    bands = []
    for k, band in enumerate(fit.bands):
        p = step[1 + PER_BAND * k : 1 + PER_BAND * (k + 1)]
        moved = band.centre + np.clip(p[1:3], -0.1, 0.1) @ basis_across(band.centre)
        centre = moved / np.linalg.norm(moved)
        L = np.array([[band.L[0, 0] * math.exp(np.clip(p[3], -0.5, 0.5)), 0.0],
                      [band.L[1, 0] + p[4], band.L[1, 1] * math.exp(np.clip(p[5], -0.5, 0.5))]])  # fmt: skip
        # The basis turns with the centre; what is left of that after a small step the next step mends.
        U, extents, V = np.linalg.svd(L)
        L = lower(U @ np.diag(np.clip(extents, 1 / LARGEST_RAD, 1 / SMALLEST_RAD)) @ V)
        amplitude = float(np.clip(band.amplitude * math.exp(np.clip(p[0], -1, 1)), 1e-6, 1.5))
        bands.append(Band(amplitude, centre, L, np.clip(band.cubic + p[6:], -1, 1), band.covariance))
    return replace(fit, background=max(fit.background * math.exp(np.clip(step[0], -1, 1)), 1e-7), bands=tuple(bands))


def lower(L: Array) -> Array:
    """Return the lower triangular matrix, with positive diagonal, of the same L^T L."""
    # L^T L = C^T C with C lower triangular: the Cholesky factor of the reversed matrix.
    reverse = np.array([[0.0, 1.0], [1.0, 0.0]])
    factor = np.linalg.cholesky(reverse @ (L.T @ L) @ reverse)
    return np.asarray(reverse @ factor.T @ reverse)


def with_covariances(fit: Fit, s: Array, n: Array) -> Fit:
    """Return a fit whose bands state the covariance of their centres, from the whole information."""
    J, rate = jacobian(fit, s)
    information = (J * (n / rate)[:, None]).T @ J / fit.dispersion
    for k in range(len(fit.bands)):
        at = np.arange(1 + PER_BAND * k + 6, 1 + PER_BAND * (k + 1))
        information[at, at] += 1 / CUBIC_SD**2
    covariance: Array = np.asarray(np.linalg.pinv(information, hermitian=True), dtype=float)
    bands = []
    for k, band in enumerate(fit.bands):
        own = slice(1 + PER_BAND * k + 1, 1 + PER_BAND * k + 3)
        bands.append(replace(band, covariance=covariance[own, own]))
    return replace(fit, bands=tuple(bands))
