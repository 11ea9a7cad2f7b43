"""The highlights on a ball or plate in a picture, each with its centre and the covariance of that.

Those that touch are spots of one common profile, fitted to the linear light of a blob. The lobe of the surface, the
blur of the lens and, nearly, the distance are the same for all lights on one ball, so all spots of a blob have the same
shape. It is an elliptical Moffat function, exp(-log(1 + t r^2 / 2) / t) with r in standard deviations, which is a
Gaussian for t -> 0. Spots are added as long as the evidence for one more is clear. A spot's own centroid would be drawn
towards its neighbours; the centres here are fitted together.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.geometry import Array, Index, Mask

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
    is_clipped: Mask
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


def separate(values: Array, where: Mask, noise: float, base: float) -> Spots | None:
    """Return the spots of a blob of linear light, shape (H, W); None where spots of one profile do not explain it.

    `where` are its pixels and some of what surrounds it, where the light is `base`; `noise` is a pixel's deviation.
    """
    rows, columns = np.nonzero(where)
    light = np.asarray(values[where], dtype=float)
    clipped = light > CLIPPED * light.max()
    sd = np.sqrt(max(noise, 1e-6) ** 2 + (MISFIT * np.maximum(light - base, 0)) ** 2)
    points = np.stack([columns + 0.5, rows + 0.5], axis=1).astype(np.float64)
    blob = _Blob(points, light, sd, clipped, float(np.median(light[clipped])))
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
    tail = np.exp(fitted[3])
    half_height = float(np.exp(fitted[0]) * np.sqrt(2 * np.expm1(tail * np.log(2)) / tail))
    return Spots(spots[kept, :2], np.array(blocks), half_height, half_height * float(np.sqrt(covariance[0, 0])))


# Highlights, alone or touching ----------------------------------------------------------------------------------------

SMOOTHING_PX = 0.7
MOST = 12
"""Highlights of a picture; the brightest ones."""

LEAST_NOISE = 8.0
"""A highlight stands so many standard deviations of the noise above what surrounds it."""

LEAST_SHARE = 0.15
"""And by this share of what the brightest one does."""

CENTRE_FLOOR_PX = 0.015
"""Error of a centre that stays however little noise there is: pixels, coding, the shape of a spot; an axis."""

LONGEST = 1.35
"""A longer spot, by its axis ratio, is several highlights that touch, or a reflected lamp or window."""

HALF = 0.5
FOOT = 0.25
"""Spots that meet above this share of a spot's height are one blob."""

ROOM_PX = 3
"""Pixels around a blob that its fit sees too."""

TOUCH = "several highlights that touch"

MOST_OPENED_PX = 200.0
"""Largest window for the brightness that surrounds a highlight."""


@dataclass(frozen=True)
class MeasuredHighlight:
    """A highlight: its centre, px, with the covariance, px^2, and why it is not used, empty where it is.

    `width_px` is its radius at half height, with its standard deviation; 0: not known.
    """

    pixel: Array
    covariance: Array
    problem: str = ""
    width_px: float = 0.0
    width_sd_px: float = 0.0


def measure_highlights(intensity: Array, where: Mask, widest_px: float) -> list[MeasuredHighlight]:
    """Return the highlights of a picture of linear light on the pixels of ball or plate, the brightest first.

    A spot that is longer than `widest_px` is no highlight of a light.
    """
    rows, columns = np.flatnonzero(where.any(axis=1)), np.flatnonzero(where.any(axis=0))
    if not len(rows):
        return []
    corner = np.array([columns[0], rows[0]])
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    values, inside = np.asarray(intensity[window], dtype=float), where[window]
    smooth = np.asarray(cv2.GaussianBlur(values, (0, 0), SMOOTHING_PX), dtype=float)
    # Without what is narrower than a highlight may be: the grey-scale opening.
    size = 2 * int(min(widest_px, MOST_OPENED_PX) / 2) + 3
    opened = cv2.morphologyEx(np.asarray(smooth, np.float32), cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    around = np.asarray(opened)
    above = np.where(inside, smooth - around, 0.0)
    noise = noise_of(values, inside)
    # candidates: the highest pixel of each neighbourhood
    highest = (smooth >= cv2.dilate(smooth, np.ones((3, 3), np.uint8))) & inside
    limit = max(LEAST_NOISE * noise, LEAST_SHARE * float(above.max()))
    peaks = np.argwhere(np.asarray(highest) & (above > limit))
    peaks = peaks[np.argsort(-above[tuple(peaks.T)], kind="stable")]
    found, claimed = list[MeasuredHighlight](), np.zeros(values.shape, dtype=bool)
    for row, column in peaks:
        if claimed[row, column] or len(found) >= MOST:
            continue
        foot = float(around[row, column] + FOOT * above[row, column])
        bright = (smooth > foot) & inside
        blob = _region(bright, row, column)
        around_blob = blob | (_widened(blob) & ~_widened(bright & ~blob) & inside)
        spots = _separated(values, blob, around_blob, noise, float(around[row, column]), widest_px)
        if spots is not None and len(spots.centres) > 1:
            found += _several(spots, corner, blob & ~claimed)
            claimed |= blob
            continue
        level = float(around[row, column] + HALF * above[row, column])
        region = _region(smooth > level, row, column) & inside
        claimed |= region
        single = _measured(values, region, level, noise, corner, peaks, smooth, widest_px)
        found.append(single if spots is None else _of_one_spot(single, spots, corner))
    return found


def _separated(values: Array, blob: Mask, window: Mask, noise: float, base: float, widest_px: float) -> Spots | None:
    """Return the spots in the window of a blob; None where it reaches the outline, or no small spots explain it."""
    if np.concatenate([blob[0], blob[-1], blob[:, 0], blob[:, -1]]).any() or blob.sum() > MOST * widest_px**2:
        return None
    spots = separate(values, window, noise, base)
    return spots if spots is not None and 2 * spots.width_px < widest_px else None


def _of_one_spot(single: MeasuredHighlight, spots: Spots, corner: Array) -> MeasuredHighlight:
    """Return a highlight with the centre of the spot that was fitted to it.

    The pixels above half height are few on a small spot, and which ones they are moves their centroid.
    """
    covariance = spots.covariances[0] + CENTRE_FLOOR_PX**2 * np.eye(2)
    return replace(
        single, pixel=spots.centres[0] + corner, covariance=covariance,
        width_px=spots.width_px, width_sd_px=spots.width_sd_px,
    )  # fmt: skip


def _widened(mask: Mask) -> Mask:
    square = np.ones((2 * ROOM_PX + 1, 2 * ROOM_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), square) > 0)


