"""From the summaries of scenes to the distribution of parameters that they have, with intervals from repeated fits.

Each scene's parameters are normal about a centre, independent of each other; its summaries are those of the emulator
with its spread, and all scenes share a gap between the emulator and the real frames. The centre and the gap's size are
the most probable ones for the scenes' mean, the spread for their scatter. Each repeated fit has other scenes
(bootstrap), another bank (errors of the emulator), another gap and another middle of the prior; so an interval covers
the range where nothing else says more.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simtest.realism.fitting.emulator import Emulator
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.statistics import bootstrap_interval

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
    curvature = emulator.bends[np.arange(len(centre)), np.arange(len(centre))][:, told] / 2
    residual = scenes.mean - emulator.mean(centre)[0, told] - spread**2 @ curvature
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
