"""Separates highlights that touch: spots of one common profile, fitted to the linear light of a blob.

The lobe of the surface, the blur of the lens and, nearly, the distance are the same for all lights on one ball, so all
spots of a blob have the same shape. The shape is an elliptical Moffat function, exp(-log(1 + t r^2 / 2) / t) with r in
standard deviations, which is a Gaussian for t -> 0. Spots are added as long as the evidence for one more is clear.
A spot's own centroid would be drawn towards its neighbours; the centres here are fitted together.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.geometry import Array

MOST_SPOTS = 5
"""A blob of so many spots is a lamp or window: a rig has four lights at most."""

MISFIT = 0.02
"""Error of the profile, as a share of the light above what surrounds the blob."""

CLIPPED = 0.98
"""Pixels above this share of a blob's brightest may be clipped: their light is at least what they show."""

CLEAR = 20.0
"""Chi-squared that one spot more must gain beyond 3 log(pixels), Schwarz's penalty of its three parameters."""

WORST_FIT = 4.0
"""Chi-squared per pixel up to which spots of one profile explain a blob."""

LEAST_APART = 3.0
"""Distance of two spots in its standard deviations, at least."""

MOST_SD_PX = 0.5
"""A centre that is known less well is not used."""

RATIO_SD, TAIL, TAIL_SD = 0.1, 0.1, 1.0
"""What is known of the profile beforehand: the logarithms of its axis ratio, about 0, and of t, about log `TAIL`."""

SHAPE = 7
"""Parameters that all spots share: log width, two of the ellipse, log t, and a plane below the spots."""

DROP = 0.15
"""A fitted spot of a smaller share of the brightest is part of the profile's misfit and no highlight."""


@dataclass(frozen=True)
class Spots:
    """Separated spots: centres, px, shape (K, 2), covariances, px^2, (K, 2, 2), and their radius at half height, px.

    All have one radius; `width_sd_px` is its standard deviation.
    """

    centres: Array
    covariances: Array
    width_px: float
    width_sd_px: float


@dataclass(frozen=True)
class _Blob:
    """Pixels' centres, px, their light and its standard deviation, which are clipped, and at what value."""

    points: Array
    values: Array
    sd: Array
    is_clipped: npt.NDArray[np.bool_]
    ceiling: float

    def model(self, unknown: Array) -> Array:
        """Return the light at the pixels; `unknown` is the shape and then x, y and log height of each spot."""
        width, tail = np.exp(unknown[0]), np.exp(unknown[3])
        middle = self.points.mean(axis=0)
        total = unknown[4] + (self.points - middle) @ unknown[5:SHAPE]
        for x, y, height in unknown[SHAPE:].reshape(-1, 3):
            dx, dy = (self.points[:, 0] - x) / width, (self.points[:, 1] - y) / width
            squares = np.exp(-unknown[1]) * dx**2 + np.exp(unknown[1]) * dy**2 - 2 * unknown[2] * dx * dy
            total = total + np.exp(height - np.log1p(tail * np.maximum(squares, 0) / 2) / tail)
        return np.asarray(np.where(self.is_clipped, np.minimum(total, self.ceiling), total))

    def residuals(self, unknown: Array) -> Array:
        """Return the residuals, and what is known of the profile beforehand, in standard deviations."""
        known = [unknown[1] / RATIO_SD, unknown[2] / RATIO_SD, (unknown[3] - np.log(TAIL)) / TAIL_SD]
        return np.concatenate([(self.model(unknown) - self.values) / self.sd, known])


def separate(values: Array, where: npt.NDArray[np.bool_], noise: float, base: float) -> Spots | None:
    """Return the spots of a blob; None where spots of one profile do not explain it.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        Linear light.
    where : ndarray of bool, shape (H, W)
        Pixels of the blob and of some of what surrounds it.
    noise : float
        Standard deviation of a pixel.
    base : float
        Light of what surrounds the blob.
    """
    blob = _blob(values, where, noise, base)
    best = _start(blob, base)
    if best is None:
        return None
    penalty = 3 * np.log(len(blob.values)) + CLEAR
    while True:
        starts = [each for each in _more(blob, best[0], base) if _count(each) <= MOST_SPOTS]
        tried = [best, *(fit for start in starts if (fit := _fitted(blob, start)) is not None)]
        scale = max(1.0, min(chi2 for _, chi2 in tried) / len(blob.values))
        chosen = min(tried, key=lambda fit: fit[1] / scale + penalty * _count(fit[0]))
        if chosen is best:
            break
        best = chosen
    return _spots(blob, *best) if _count(best[0]) < MOST_SPOTS else None


def _blob(values: Array, where: npt.NDArray[np.bool_], noise: float, base: float) -> _Blob:
    rows, columns = np.nonzero(where)
    light = np.asarray(values[where], dtype=float)
    clipped = light > CLIPPED * light.max()
    ceiling = float(np.median(light[clipped]))
    sd = np.sqrt(max(noise, 1e-6) ** 2 + (MISFIT * np.maximum(light - base, 0)) ** 2)
    return _Blob(np.stack([columns + 0.5, rows + 0.5], axis=1).astype(np.float64), light, sd, clipped, ceiling)


def _count(unknown: Array) -> int:
    return (len(unknown) - SHAPE) // 3


