"""The highlights on a ball or plate in a picture, each with its centre and the covariance of that."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from simtest.geometry import Array
from simtest.reconstruction.light_calibration.touching import MOST_SD_PX, Spots, separate

Peaks = npt.NDArray[np.intp]
"""Row and column of each peak, shape (K, 2)."""

Mask = npt.NDArray[np.bool_]

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
    """A highlight.

    Parameters
    ----------
    pixel : ndarray, shape (2,)
        Centre, px.
    covariance : ndarray, shape (2, 2)
        Of the centre, px^2.
    problem : str
        Why it is not used; empty: it is.
    width_px, width_sd_px : float
        Radius at half height, px, and its standard deviation; 0: not known.
    """

    pixel: Array
    covariance: Array
    problem: str = ""
    width_px: float = 0.0
    width_sd_px: float = 0.0


def measure_highlights(intensity: Array, where: npt.NDArray[np.bool_], widest_px: float) -> list[MeasuredHighlight]:
    """Return the highlights of a picture, the brightest first.

    Parameters
    ----------
    intensity : ndarray, shape (H, W)
        Linear light.
    where : ndarray of bool, shape (H, W)
        Pixels of the ball or plate.
    widest_px : float
        A spot that is longer is no highlight of a light.
    """
    rows, columns = np.flatnonzero(where.any(axis=1)), np.flatnonzero(where.any(axis=0))
    if not len(rows):
        return []
    corner = np.array([columns[0], rows[0]])
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    values, inside = np.asarray(intensity[window], dtype=float), where[window]
    smooth = np.asarray(cv2.GaussianBlur(values, (0, 0), SMOOTHING_PX), dtype=float)
    around = _surroundings(smooth, widest_px)
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
        poor = float(np.linalg.eigvalsh(covariance)[1]) > MOST_SD_PX**2
        floor = CENTRE_FLOOR_PX**2 * np.eye(2)
        found.append(
            MeasuredHighlight(
                centre + corner, covariance + floor, TOUCH if poor else "", spots.width_px, spots.width_sd_px
            )
        )
    return found


def noise_of(values: Array, inside: npt.NDArray[np.bool_]) -> float:
    """Return the standard deviation of the noise, from the differences of neighbours."""
    pairs = inside[:, 1:] & inside[:, :-1]
    if not pairs.any():
        return 0.0
    differences = np.abs(np.diff(np.asarray(values, dtype=float), axis=1)[pairs])
    return float(np.median(differences) / 0.6745 / np.sqrt(2))


def _surroundings(smooth: Array, widest_px: float) -> Array:
    """Return the brightness without what is narrower than a highlight may be: the grey-scale opening."""
    size = 2 * int(min(widest_px, MOST_OPENED_PX) / 2) + 3
    return np.asarray(cv2.morphologyEx(np.asarray(smooth, np.float32), cv2.MORPH_OPEN, np.ones((size, size), np.uint8)))


def _region(mask: npt.NDArray[np.bool_], row: int, column: int) -> npt.NDArray[np.bool_]:
    """Return the connected part of a mask that holds a pixel."""
    _, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    return np.asarray(labels == labels[row, column]) & mask


def _measured(
    values: Array, region: npt.NDArray[np.bool_], level: float, noise: float, corner: Array, peaks: Peaks,
    smooth: Array, widest_px: float,
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


def _problem(region: npt.NDArray[np.bool_], peaks: Peaks, smooth: Array, spread: Array, widest_px: float) -> str:
    """Return why a spot is no single highlight of a light; empty where it is one."""
    border = np.concatenate([region[0], region[-1], region[:, 0], region[:, -1]])
    if border.any():
        return "at the outline"
    length = 4 * float(np.sqrt(np.linalg.eigvalsh(spread)[1]))
    if length > widest_px:
        return "too large for a light"
    several = [smooth[r, c] for r, c in peaks if region[r, c]]
    # A flat, clipped top has many equal maxima.
    if len(several) > 1 and _is_split(smooth, region, np.array(several)):
        return TOUCH
    small, large = np.linalg.eigvalsh(spread)
    return "long: several highlights that touch, or a lamp" if large > LONGEST**2 * small else ""


def _is_split(smooth: Array, region: npt.NDArray[np.bool_], heights: Array) -> bool:
    """Return whether a spot falls apart below its second highest maximum by more than rounding and clipping do."""
    base = float(smooth[region].min())
    second = np.sort(heights)[-2]
    cut = (smooth > base + 0.95 * (second - base)) & region
    count, _ = cv2.connectedComponents(cut.astype(np.uint8), connectivity=8)
    return bool(count > 2)