def _several(spots: Spots, corner: Array, blob: Mask) -> list[MeasuredHighlight]:
    """Return the spots of a blob as highlights; one that is not well known has that as its problem.

    Spots outside the blob are neighbours at whose edge its window ends. They have a blob of their own.
    """
    found = []
    for centre, covariance in zip(spots.centres, spots.covariances, strict=True):
        column, row = np.clip(centre.astype(int), 0, [blob.shape[1] - 1, blob.shape[0] - 1])
        if not blob[row, column]:
            continue
        problem = TOUCH if float(np.linalg.eigvalsh(covariance)[1]) > MOST_SD_PX**2 else ""
        known = covariance + CENTRE_FLOOR_PX**2 * np.eye(2)
        found.append(MeasuredHighlight(centre + corner, known, problem, spots.width_px, spots.width_sd_px))
    return found


def noise_of(values: Array, inside: Mask) -> float:
    """Return the standard deviation of the noise, from the differences of neighbours."""
    pairs = inside[:, 1:] & inside[:, :-1]
    if not pairs.any():
        return 0.0
    differences = np.abs(np.diff(np.asarray(values, dtype=float), axis=1)[pairs])
    return float(np.median(differences) / 0.6745 / np.sqrt(2))


def _region(mask: Mask, row: int, column: int) -> Mask:
    """Return the connected part of a mask that holds a pixel."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return np.asarray(labels == labels[row, column]) & mask


def _measured(
    values: Array, region: Mask, level: float, noise: float, corner: Array, peaks: Index, smooth: Array,
    widest_px: float,
) -> MeasuredHighlight:  # fmt: skip
    """Return the centroid of what stands above half height, with its error by the noise."""
    y, x = np.nonzero(region)
    weights = np.maximum(values[region].astype(float) - level, 0.0)
    total = max(float(weights.sum()), 1e-12)
    points = np.stack([x, y], axis=1) + 0.5
    centre = weights @ points / total
    off = points - centre
    covariance = noise**2 * (off.T @ off) / total**2 + CENTRE_FLOOR_PX**2 * np.eye(2)
    spread = (off * weights[:, None]).T @ off / total + np.eye(2) / 12
    return MeasuredHighlight(centre + corner, covariance, _problem(region, peaks, smooth, spread, widest_px))


def _problem(region: Mask, peaks: Index, smooth: Array, spread: Array, widest_px: float) -> str:
    """Return why a spot is no single highlight of a light; empty where it is one."""
    border = np.concatenate([region[0], region[-1], region[:, 0], region[:, -1]])
    if border.any():
        return "at the outline"
    length = 4 * float(np.sqrt(np.linalg.eigvalsh(spread)[1]))
    if length > widest_px:
        return "too large for a light"
    heights = sorted(smooth[r, c] for r, c in peaks if region[r, c])
    if len(heights) > 1:
        # A flat, clipped top has many equal maxima: does the spot fall apart below the second highest one?
        base = float(smooth[region].min())
        cut = (smooth > base + 0.95 * (heights[-2] - base)) & region
        if cv2.connectedComponents(cut.astype(np.uint8), connectivity=8)[0] > 2:
            return TOUCH
    small, large = np.linalg.eigvalsh(spread)
    return "long: several highlights that touch, or a lamp" if large > LONGEST**2 * small else ""
