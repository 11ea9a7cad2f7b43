"""Steepest ascent among pixels: summits, their basins, and the saddles between those that touch."""

from dataclasses import dataclass

import numpy as np

from simtest.runtime.arrays import Index

_NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
"""The eight neighbours, row and column."""


@dataclass(frozen=True)
class Ascent:
    """Where steepest ascent leads from each of N pixels, which are numbered by height.

    `tops`, shape (S,), are the summits' pixels, row by row; `basins`, shape (N,), the number of each pixel's summit;
    `pairs`, shape (K, 2), the summits whose basins touch, the lower number first, each pair once; `saddles`, shape
    (K,), the lowest pixel of the highest way from one to the other directly.
    """

    tops: Index
    basins: Index
    pairs: Index
    saddles: Index

    @classmethod
    def of(cls, rows: Index, columns: Index, shape: tuple[int, ...]) -> "Ascent":
        """Climb from pixels of a frame, shape (H, W), which are given from the lowest to the highest."""
        pixels = np.arange(len(rows))
        # a margin of one pixel spares the borders
        number = np.full((shape[0] + 2, shape[1] + 2), -1, dtype=np.int64)
        number[rows + 1, columns + 1] = pixels
        neighbours = [number[rows + 1 + down, columns + 1 + right] for down, right in _NEIGHBOURS]
        # steepest ascent, and then each pixel's summit
        up = np.maximum.reduce([pixels, *neighbours])
        while not np.array_equal(further := up[up], up):
            up = further
        tops = np.flatnonzero(up == pixels)
        tops = tops[np.argsort(rows[tops] * shape[1] + columns[tops])]
        index = np.empty(len(rows), dtype=np.int64)
        index[tops] = np.arange(len(tops))
        basins = index[up]
        # the highest saddle of each pair of basins that touch: of two neighbours the lower one is on the way
        low = np.concatenate([np.flatnonzero(above > pixels) for above in neighbours])
        high = np.concatenate([above[above > pixels] for above in neighbours])
        return cls(tops, basins, *highest_of_pairs(basins[low], basins[high], low, len(tops)))


def highest_of_pairs(first: Index, second: Index, low: Index, count: int) -> tuple[Index, Index]:
    """Return the pairs of different basins, the lower number first, and the highest of the pixels given for each."""
    apart = first != second
    key = np.minimum(first, second)[apart] * count + np.maximum(first, second)[apart]
    low = low[apart]
    ranked = np.lexsort((-low, key))
    key, low = key[ranked], low[ranked]
    head = np.append(True, key[1:] != key[:-1])[: len(key)]
    return np.stack([key[head] // max(count, 1), key[head] % max(count, 1)], axis=1), low[head]
