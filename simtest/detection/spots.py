"""Spots of specular light: pixels of single highlights, and of those that touch and count as one cluster."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.detection.basins import Basins, find_basins
from simtest.runtime.arrays import Array, Image, Index, Mask

SADDLE = 0.8
"""A summit counts if its saddle to any brighter one is below this share of it (theory.md 7.1b)."""

SADDLE_NOISE = 4.0
"""... and lower by so many standard deviations of the noise."""


RISE = 0.3
"""Clipped light is taken to rise by this share for each pixel from the rim: so the shape of a clipped patch tells the
highlights that have melted in it apart."""


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
    """

    peaks: Index
    value: float
    corner: tuple[int, int]
    mask: Mask
    touches: bool

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
    climbed, base = specular, tissue
    if flat is not None and flat.any():
        # Light that is clipped is the higher the farther from the rim.
        rise = np.exp(RISE * cv2.distanceTransform(flat.astype(np.uint8), cv2.DIST_L2, 5))
        climbed, base = specular * rise, tissue * rise
    basins = find_basins(climbed, mask, base, SADDLE, SADDLE_NOISE * noise)
    peak = specular[basins.rows, basins.columns].astype(np.float64)
    high = peak >= least[basins.rows, basins.columns]
    saddle = specular[basins.saddles[:, 0], basins.saddles[:, 1]].astype(np.float64)
    groups, touching = _groups(peak, basins.pairs, saddle)
    level = HIGHLIGHT_ISOVALUE * peak
    number = np.full(len(peak), -1)
    for i, group in enumerate(groups):
        number[group] = i
    # The members of a cluster hang together above the saddles between them.
    inside = number[basins.pairs[:, 0]] == number[basins.pairs[:, 1]]
    pairs, saddles = basins.pairs[inside], saddle[inside]
    for side in (0, 1):
        joined = saddles >= HIGHLIGHT_ISOVALUE * np.minimum(peak[pairs[:, 0]], peak[pairs[:, 1]])
        np.minimum.at(level, pairs[joined, side], saddles[joined])
    return [
        spot
        for spot, group in zip(_cut(specular, basins, level, number, groups, touching), groups, strict=True)
        if high[group].any()
    ]


def _groups(peak: Array, touching: Index, heights: Array) -> tuple[list[list[int]], list[bool]]:
    """Group summits that half height does not part, the brightest first; also return which are shoulders."""
    linked = heights >= HIGHLIGHT_ISOVALUE * np.minimum(peak[touching[:, 0]], peak[touching[:, 1]])
    pairs, saddles = touching[linked].tolist(), heights[linked].tolist()
    # A summit whose own isophote at half height holds no other stands alone, whatever its shoulders.
    reached = np.zeros(len(peak), dtype=bool)
    for (a, b), saddle in zip(pairs, saddles, strict=True):
        reached[a] |= saddle >= HIGHLIGHT_ISOVALUE * peak[a]
        reached[b] |= saddle >= HIGHLIGHT_ISOVALUE * peak[b]
    parent = list(range(len(peak)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for a, b in pairs:
        if reached[a] and reached[b]:
            one, other = sorted((root(a), root(b)))
            parent[other] = one
    groups: dict[int, list[int]] = {}
    for i in range(len(peak)):
        groups.setdefault(root(i), []).append(i)
    return list(groups.values()), [bool(len(group) == 1 and reached[group[0]]) for group in groups.values()]


def _cut(
    specular: Image, basins: Basins, level: Array, number: Index, groups: list[list[int]], touching: list[bool]
) -> list[Spot]:
    """Cut the pixels of each group out of the frame."""
    rows, columns = np.nonzero(basins.labels)
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
        spots.append(Spot(peaks, value, (left, top), mask, touching[i]))
    return spots
