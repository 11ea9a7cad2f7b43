"""Least-squares fit of small spots: a Gaussian on a local background, clipped pixels censored, many spots at once.

A spot of a few pixels is the image of a highlight through lens and pixels, whose point spread is nearly Gaussian. Its
centre is then what the pixels tell; the fit is the maximum-likelihood estimate of it under white noise.
"""

from dataclasses import dataclass

import numpy as np

from simtest.geometry import Array, Mask

MAX_STEPS = 40
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-9, 1e8
CONVERGED = 1e-9
"""A fit has converged when the sum of squares falls by less than this share."""

EXACT = 1e-20
"""Sum of squares, over the peak squared, that rounding alone leaves."""

LEAST_VARIANCE_PX2 = 0.1
"""A spot is no narrower than its pixel, whose own variance is 1/12 px^2."""

BACKGROUND_SLOPE = 0.01
"""Standard deviation of the background's slope, share of the spot's height per px: it has a prior, because the flank of
a wide spot looks like a slope."""

PRIOR_RESIDUAL = 0.02
"""Residual, share of the height, against which that prior is weighed."""

HEIGHT, X, Y, XX, XY, YY, LEVEL, RIGHT, DOWN = range(9)
"""Parameters: height; centre, px; inverse covariance, 1/px^2; background at the window's centre, and its slope."""


@dataclass(frozen=True)
class SpotWindows:
    """The pixels of N spots, each in a square window around its peak's pixel, its m pixels in one row.

    Parameters
    ----------
    values : ndarray, shape (N, m)
        Unsmoothed intensities over the spot's height; 0 where not used.
    used, clipped : ndarray of bool, shape (N, m)
        Pixels that are fitted, and those of them whose intensity is at least the value.
    offsets : ndarray, shape (2, m)
        Each pixel's centre from the centre of the window, px.
    """

    values: Array
    used: Mask
    clipped: Mask
    offsets: Array


@dataclass(frozen=True)
class SpotFits:
    """Fitted spots.

    Parameters
    ----------
    parameters : ndarray, shape (N, 9)
        At the minimum; see `HEIGHT` and the others.
    covariance : ndarray, shape (N, 2, 2)
        Of the centre, px^2, for residuals of variance 1; NaN where it is not determined.
    residual : ndarray, shape (N,)
        Standard deviation of the residuals, in the values' unit.
    sound : ndarray of bool, shape (N,)
        Whether the fit converged to a spot inside its window.
    """

    parameters: Array
    covariance: Array
    residual: Array
    sound: Mask


def fit_spots(windows: SpotWindows, centres: Array, variances: Array, levels: Array) -> SpotFits:
    """Fit spots by Levenberg and Marquardt's method, all at once.

    Parameters
    ----------
    windows : SpotWindows
        Their pixels.
    centres : ndarray, shape (N, 2)
        Where to start, px from the centre of the window.
    variances, levels : ndarray, shape (N,)
        Variance of each spot, px^2, and level of its background to start with.
    """
    count = len(centres)
    p = np.zeros((count, 9))
    p[:, HEIGHT] = 1 - levels
    p[:, X], p[:, Y] = centres.T
    p[:, XX] = p[:, YY] = 1 / np.maximum(variances, 2 * LEAST_VARIANCE_PX2)
    p[:, LEVEL] = levels
    reach = float(np.abs(windows.offsets).max())
    damping, active = np.full(count, FIRST_DAMPING), np.ones(count, dtype=bool)
    # A step too far overflows, and is then not taken.
    with np.errstate(all="ignore"):
        squares, normal, gradient = _equations(windows, p)
        for _ in range(MAX_STEPS):
            if not active.any():
                break
            # trial step of all that have not converged
            diagonal = np.diagonal(normal, axis1=1, axis2=2)
            damped = normal + np.eye(9) * ((damping[:, None] + 1e-12) * diagonal + 1e-30)[:, None, :]
            at = np.flatnonzero(active)
            step = np.zeros_like(p)
            step[at] = np.linalg.solve(damped[at], gradient[at][:, :, None])[:, :, 0]
            trial = p + step
            part = SpotWindows(windows.values[at], windows.used[at], windows.clipped[at], windows.offsets)
            new_squares, new_normal, new_gradient = _equations(part, trial[at])
            falls = new_squares < squares[at]
            accepted = falls & np.isfinite(new_squares) & _is_spot(trial[at], reach)
            # rejected: more damping; accepted: less
            fall = np.where(accepted, (squares[at] - new_squares) / squares[at], 1.0)
            damping[at] = np.where(accepted, np.maximum(damping[at] / 10, LEAST_DAMPING), damping[at] * 10)
            taken = at[accepted]
            p[taken], squares[taken] = trial[taken], new_squares[accepted]
            normal[taken], gradient[taken] = new_normal[accepted], new_gradient[accepted]
            active[at] = ~((fall < CONVERGED) | (squares[at] < EXACT) | (damping[at] > MOST_DAMPING))
        return _stated(windows, p, squares, normal, ~active & _is_spot(p, reach))


