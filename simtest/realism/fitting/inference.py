"""From a bank to the distribution of parameters that real frames have.

The emulator says what a frame of given parameters shows. The mean of each summary is a quadratic form of the
parameters, fitted by ridge regression; the covariance about it is the same for all parameters. It is taken from
residuals of folds that the regression did not see, so that what the form misses counts as spread.

Each scene's parameters are normal about a centre, independent of each other; its summaries are those of the emulator
with its spread, and all scenes share a gap between the emulator and the real frames. The centre and the gap's size are
the most probable ones for the scenes' mean, the spread for their scatter. Each repeated fit has other scenes
(bootstrap), another bank (errors of the emulator), another gap and another middle of the prior; so an interval covers
the range where nothing else says more.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from simtest.errors import InputError
from simtest.realism.fitting.bank import Bank
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.statistics import bootstrap_interval

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
    """Mean and spread of a frame's S summaries by P parameters, in units of the bank's deviations."""

    centre: Array  # shape (S,), the bank's mean of each summary
    scale: Array  # shape (S,), its deviation
    weights: Array  # shape (F, S), of `features`
    covariance: Array  # shape (S, S), of the residuals of a picture
    error: Array  # shape (S, S), covariance of the errors of `mean`, over the ranges
    draws: Array  # shape (R, F, S), errors of the weights, as the bank's radiances leave them

    @property
    def parameters(self) -> int:
        """Number of parameters; there are 1 + P + P + P (P - 1) / 2 features."""
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

    @property
    def curvature(self) -> Array:
        """Half the second derivative of the mean by each parameter, the same at all of them, shape (P, S)."""
        return np.asarray(4 * self.weights[1 + self.parameters : 1 + 2 * self.parameters])

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
    x, own = 2 * np.asarray(shares) - 1, np.eye(len(shares))
    first, second = np.triu_indices(len(x), k=1)
    mixed = own[:, first] * x[second] + own[:, second] * x[first]
    return 2 * np.hstack([np.zeros((len(x), 1)), own, np.diag(2 * x), mixed])


def learn(bank: Bank, rng: np.random.Generator, draws: int) -> Emulator:
    """Fit an emulator to a bank of at least 20 radiances, which are dealt to folds, with some draws of its errors."""
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


REPEATS = 60
"""Repeated fits."""

STARTS = 6
"""Centres at which the first fit starts; the best end is taken."""

SPREAD_PRIOR, CENTRE_PRIOR, GAP_PRIOR = 0.2, 0.35, 1.0
"""Deviations of the half-normal prior of a spread and of the normal prior of a centre about the middle, shares of the
range; mean of the exponential prior of the gap, deviations of a frame's summaries."""

LEAST_GAP = 0.1
"""The form of the emulator is never met exactly, deviations of a frame's summaries."""

LEAST_TOLD = 0.5
"""A summary that fewer of the scenes tell is left out."""

NOT_TOLD = 0.6
"""A parameter is not told where its interval covers more than this share of its range."""

SPREAD_ENDS = (0.01, 0.5)

CENTRE_ENDS = (-0.2, 1.2)
"""Where repeated fits look for centres: ends at the range would hide how far their errors reach."""


@dataclass(frozen=True)
class Fitted:
    """The distribution of parameters, as shares of their ranges."""

    centre: Array  # shape (P,), mean over scenes
    spread: Array  # shape (P,), deviation over scenes
    gap: float  # how far the emulator's best mean stays from the scenes', deviations of a frame's summaries
    centres: Array  # shape (R, P), of the repeated fits
    spreads: Array  # shape (R, P)
    interval: Array  # shape (P, 2), 95 % interval of the centre
    summaries: Array  # shape (S,), bool: which ones the frames tell

    @property
    def told(self) -> Array:
        """Whether the frames tell each parameter, shape (P,), bool."""
        return np.asarray(np.diff(self.interval, axis=1)[:, 0] <= NOT_TOLD)


@dataclass(frozen=True)
class Scenes:
    """Number of scenes, and mean, shape (S,), and scatter, shape (S, S), of their standardised summaries."""

    count: int
    mean: Array
    scatter: Array


def infer(
    emulator: Emulator,
    scenes: Array,
    rng: np.random.Generator,
    repeats: int = REPEATS,
    step: Callable[[int, int], None] | None = None,
) -> Fitted:
    """Find the distribution of parameters of scenes by an emulator with at least `repeats` draws.

    `scenes` are their summaries, shape (N, S), NaN where one does not tell it; `step` is called with the fits that are
    done, and all.
    """
    values, told = _complete(emulator, scenes)
    parameters = emulator.parameters
    everything = moments(values, np.arange(len(values)))
    middle = np.full(parameters, 0.5)
    # The first fit: several starts. The spread follows from the centre, and its curvature moves the centre.
    starts = [middle, *rng.uniform(0.15, 0.85, (STARTS - 1, parameters))]
    spread = np.zeros(parameters)
    for _ in range(2):
        fits = [_centre(emulator, everything, told, spread, start, middle) for start in starts]
        centre, gap, _ = min(fits, key=lambda one: one[2])
        spread, starts = _spread(emulator, everything, told, centre), [centre]
    centre = np.clip(centre, 0.0, 1.0)
    # Repeated fits from its end: other scenes, another gap, another bank, and another middle of the prior.
    deviation = emulator.deviation[told]
    found = []
    for number in range(repeats):
        drawn = moments(values, rng.integers(len(values), size=len(values)))
        moved = gap * deviation * rng.standard_normal(len(deviation))
        shifted = Scenes(drawn.count, drawn.mean + moved, everything.scatter)
        prior = 0.5 + CENTRE_PRIOR * rng.standard_normal(parameters)
        other = _centre(emulator.redrawn(number), shifted, told, spread, centre, prior)[0]
        found.append((other, _spread(emulator, drawn, told, np.clip(other, 0.0, 1.0))))
        if step:
            step(number + 1, repeats)
    centres, spreads = (np.array(part) for part in zip(*found, strict=True))
    interval = np.clip(bootstrap_interval(centre, centres, len(values)).T, 0.0, 1.0)
    return Fitted(centre, spread, gap, centres, spreads, interval, told)