def _start(blob: _Blob, base: float) -> tuple[Array, float] | None:
    """Return the fit of a single spot: parameters and chi-squared."""
    weights = np.maximum(blob.values - base, 0) ** 2
    if weights.sum() <= 0:
        return None
    centre = weights @ blob.points / weights.sum()
    off = blob.points - centre
    width = np.sqrt(np.linalg.eigvalsh((off * weights[:, None]).T @ off / weights.sum())[0] + 0.1)
    height = np.log(max(float(blob.values.max()) - base, 1e-6))
    return _fitted(blob, np.array([np.log(width), 0, 0, np.log(TAIL), base, 0, 0, *centre, height]))


def _more(blob: _Blob, fitted: Array, base: float) -> list[Array]:
    """Return starts with more spots: one at the largest residual, one spot split, and all spots split."""
    residuals = blob.values - blob.model(fitted)
    near = np.exp(-np.sum((blob.points[:, None] - blob.points[None]) ** 2, axis=2) / 2)
    at = int((near @ residuals).argmax())
    height = np.log(max(0.3 * (float(blob.values.max()) - base), 1e-6))
    starts = [np.concatenate([fitted, blob.points[at], [height]])]
    spots = fitted[SHAPE:].reshape(-1, 3)
    weights = np.maximum(blob.values - base, 0)
    nearest = np.linalg.norm(blob.points[:, None] - spots[None, :, :2], axis=2).argmin(axis=1)
    halves, narrowest = list[Array](), float(fitted[0])
    for number, spot in enumerate(spots):
        own = weights * (nearest == number)
        if own.sum() <= 0:
            return starts
        centre = own @ blob.points / own.sum()
        off = blob.points - centre
        values, vectors = np.linalg.eigh((off * own[:, None]).T @ off / own.sum())
        step = 0.8 * np.sqrt(max(values[1], 0.1)) * vectors[:, 1]
        narrowest = min(narrowest, float(np.log(values[0] + 0.1)) / 2)
        halves.append(np.array([[*(centre + sign * step), spot[2]] for sign in (-1, 1)]))
    shape = np.array([narrowest, 0, 0, np.log(TAIL), *fitted[4:SHAPE]])
    starts.append(np.concatenate([shape, np.concatenate(halves).ravel()]))
    if len(spots) > 1:
        for number, pair in enumerate(halves):
            rest = np.delete(spots, number, axis=0).ravel()
            starts.append(np.concatenate([shape, rest, pair.ravel()]))
    return starts


def _fitted(blob: _Blob, start: Array) -> tuple[Array, float] | None:
    """Return the parameters of the best fit near a start, and its chi-squared."""
    from scipy.optimize import least_squares

    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    corner, far = blob.points.min(axis=0) - 1, blob.points.max(axis=0) + 1
    span = max(float(blob.values.max() - blob.values.min()), 1e-6)
    low[:4], high[:4] = [np.log(0.3), -1, -0.7, np.log(1e-3)], [np.log(max(*(far - corner), 1.0)), 1, 0.7, np.log(1.5)]
    for first in range(SHAPE, len(start), 3):
        low[first : first + 3] = [*corner, np.log(1e-3 * span)]
        high[first : first + 3] = [*far, np.log(1e3 * span)]
    if len(blob.values) <= len(start) or not np.isfinite(start).all():
        return None
    inside = np.clip(start, low + 1e-6, high - 1e-6)
    found = least_squares(blob.residuals, inside, bounds=(low, high), x_scale="jac", max_nfev=60)
    return (found.x, float(2 * found.cost)) if np.isfinite(found.x).all() else None


def _spots(blob: _Blob, fitted: Array, chi2: float) -> Spots | None:
    """Return the centres of a fit with their covariances; None where the fit is poor or two spots are not apart."""
    scale = chi2 / len(blob.values)
    if scale > WORST_FIT:
        return None
    steps = 1e-4 * np.eye(len(fitted))
    J = np.stack([(blob.residuals(fitted + s) - blob.residuals(fitted - s)) / 2e-4 for s in steps], axis=1)
    try:
        covariance = np.linalg.inv(J.T @ J) * max(1.0, scale)
    except np.linalg.LinAlgError:
        return None
    spots = fitted[SHAPE:].reshape(-1, 3)
    heights = np.minimum(np.exp(spots[:, 2]), blob.ceiling - fitted[4])
    kept = np.flatnonzero(heights > DROP * heights.max())
    for n, i in enumerate(kept):
        for j in kept[:n]:
            a, b = SHAPE + 3 * i, SHAPE + 3 * j
            turn = np.zeros((2, len(fitted)))
            turn[:, a : a + 2], turn[:, b : b + 2] = np.eye(2), -np.eye(2)
            gap, spread = turn @ fitted, turn @ covariance @ turn.T
            if gap @ np.linalg.solve(spread, gap) < LEAST_APART**2:
                return None
    blocks = [covariance[SHAPE + 3 * i :, SHAPE + 3 * i :][:2, :2] for i in kept]
    width = _half_height(fitted)
    return Spots(spots[kept, :2], np.array(blocks), width, width * float(np.sqrt(covariance[0, 0])))


def _half_height(fitted: Array) -> float:
    """Return the radius at which a spot has half its height, px."""
    width, tail = np.exp(fitted[0]), np.exp(fitted[3])
    return float(width * np.sqrt(2 * np.expm1(tail * np.log(2)) / tail))
