"""From the summaries of scenes to the distribution of parameters that they have, with intervals from repeated fits.

Each scene's parameters are normal about a centre, independent of each other; its summaries are those of the emulator
with its spread, and all scenes share a gap between the emulator and the real frames. Centre, spread and size of the
gap maximise the likelihood of the scenes' mean and scatter. Each repeated fit has other scenes (bootstrap), another
bank (errors of the emulator) and another gap.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simtest.realism.fitting.emulator import Emulator
from simtest.runtime.arrays import Array, IntArray

REPEATS = 60
"""Repeated fits."""

STARTS = 6
"""Centres at which the first fit starts; the best end is taken."""

SPREAD_PRIOR, CENTRE_PRIOR, GAP_PRIOR = 0.2, 0.4, 1.0
"""Deviations of the half-normal prior of a spread and of the normal prior of a centre about the middle, shares of the
range; mean of the exponential prior of the gap, deviations of a frame's summaries."""

LEAST_GAP = 0.1
"""The form of the emulator is never met exactly, deviations of a frame's summaries."""

LEAST_TOLD = 0.5
"""A summary that fewer of the scenes tell is left out."""

NOT_TOLD = 0.6
"""A parameter is not told where its interval covers more than this share of its range."""

SPREAD_ENDS = (0.01, 0.5)


@dataclass(frozen=True)
class Fitted:
    """The distribution of parameters, as shares of their ranges.

    Parameters
    ----------
    centre, spread : ndarray, shape (P,)
        Mean and deviation over scenes.
    gap : float
        How far the emulator's best mean stays from the scenes', deviations of a frame's summaries.
    centres, spreads : ndarray, shape (R, P)
        Of the repeated fits.
    interval : ndarray, shape (P, 2)
        95 % interval of the centre.
    summaries : ndarray of bool, shape (S,)
        Which summaries the frames tell.
    """

    centre: Array
    spread: Array
    gap: float
    centres: Array
    spreads: Array
    interval: Array
    summaries: Array

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
    """Find the distribution of parameters.

    Parameters
    ----------
    emulator : Emulator
        With at least `repeats` draws.
    scenes : ndarray, shape (N, S)
        Summaries, a row a scene; NaN where it does not tell one.
    rng : numpy.random.Generator
        Draws starts, scenes and gaps.
    repeats : int
        Repeated fits.
    step : callable, optional
        Called with fits done and fits in all.
    """
    values, told = _complete(emulator, scenes)
    parameters = emulator.log_sd.shape[0] - 1
    everything = _moments(values, np.arange(len(values)))
    # The first fit: several starts.
    starts = [np.full(parameters, 0.5), *rng.uniform(0.15, 0.85, (STARTS - 1, parameters))]
    ends = [_maximise(emulator, everything, told, _point(start)) for start in starts]
    best = min(ends, key=lambda end: end[1])[0]
    centre, spread, gap = _parts(best, parameters)
    # Repeated fits from its end.
    deviation = emulator.deviation(centre)[told]
    found = []
    for number in range(repeats):
        drawn = _moments(values, rng.integers(len(values), size=len(values)))
        shifted = Scenes(drawn.count, drawn.mean + gap * deviation * rng.standard_normal(len(deviation)), drawn.scatter)
        point, _ = _maximise(emulator.redrawn(number), shifted, told, best)
        found.append(_parts(point, parameters)[:2])
        if step:
            step(number + 1, repeats)
    centres, spreads = (np.array(part) for part in zip(*found, strict=True))
    return Fitted(centre, spread, gap, centres, spreads, _interval(centre, centres, len(values)), told)


def _complete(emulator: Emulator, scenes: Array) -> tuple[Array, Array]:
    """Return scenes in the bank's deviations without gaps, and which summaries they tell.

    What single scenes do not tell is filled in from what they tell, by the correlation of the bank's residuals.
    """
    values = emulator.standardised(scenes)
    told = np.isfinite(values).mean(axis=0) > LEAST_TOLD
    values, correlation = values[:, told], emulator.correlation[np.ix_(told, told)]
    centre = np.nanmean(values, axis=0) if told.any() else np.empty(0)
    for row in values:
        known = np.isfinite(row)
        if known.any() and not known.all():
            gains = np.linalg.solve(correlation[np.ix_(known, known)], correlation[np.ix_(known, ~known)])
            row[~known] = centre[~known] + (row[known] - centre[known]) @ gains
        row[~np.isfinite(row)] = 0.0
    return values, told


def _moments(values: Array, rows: IntArray) -> Scenes:
    chosen = values[rows]
    mean = chosen.mean(axis=0)
    return Scenes(len(chosen), mean, (chosen - mean).T @ (chosen - mean))


def _point(centre: Array) -> Array:
    """Return the optimiser's coordinates: centres, logs of spreads, log of the gap."""
    return np.concatenate([centre, np.full(len(centre), np.log(0.08)), [np.log(0.3)]])