def _complete(emulator: Emulator, scenes: Array) -> tuple[Array, Array]:
    """Return scenes in the bank's deviations without gaps, and which summaries they tell.

    What single scenes do not tell is filled in from what they tell, by the correlation of the bank's residuals.
    """
    values = emulator.standardised(scenes)
    told = np.isfinite(values).mean(axis=0) > LEAST_TOLD
    values, correlation = values[:, told], emulator.covariance[np.ix_(told, told)]
    centre = np.nanmean(values, axis=0) if told.any() else np.empty(0)
    for row in values:
        known = np.isfinite(row)
        if known.any() and not known.all():
            gains = np.linalg.solve(correlation[np.ix_(known, known)], correlation[np.ix_(known, ~known)])
            row[~known] = centre[~known] + (row[known] - centre[known]) @ gains
        row[~np.isfinite(row)] = 0.0
    return values, told


def moments(values: Array, rows: IntArray) -> Scenes:
    """Return the mean and scatter of some rows of scenes' standardised summaries."""
    chosen = values[rows]
    mean = chosen.mean(axis=0)
    return Scenes(len(chosen), mean, (chosen - mean).T @ (chosen - mean))


def _centre(
    emulator: Emulator, scenes: Scenes, told: Array, spread: Array, start: Array, prior: Array
) -> tuple[Array, float, float]:
    """Return the most probable centre, shape (P,), the gap, and the negative log posterior there."""
    # Imported here: the command's start must not pay for it.
    from scipy.optimize import minimize

    bounds = [CENTRE_ENDS] * len(start) + [(np.log(LEAST_GAP), np.log(5.0))]
    found = minimize(
        lambda point: negative_log(emulator, scenes, told, spread, prior, point),
        np.append(start, np.log(0.2)),
        jac=True,
        bounds=bounds,
        method="L-BFGS-B",
        options={"maxiter": 100},
    )
    return np.asarray(found.x[:-1]), float(np.exp(found.x[-1])), float(found.fun)


def negative_log(
    emulator: Emulator, scenes: Scenes, told: Array, spread: Array, prior: Array, point: Array
) -> tuple[float, Array]:
    """Return the negative log posterior of a centre and the log of the gap, and its gradient, shape (P + 1,).

    The mean of n scenes is normal about the emulator's. Its covariance is that of a scene over n, the emulator's own
    error, and the gap's. A scene's covariance mixes the scenes' scatter with the bank's residuals.
    """
    centre, gap = point[:-1], float(np.exp(point[-1]))
    inside, gaps = np.ix_(told, told), (gap * emulator.deviation[told]) ** 2
    # As many scenes as there are summaries outweigh the bank.
    weight = (scenes.count - 1) / (scenes.count - 1 + np.count_nonzero(told))
    own = weight * scenes.scatter / (scenes.count - 1) + (1 - weight) * emulator.covariance[inside]
    covariance = own / scenes.count + emulator.error[inside] + np.diag(gaps)
    # A quadratic form has the mean over scenes that its curvature adds.
    residual = scenes.mean - emulator.mean(centre)[0, told] - spread**2 @ emulator.curvature[:, told]
    value, by_covariance = _gaussian(covariance, np.outer(residual, residual), 1)
    slopes = emulator.slopes(centre)[:, told]
    gradient = -slopes @ np.linalg.solve(covariance, residual) + (centre - prior) / CENTRE_PRIOR**2
    value += np.sum(((centre - prior) / CENTRE_PRIOR) ** 2) / 2 + gap / GAP_PRIOR
    by_gap = 2 * float(np.diag(by_covariance) @ gaps) + gap / GAP_PRIOR
    return float(value), np.append(gradient, by_gap)


def _spread(emulator: Emulator, scenes: Scenes, told: Array, centre: Array) -> Array:
    """Return the most probable deviations of parameters between scenes, shape (P,), from the summaries' scatter."""
    from scipy.optimize import minimize

    slopes, own = emulator.slopes(centre)[:, told], emulator.covariance[np.ix_(told, told)]

    def negative(logs: Array) -> tuple[float, Array]:
        spread = np.exp(logs)
        value, by_covariance = _gaussian(own + (slopes.T * spread**2) @ slopes, scenes.scatter, scenes.count - 1)
        gradient = 2 * spread**2 * np.einsum("ps,st,pt->p", slopes, by_covariance, slopes)
        prior = (spread / SPREAD_PRIOR) ** 2
        return float(value + prior.sum() / 2), gradient + prior

    low, high = (float(np.log(end)) for end in SPREAD_ENDS)
    found = minimize(negative, np.full(len(centre), np.log(0.08)), jac=True, bounds=[(low, high)] * len(centre),
                     method="L-BFGS-B", options={"maxiter": 60})  # fmt: skip
    return np.asarray(np.exp(found.x))


def _gaussian(covariance: Array, scatter: Array, count: int) -> tuple[float, Array]:
    """Return half of count log|C| + tr(C^-1 scatter), and its derivative by the covariance C."""
    inverse = np.linalg.inv(covariance)
    solved = inverse @ scatter
    value = (count * np.linalg.slogdet(covariance)[1] + np.trace(solved)) / 2
    return float(value), np.asarray((count * inverse - solved @ inverse) / 2)
