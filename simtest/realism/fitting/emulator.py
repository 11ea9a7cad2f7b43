"""What a frame of given parameters shows: the mean of its summaries and their spread, learnt from a bank.

The mean of each summary is a quadratic form of the parameters, fitted by ridge regression; the covariance about it is
the same for all parameters. It is taken from residuals of folds that the regression did not see, so that what the
form misses counts as spread.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.bank import Bank
from simtest.runtime.arrays import Array, IntArray

LIMIT = 4.0
"""Summaries are clipped at so many of the bank's deviations from its mean, in the bank and in frames alike."""

FOLDS = 5

PENALTIES = np.geomspace(1e-4, 1e2, 13)
"""Ridge penalties that are tried, shares of the number of pictures."""

MIXED_PENALTY = 5.0
"""Products of two parameters are penalised so much more than one alone: there are many of them."""

SHRINKAGE = 0.05
"""Share by which correlations are drawn to 0: some summaries nearly say the same."""

LEAST_VARIANCE = 0.05
"""Least variance of standardised residuals along any direction."""

LEAST_RADIANCES = 20
"""A smaller bank has too few radiances for folds."""


@dataclass(frozen=True)
class Emulator:
    """Mean and spread of a frame's summaries, in units of the bank's deviations.

    Parameters
    ----------
    centre, scale : ndarray, shape (S,)
        The bank's mean and deviation of each summary.
    weights : ndarray, shape (F, S)
        Of the features of `features`, standardised summaries.
    covariance : ndarray, shape (S, S)
        Of the residuals of a picture.
    error : ndarray, shape (S, S)
        Covariance of the errors of `mean`, over the ranges.
    draws : ndarray, shape (R, F, S)
        Errors of `weights`, as the bank's radiances leave them.
    """

    centre: Array
    scale: Array
    weights: Array
    covariance: Array
    error: Array
    draws: Array

    @property
    def parameters(self) -> int:
        """Number of parameters P; there are 1 + P + P + P (P - 1) / 2 features."""
        return int((np.sqrt(9 + 8 * (len(self.weights) - 1)) - 3) / 2)

    def standardised(self, summaries: Array) -> Array:
        """Return summaries, shape (N, S), in the bank's deviations, clipped."""
        return np.asarray(np.clip((summaries - self.centre) / self.scale, -LIMIT, LIMIT))

    def mean(self, shares: Array) -> Array:
        """Return the mean summaries at parameters, shape (N, P) -> (N, S)."""
        return np.asarray(features(shares) @ self.weights)

    def slopes(self, shares: Array) -> Array:
        """Return the derivative of the mean by each parameter, shape (P,) -> (P, S)."""
        return np.asarray(_feature_slopes(shares) @ self.weights)

    @cached_property
    def bends(self) -> Array:
        """The second derivatives of the mean, the same at all parameters, shape (P, P, S)."""
        count = self.parameters
        first, second = np.triu_indices(count, k=1)
        bends = np.zeros((count, count, self.weights.shape[1]))
        bends[np.arange(count), np.arange(count)] = 8 * self.weights[1 + count : 1 + 2 * count]
        bends[first, second] = bends[second, first] = 4 * self.weights[1 + 2 * count :]
        return bends

    @property
    def deviation(self) -> Array:
        """The deviation of a picture's summaries about their mean, shape (S,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def redrawn(self, number: int) -> "Emulator":
        """Return the emulator of another bank of the same size."""
        return replace(self, weights=self.weights + self.draws[number])


def features(shares: Array) -> Array:
    """Return the constant, each parameter, its square and products of two, shape (N, P) -> (N, F)."""
    x = 2 * np.atleast_2d(shares) - 1
    first, second = np.triu_indices(x.shape[1], k=1)
    # Squares less their mean over the range, so that penalties leave the constant alone.
    return np.hstack([np.ones((len(x), 1)), x, x**2 - 1 / 3, x[:, first] * x[:, second]])


def _feature_slopes(shares: Array) -> Array:
    """Return the derivatives of `features` by each share, shape (P,) -> (P, F)."""
    x = 2 * np.asarray(shares) - 1
    count = len(x)
    first, second = np.triu_indices(count, k=1)
    mixed = np.zeros((count, len(first)))
    mixed[first, np.arange(len(first))] = x[second]
    mixed[second, np.arange(len(first))] = x[first]
    return 2 * np.hstack([np.zeros((count, 1)), np.eye(count), np.diag(2 * x), mixed])


def learn(bank: Bank, rng: np.random.Generator, draws: int) -> Emulator:
    """Fit an emulator to a bank.

    Parameters
    ----------
    bank : Bank
        At least 20 radiances.
    rng : numpy.random.Generator
        Deals radiances to folds, and draws the errors of the weights.
    draws : int
        How many errors are drawn.
    """
    radiances, numbers = np.unique(bank.radiance, return_inverse=True)
    if len(radiances) < LEAST_RADIANCES:
        raise InputError(f"bank of {len(radiances)} radiances: must have at least {LEAST_RADIANCES}; raise --size")
    centre, scale = _standard(bank.summaries)
    values = np.clip((bank.summaries - centre) / scale, -LIMIT, LIMIT)
    x, fold = features(bank.shares), rng.permutation(len(radiances))[numbers] % FOLDS
    # One sign a radiance: its pictures share what the form misses of it (wild cluster bootstrap).
    signs = rng.choice([-1.0, 1.0], size=(draws, len(radiances)))[:, numbers]
    # A summary that hardly any picture tells counts as pure noise.
    weights, residuals = np.zeros((x.shape[1], values.shape[1])), np.full(values.shape, np.nan)
    errors = np.zeros((draws, *weights.shape))
    patterns, pattern = np.unique(np.isfinite(values), axis=1, return_inverse=True)
    for number, known in enumerate(patterns.T):
        if np.count_nonzero(known) < LEAST_RADIANCES:
            continue
        # Columns that the same pictures tell share their matrices.
        columns = np.flatnonzero(pattern.ravel() == number)
        told = np.ix_(known, columns)
        residuals[told], solvers = _ridge(x[known], values[told], fold[known], bank.shares.shape[1])
        for s, solver in zip(columns, solvers, strict=True):
            weights[:, s] = solver @ values[known, s]
            errors[:, :, s] = (signs[:, known] * residuals[known, s]) @ solver.T
    # The error of the mean at the bank's own pictures, which lie all over the ranges.
    wrong = np.einsum("nf,rfs->rns", x[:: max(1, len(x) // 100)], errors).reshape(-1, values.shape[1])
    return Emulator(centre, scale, weights, _covariance(residuals), wrong.T @ wrong / len(wrong), errors)


def _standard(summaries: Array) -> tuple[Array, Array]:
    """Return mean and deviation of each summary's known values; 0 and 1 where no picture tells it, or all alike."""
    known = np.isfinite(summaries)
    count = np.maximum(known.sum(axis=0), 1)
    centre = np.where(known, summaries, 0.0).sum(axis=0) / count
    scale = np.sqrt((np.where(known, summaries - centre, 0.0) ** 2).sum(axis=0) / count)
    return centre, np.where(scale > 0, scale, 1.0)


