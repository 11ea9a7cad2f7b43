"""Spots of specular light: pixels of single highlights, and of those that touch and count as one cluster."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.detection.basins import Basins, find_basins
from simtest.geometry.patch import rows_and_columns
from simtest.runtime.arrays import Array, Image, Index, Mask

SADDLE = 0.8
"""A summit counts if its saddle to any brighter one is below this share of it (theory.md 7.1b)."""

SADDLE_NOISE = 4.0
"""... and lower by so many standard deviations of the noise."""


RISE = 0.85
"""Clipped light is taken to rise by this power of 1 + the distance from the rim, px: so the shape of a clipped patch
tells the highlights that have melted in it apart."""


@dataclass(frozen=True)
class Spot:
    """Connected pixels of one highlight, or of several that touch.

    Parameters
    ----------
    peaks : ndarray of int, shape (N, 2)
        Column and row of each highlight's brightest pixel, the brightest first.
    value : float
        Specular light of the brightest.
    corner : tuple of int
        Column and row of the mask's first pixel in the frame.
    mask : ndarray of bool, shape (h, w)
        Its pixels above half height.
    touches : bool
        Whether it is the shoulder of a brighter one: its isophote at half height runs into that.
    melted : bool
        Whether its several peaks are told apart by the outline of clipped light alone.
    """

    peaks: Index
    value: float
    corner: tuple[int, int]
    mask: Mask
    touches: bool
    melted: bool

    @property
    def area_px(self) -> int:
        """Number of its pixels."""
        return int(np.count_nonzero(self.mask))

    @property
    def crop(self) -> tuple[slice, slice]:
        """Rows and columns of the mask in the frame."""
        x, y = self.corner
        height, width = self.mask.shape
        return slice(y, y + height), slice(x, x + width)


def find_spots(
    specular: Image, tissue: Image, mask: Mask, least: Image, noise: float, flat: Mask | None = None
) -> list[Spot]:
    """Find the spots among the pixels of a mask, the brightest first.

    Parameters
    ----------
    specular, tissue : ndarray, shape (H, W)
        The two parts of the light, smoothed.
    mask : ndarray of bool, shape (H, W)
        Pixels that may show a highlight.
    least : ndarray, shape (H, W)
        A highlight's peak has at least so much specular light.
    noise : float
        Standard deviation of the smoothed specular light.
    flat : ndarray of bool, shape (H, W), optional
        Pixels where all channels are clipped.
    """
    rise = rise_of_clipped(flat)
    basins = find_basins(specular * rise, mask, tissue * rise, SADDLE, SADDLE_NOISE * noise)
    return [spot for spot in spots_of(basins, specular, tissue) if spot.value >= least[_at(spot)]]


def rise_of_clipped(flat: Mask | None) -> Image | float:
    """Return the factor by which light is taken to rise where all channels are clipped: the farther from the rim."""
    if flat is None or not flat.any():
        return 1.0
    depth = cv2.distanceTransform(flat.astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray((1 + depth) ** RISE)


def _at(spot: Spot) -> tuple[int, int]:
    return int(spot.peaks[0][1]), int(spot.peaks[0][0])


def spots_of(basins: Basins, specular: Image, tissue: Image) -> list[Spot]:
    """Return the spots of basins, the brightest first: basins that the isophote at half height joins are one cluster.

    The two parts of the light, shape (H, W), are smoothed.
    """
    peak = specular[basins.rows, basins.columns].astype(np.float64)
    saddle = specular[basins.saddles[:, 0], basins.saddles[:, 1]].astype(np.float64)
    groups, touching = _groups(peak, basins.pairs, saddle)
    number, level = np.full(len(peak), -1), HIGHLIGHT_ISOVALUE * peak
    for i, group in enumerate(groups):
        number[group] = i
        level[group] = level[group[0]]
    melted = _melted(basins, specular + tissue, number, len(groups))
    return _cut(specular, basins, level, number, groups, touching, melted)


def _groups(peak: Array, pairs: Index, saddle: Array) -> tuple[list[list[int]], list[bool]]:
    """Group summits, the brightest first, with those that its half-height isophote holds.

    Also return which groups are shoulders: their isophotes at half height run into a brighter group.
    """
    near: list[list[tuple[int, float]]] = [[] for _ in peak]
    for (a, b), height in zip(pairs.tolist(), saddle.tolist(), strict=True):
        near[a].append((b, height))
        near[b].append((a, height))
    taken = np.zeros(len(peak), dtype=bool)
    groups: list[list[int]] = []
    touching: list[bool] = []
    for first in range(len(peak)):
        if taken[first]:
            continue
        level = HIGHLIGHT_ISOVALUE * float(peak[first])
        group, touches = [first], False
        taken[first] = True
        for member in group:
            for other, height in near[member]:
                if height < level or other in group:
                    continue
                if taken[other]:
                    touches = True
                else:
                    taken[other] = True
                    group.append(other)
        groups.append(sorted(group))
        touching.append(touches)
    return groups, touching


def _melted(basins: Basins, total: Image, number: Index, count: int) -> list[bool]:
    """Return for each group whether no saddle between its summits lies clearly below them in the light as it is."""
    inside = number[basins.pairs[:, 0]] == number[basins.pairs[:, 1]]
    pairs, saddles = basins.pairs[inside], basins.saddles[inside]
    summit = total[basins.rows, basins.columns]
    share = total[saddles[:, 0], saddles[:, 1]] / np.minimum(summit[pairs[:, 0]], summit[pairs[:, 1]])
    best = np.zeros(len(summit))
    for side in (0, 1):
        np.maximum.at(best, pairs[:, side], share)
    apart = np.bincount(number[best < SADDLE], minlength=count)
    return [bool(each == 0) for each in apart]


def _cut(
    specular: Image,
    basins: Basins,
    level: Array,
    number: Index,
    groups: list[list[int]],
    touching: list[bool],
    melted: list[bool],
) -> list[Spot]:
    """Cut the pixels of each group out of the frame."""
    rows, columns = rows_and_columns(basins.labels != 0)
    summit = basins.labels[rows, columns] - 1
    high = specular[rows, columns] >= level[summit]
    rows, columns, owner = rows[high], columns[high], number[summit[high]]
    order = np.argsort(owner, kind="stable")
    rows, columns, owner = rows[order], columns[order], owner[order]
    starts = np.searchsorted(owner, np.arange(len(groups) + 1))
    spots = []
    for i, group in enumerate(groups):
        y, x = rows[starts[i] : starts[i + 1]], columns[starts[i] : starts[i + 1]]
        top, left = int(y.min()), int(x.min())
        mask = np.zeros((int(y.max()) - top + 1, int(x.max()) - left + 1), dtype=bool)
        mask[y - top, x - left] = True
        peaks = np.stack([basins.columns[group], basins.rows[group]], axis=1)
        value = float(specular[basins.rows[group[0]], basins.columns[group[0]]])
        spots.append(Spot(peaks, value, (left, top), mask, touching[i], melted[i] and len(group) > 1))
    return spots