def _parts(point: Array, parameters: int) -> tuple[Array, Array, float]:
    return point[:parameters], np.exp(point[parameters:-1]), float(np.exp(point[-1]))


def _maximise(emulator: Emulator, scenes: Scenes, told: Array, start: Array) -> tuple[Array, float]:
    """Return the point of the largest posterior and its negative log."""
    # Imported here: the command's start must not pay for it.
    from scipy.optimize import minimize

    parameters = emulator.log_sd.shape[0] - 1
    bounds = [(0.0, 1.0)] * parameters + [tuple(np.log(SPREAD_ENDS))] * parameters + [(np.log(LEAST_GAP), np.log(5.0))]
    found = minimize(lambda p: negative_log(emulator, scenes, told, p), start, jac=True, bounds=bounds, method="L-BFGS-B",
                     options={"maxiter": 80})  # fmt: skip
    return np.asarray(found.x), float(found.fun)


def negative_log(emulator: Emulator, scenes: Scenes, told: Array, point: Array) -> tuple[float, Array]:
    """Return the negative log posterior of a point and its gradient, shape (2 P + 1,).

    The mean of n scenes is normal with covariance C / n + gap^2, their scatter Wishart with n - 1 degrees of freedom,
    where C = D R D + J' diag(spread^2) J of the emulator's deviation D, correlation R and slopes J.
    """
    count = emulator.log_sd.shape[0] - 1
    centre, spread, gap = _parts(point, count)
    slopes, deviation = emulator.slopes(centre)[:, told], emulator.deviation(centre)[told]
    bends = emulator.bends[:, :, told]
    curvature = bends[np.arange(count), np.arange(count)] / 2
    own = emulator.correlation[np.ix_(told, told)] * np.outer(deviation, deviation)
    covariance = own + (slopes.T * spread**2) @ slopes
    gaps = (gap * deviation) ** 2
    # A quadratic form has the mean over scenes that its curvature adds.
    residual = scenes.mean - emulator.mean(centre)[0, told] - spread**2 @ curvature
    value_mean, by_mean = _gaussian(covariance / scenes.count + np.diag(gaps), np.outer(residual, residual), 1)
    value_scatter, by_scatter = _gaussian(covariance, scenes.scatter, scenes.count - 1)
    pull = np.linalg.solve(covariance / scenes.count + np.diag(gaps), residual)
    by_covariance = by_mean / scenes.count + by_scatter
    # By the centre: the mean, the frames' deviation, and the slopes.
    by_log_sd = 2 * ((by_covariance * own).sum(axis=0) + np.diag(by_mean) * gaps)
    gradient_centre = -slopes @ pull
    gradient_centre += 2 * emulator.log_sd[1:, told] @ by_log_sd
    gradient_centre += 2 * np.einsum("q,pqs,st,qt->p", spread**2, bends, by_covariance, slopes, optimize=True)
    # By the logs of spreads and gap.
    gradient_spread = 2 * spread**2 * (np.einsum("ps,st,pt->p", slopes, by_covariance, slopes) - curvature @ pull)
    gradient_gap = 2 * float(np.diag(by_mean) @ gaps)
    # Priors.
    value = value_mean + value_scatter + np.sum((spread / SPREAD_PRIOR) ** 2) / 2 + gap / GAP_PRIOR
    value += np.sum(((centre - 0.5) / CENTRE_PRIOR) ** 2) / 2
    gradient_centre += (centre - 0.5) / CENTRE_PRIOR**2
    gradient_spread += (spread / SPREAD_PRIOR) ** 2
    return float(value), np.concatenate([gradient_centre, gradient_spread, [gradient_gap + gap / GAP_PRIOR]])


def _gaussian(covariance: Array, scatter: Array, count: int) -> tuple[float, Array]:
    """Return half of count log|C| + tr(C^-1 scatter), and its derivative by the covariance C."""
    inverse = np.linalg.inv(covariance)
    solved = inverse @ scatter
    value = (count * np.linalg.slogdet(covariance)[1] + np.trace(solved)) / 2
    return float(value), np.asarray((count * inverse - solved @ inverse) / 2)


def _interval(centre: Array, centres: Array, scenes: int) -> Array:
    """Return 95 % intervals of centres, shape (P, 2), inside their ranges.

    Few scenes resample too narrowly: deviations from the centre are widened from a normal to Student's distribution.
    """
    from scipy.stats import norm, t

    wider = t.ppf(0.975, scenes - 1) / norm.ppf(0.975) * np.sqrt(scenes / (scenes - 1))
    low, high = np.quantile(centres, [0.025, 0.975], axis=0)
    middle = np.median(centres, axis=0)
    ends = np.stack([centre + (low - middle) * wider, centre + (high - middle) * wider], axis=1)
    return np.asarray(np.clip(ends, 0.0, 1.0))
