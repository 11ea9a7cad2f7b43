"""Summits of bright pixels, the basin of each, and the saddles between them.

Each pixel belongs to the summit that steepest ascent leads to. Two summits are one where the saddle between them is not
clearly below the lower one, as in the definition of a visible highlight (theory.md 7.1b).
"""

from dataclasses import dataclass

import numpy as np

from simtest.geometry.patch import rows_and_columns
from simtest.runtime.arrays import Array, Image, Index, Mask

_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Half of the eight neighbours, row and column: each pair of pixels is met once."""


@dataclass(frozen=True)
class Basins:
    """The summits of a frame, the brightest first.

    Parameters
    ----------
    rows, columns : ndarray of int, shape (N,)
        The summits' pixels.
    labels : ndarray of int, shape (H, W)
        Number of the summit that a pixel belongs to, from 1; 0 outside the mask.
    pairs : ndarray of int, shape (K, 2)
        Summits, from 0, whose basins touch, the brighter first; each pair once.
    saddles : ndarray of int, shape (K, 2)
        Row and column of the lowest pixel of the highest way from one to the other directly.
    """

    rows: Index
    columns: Index
    labels: Index
    pairs: Index
    saddles: Index


def find_basins(values: Image, mask: Mask, base: Image, keep: float, noise: float) -> Basins:
    """Find the summits among the pixels of a mask.

    Parameters
    ----------
    values : ndarray, shape (H, W)
        What is climbed: specular light.
    mask : ndarray of bool, shape (H, W)
        Pixels that are climbed on.
    base : ndarray, shape (H, W)
        Light below it; saddles are judged by the sum.
    keep : float
        A summit stays where its saddle to a brighter one is below this share of it, both with their base, ...
    noise : float
        ... and lower than it by more than this.
    """
    shape = values.shape
    rows, columns, height, order, ends = _pixels_of(values, mask)
    count = len(rows)
    pixels = np.arange(count)
    # steepest ascent, and then each pixel's summit
    up = _highest_neighbour(order, pixels, ends)
    while not np.array_equal(further := up[up], up):
        up = further
    tops, basin = _numbered(up, count)
    if not len(tops):
        empty = np.empty(0, dtype=np.int64)
        return Basins(
            empty, empty, np.zeros(shape, dtype=np.int64), np.empty((0, 2), np.int64), np.empty((0, 2), np.int64)
        )
    first, second, saddle = _saddles(basin, order, pixels, ends, len(tops))
    total = height + base[rows, columns]
    owner = _merged(
        order[tops], (height[tops], total[tops]), (first, second, height[saddle], total[saddle]), keep, noise
    )
    # summits that stay, the brightest first
    kept, _ = _numbered(owner, len(tops))
    kept = kept[np.argsort(-order[tops[kept]], kind="stable")]
    rank = np.full(len(tops), -1)
    rank[kept] = np.arange(len(kept))
    mine = rank[owner]
    labels = np.zeros(shape, dtype=np.int64)
    labels[rows, columns] = mine[basin] + 1
    pairs, low = _highest_of_pairs(mine[first], mine[second], saddle, order, len(kept))
    return Basins(rows[tops[kept]], columns[tops[kept]], labels, pairs, np.stack([rows[low], columns[low]], axis=1))


def _pixels_of(values: Image, mask: Mask) -> tuple[Index, Index, Array, Index, list[Index]]:
    """Return rows, columns, heights and strict order of a mask's pixels, and the numbers of their neighbours, or -1."""
    # a margin of one pixel spares the borders
    number = np.full((mask.shape[0] + 2, mask.shape[1] + 2), -1, dtype=np.int64)
    rows, columns = rows_and_columns(mask)
    count = len(rows)
    number[rows + 1, columns + 1] = np.arange(count)
    height = values[rows, columns].astype(np.float64)
    # A strict order, so that a plateau has a way up too.
    order = np.empty(count, dtype=np.int64)
    order[np.argsort(height, kind="stable")] = np.arange(count)
    return rows, columns, height, order, [number[rows + 1 + down, columns + 1 + right] for down, right in _NEIGHBOURS]


def _numbered(values: Index, count: int) -> tuple[Index, Index]:
    """Return the different ones of whole numbers from 0 to below `count`, rising, and which of them each one is.

    `np.unique` sorts for it, and loads `numpy.ma`.
    """
    present = np.zeros(count, dtype=bool)
    present[values] = True
    return np.flatnonzero(present), (np.cumsum(present) - 1)[values]


def _highest_neighbour(order: Index, pixels: Index, ends: list[Index]) -> Index:
    """Return for each pixel the highest of itself and its neighbours."""
    up, best = pixels.copy(), order.copy()
    for end in ends:
        here = np.flatnonzero(end >= 0)
        there = end[here]
        for start, stop in ((here, there), (there, here)):
            higher = order[stop] > best[start]
            best[start[higher]], up[start[higher]] = order[stop[higher]], stop[higher]
    return up


def _saddles(basin: Index, order: Index, pixels: Index, ends: list[Index], count: int) -> tuple[Index, Index, Index]:
    """Return pairs of basins that touch, and the pixel of the highest saddle of each."""
    starts, stops = [], []
    for end in ends:
        here = pixels[end >= 0]
        there = end[end >= 0]
        apart = basin[here] != basin[there]
        starts.append(here[apart])
        stops.append(there[apart])
    start, stop = np.concatenate(starts), np.concatenate(stops)
    low = np.where(order[start] <= order[stop], start, stop)
    pairs, low = _highest_of_pairs(basin[start], basin[stop], low, order, count)
    return pairs[:, 0], pairs[:, 1], low


def _highest_of_pairs(first: Index, second: Index, low: Index, order: Index, count: int) -> tuple[Index, Index]:
    """Return the pairs of different basins, the lower number first, and the highest of the pixels given for each."""
    apart = first != second
    key = np.minimum(first, second)[apart] * count + np.maximum(first, second)[apart]
    low = low[apart]
    ranked = np.lexsort((-order[low], key))
    key, low = key[ranked], low[ranked]
    head = np.append(True, key[1:] != key[:-1])[: len(key)]
    return np.stack([key[head] // count, key[head] % count], axis=1), low[head]


def _merged(
    order: Index, summits: tuple[Array, Array], saddles: tuple[Index, Index, Array, Array], keep: float, noise: float
) -> Index:
    """Return for each summit the one that it belongs to, flooding from the highest saddle down.

    Summits and saddles are given as heights without and with their base.
    """
    first, second, level, total = saddles
    owner = list(range(len(order)))
    flooded = list(range(len(order)))
    for k in np.argsort(-level, kind="stable").tolist():
        a, b = int(first[k]), int(second[k])
        top_a, top_b = _root(flooded, a), _root(flooded, b)
        if top_a == top_b:
            continue
        if order[top_a] < order[top_b]:
            a, b, top_a, top_b = b, a, top_b, top_a
        if total[k] >= keep * summits[1][top_b] or summits[0][top_b] - level[k] <= noise:
            owner[_root(owner, top_b)] = _root(owner, a)
        flooded[top_b] = top_a
    return np.array([_root(owner, i) for i in range(len(owner))], dtype=np.int64)


def _root(of: list[int], i: int) -> int:
    """Return what a number belongs to in the end, and shorten the way there."""
    while of[i] != i:
        of[i] = of[of[i]]
        i = of[i]
    return i