def _ridge(x: Array, y: Array, fold: IntArray, parameters: int) -> tuple[Array, list[Array]]:
    """Return the residuals of unseen folds, shape (N, C), and of each column the matrix of weights of values, (F, N).

    Each column has the penalty whose residuals are least.
    """
    penalty = np.ones(x.shape[1])
    penalty[0], penalty[1 + 2 * parameters :] = 0.0, MIXED_PENALTY
    residuals = np.empty((len(PENALTIES), *y.shape))
    for k in np.unique(fold):
        out = fold == k
        for i, strength in enumerate(PENALTIES):
            weights = _solved(x[~out], strength * penalty, x[~out].T @ y[~out])
            residuals[i, out] = y[out] - x[out] @ weights
    best = np.mean(residuals**2, axis=1).argmin(axis=0)
    solvers = {i: _solved(x, PENALTIES[i] * penalty, x.T) for i in np.unique(best).tolist()}
    return np.take_along_axis(residuals, best[None, None], axis=0)[0], [solvers[i] for i in best.tolist()]


def _solved(x: Array, penalty: Array, right: Array) -> Array:
    """Return (X'X + n diag(penalty))^-1 times a matrix."""
    return np.asarray(np.linalg.solve(x.T @ x + np.diag(len(x) * penalty + 1e-9), right))


def _covariance(residuals: Array) -> Array:
    """Return the covariance of residuals from the pairs that are known, positive definite."""
    known = np.isfinite(residuals)
    filled = np.where(known, residuals, 0.0)
    sd = np.sqrt((filled**2).sum(axis=0) / np.maximum(known.sum(axis=0), 1)) + 1e-3
    filled = filled / sd
    pairs = known.T.astype(float) @ known
    correlation = (1 - SHRINKAGE) * (filled.T @ filled) / np.maximum(pairs, 1.0)
    np.fill_diagonal(correlation, 1.0)
    # Pairs of different pictures may leave a negative direction.
    values, vectors = np.linalg.eigh(correlation)
    mended = (vectors * np.maximum(values, LEAST_VARIANCE)) @ vectors.T
    scale = sd / np.sqrt(np.diag(mended))
    return np.asarray(mended * np.outer(scale, scale))