def _equations(windows: SpotWindows, p: Array) -> tuple[Array, Array, Array]:
    """Return each spot's sum of squares, and its normal equations, shapes (N,), (N, 9, 9) and (N, 9)."""
    x, y = windows.offsets
    dx, dy = x - p[:, X, None], y - p[:, Y, None]
    xx, xy, yy = p[:, XX, None], p[:, XY, None], p[:, YY, None]
    along_x, along_y = xx * dx + xy * dy, xy * dx + yy * dy
    lobe = np.exp(-0.5 * (dx * along_x + dy * along_y))
    height = p[:, HEIGHT, None]
    raised = height * lobe
    model = raised + p[:, LEVEL, None] + p[:, RIGHT, None] * x + p[:, DOWN, None] * y
    residual = windows.values - model
    counted = windows.used & ~(windows.clipped & (residual < 0))
    residual = np.where(counted, residual, 0.0)
    J = np.empty((len(p), 9, len(x)))
    J[:, HEIGHT] = lobe
    J[:, X], J[:, Y] = raised * along_x, raised * along_y
    J[:, XX], J[:, XY], J[:, YY] = -0.5 * raised * dx * dx, -raised * dx * dy, -0.5 * raised * dy * dy
    J[:, LEVEL], J[:, RIGHT], J[:, DOWN] = 1.0, x, y
    J *= counted[:, None, :]
    normal, gradient = J @ J.transpose(0, 2, 1), (J @ residual[:, :, None])[:, :, 0]
    # prior of the background's slope
    weight = (PRIOR_RESIDUAL / BACKGROUND_SLOPE) ** 2
    squares = np.sum(residual * residual, axis=1) + weight * np.sum(p[:, RIGHT:] ** 2, axis=1)
    for k in (RIGHT, DOWN):
        normal[:, k, k] += weight
        gradient[:, k] -= weight * p[:, k]
    return squares, normal, gradient


def _is_spot(p: Array, reach: float) -> Mask:
    """Return whether parameters are those of a spot: raised, not narrower than a pixel, its centre in the window."""
    half, product = (p[:, XX] + p[:, YY]) / 2, p[:, XX] * p[:, YY] - p[:, XY] ** 2
    largest = half + np.sqrt(np.maximum(half * half - product, 0.0))
    narrow = largest > 1 / LEAST_VARIANCE_PX2
    wide = (product <= 0) | (half <= 0) | (product / largest < 1 / (4 * reach * reach))
    inside = (np.abs(p[:, X]) < reach) & (np.abs(p[:, Y]) < reach)
    return np.asarray((p[:, HEIGHT] > 0) & inside & ~narrow & ~wide)


def _stated(windows: SpotWindows, p: Array, squares: Array, normal: Array, sound: Mask) -> SpotFits:
    """Return the fits with the covariances of their centres."""
    free = np.count_nonzero(windows.used & ~windows.clipped, axis=1) - 7
    covariance = np.full((len(p), 2, 2), np.nan)
    diagonal = np.diagonal(normal, axis1=1, axis2=2)
    sound = sound & (free > 0) & (diagonal > 0).all(axis=1)
    for i in np.flatnonzero(sound):
        # scaled to a diagonal of 1, so that the condition does not depend on units
        scale = np.sqrt(diagonal[i])
        information = normal[i] / np.outer(scale, scale)
        if np.linalg.cond(information) > 1e12:
            sound[i] = False
            continue
        covariance[i] = (np.linalg.inv(information) / np.outer(scale, scale))[X : Y + 1, X : Y + 1]
    residual = np.sqrt(squares / np.maximum(free, 1))
    return SpotFits(p, covariance, residual, sound)
