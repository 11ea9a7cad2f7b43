"""Goodness of a lobe's fit: whether it explains its pixels, and how far the normal depends on which are fitted."""

import math
from dataclasses import replace

import numpy as np

from simtest.calibration.frame import COLOURED
from simtest.estimators.lobe_fit import LobeFit, Model, fit_lobe
from simtest.estimators.lobe_models import ColocatedQuadric
from simtest.geometry import Array, Mask, chi_squared
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime.arrays import Index

RINGS, SECTORS = 6, 8
"""The lobe is divided by the model's intensity into rings of equally many pixels, each ring into sectors."""

MIN_IN_BIN = 8
LEVEL = 1e-3
"""A fit is a misfit if noise alone would leave as much structure in less than this share of fits."""

FLOOR = 2e-3
"""Structure below this share of the peak does not count: rendering and sampling leave as much."""

INNER = 0.5
"""Near the peak all smooth lobes agree: pixels above this share of it are fitted for comparison."""

CORRELATED_PX, SUMMED_DEVIATIONS = 4, 2.0
"""Coding and demosaicing correlate the noise of pixels this far apart along an axis at most. The sum of white noise's
correlations exceeds 1 by so many of its standard deviations once in 40 highlights."""


def is_misfit(fitted: LobeFit[ColocatedQuadric], observed: Array, clipped: Mask | None, noise: float | Array) -> bool:
    """Test whether the residuals hold more structure than the frame's noise: a chi-square test of their local means.

    A sum over single pixels would detect less, since misfits are smooth, and would need the noise to within a percent.
    Pixels have intensities `observed`, shape (m,), and noise of standard deviation `noise`; clipped ones are left out.
    """
    model, _ = fitted.model.evaluate()
    e, f = fitted.model.frame[:2]
    rays = fitted.model.rays
    kept = np.ones(len(model), dtype=bool) if clipped is None else ~clipped
    residual, level = (observed - model)[kept], model[kept]
    variance = np.broadcast_to(np.square(noise), model.shape)[kept]
    if len(residual) < RINGS * SECTORS * MIN_IN_BIN:
        return False
    # bins: rings by intensity, sectors by direction from the axis
    ring = np.searchsorted(np.quantile(level, np.arange(1, RINGS) / RINGS), level)
    angle = np.arctan2(rays[kept] @ f, rays[kept] @ e)
    sector = np.minimum(((angle + np.pi) / (2 * np.pi) * SECTORS).astype(int), SECTORS - 1)
    number = ring * SECTORS + sector
    count, total, spread = (
        np.bincount(number, weights, RINGS * SECTORS) for weights in (np.ones(len(number)), residual, variance)
    )
    # chi-square of the bins' means
    used = count >= MIN_IN_BIN
    mean = total[used] / count[used]
    allowed = spread[used] / count[used] ** 2 + (FLOOR * model.max()) ** 2
    return bool(np.sum(mean**2 / allowed) > chi_squared.quantile(1 - LEVEL, int(np.count_nonzero(used))))


def correlation_of_noise(
    fitted: LobeFit[Model], observed: Array, clipped: Mask | None, noise: float | Array, places: Index
) -> float:
    """Return by how much the noise's correlation between pixels raises a covariance of white residuals; 1: not at all.

    A smooth model takes from correlated noise the sum of its correlations over all distances. Both the smoothed frame's
    noise, `noise`, and the residuals must show more than chance; the larger one counts. `places` are the residuals'
    rows and columns, shape (2, m).
    """
    raised = float(np.mean(np.square(noise))) / max(fitted.sigma**2, 1e-300)
    if raised < COLOURED**2:
        return 1.0
    rows, columns = places - places.min(axis=1, keepdims=True)
    kept = np.ones(len(observed)) if clipped is None else (~clipped).astype(float)
    residual = kept * (observed - fitted.model.evaluate()[0])
    sums, pairs = (_products(values, rows, columns) for values in (residual, kept))
    summed = float((sums / np.maximum(pairs, 1.0)).sum()) / fitted.sigma**2
    chance = SUMMED_DEVIATIONS * math.sqrt((2 * CORRELATED_PX + 1) ** 2 / len(observed))
    return max(raised, summed) if summed > 1 + chance else 1.0


def _products(values: Array, rows: Index, columns: Index) -> Array:
    """Return the sums of products of values at pixels up to `CORRELATED_PX` apart along both axes."""
    grid = np.zeros((int(rows.max()) + 1 + CORRELATED_PX, int(columns.max()) + 1 + CORRELATED_PX))
    grid[rows, columns] = values
    products = np.fft.irfft2(np.abs(np.fft.rfft2(grid)) ** 2, s=grid.shape)
    near = np.arange(-CORRELATED_PX, CORRELATED_PX + 1)
    return np.asarray(products[np.ix_(near, near)])


def excess_of_misfit(fitted: LobeFit[ColocatedQuadric], observed: Array, clipped: Mask | None) -> float:
    """Return how far the normal moves, beyond noise, when only the pixels near the peak are fitted, squared, rad^2.

    It is 0 where these pixels alone do not determine a fit.
    """
    model, _ = fitted.model.evaluate()
    near = model > INNER * model.max()
    part = replace(fitted.model, rays=fitted.model.rays[near])
    inner = fit_lobe(part, observed[near], None if clipped is None else clipped[near])
    if inner is None:
        return 0.0
    moved = tangent_coordinates(fitted.model.normal, inner.model.normal)
    # The two fits share pixels: the variance of their difference is the difference of their variances.
    noise = float(np.trace(inner.covariance[:2, :2]) - np.trace(fitted.covariance[:2, :2]))
    return max(float(moved @ moved) - max(noise, 0.0), 0.0)
