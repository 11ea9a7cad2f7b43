"""Bootstrap over groups, the independent units of a study: anatomies, frames or scenes."""

import numpy as np

from simtest.runtime.arrays import Array, IntArray


def drawn_groups(count: int, draws: int, seed: int | np.random.Generator) -> IntArray:
    """Return the groups of each draw, with replacement, shape (draws, count)."""
    return np.random.default_rng(seed).integers(count, size=(draws, count))


def interval_of_mean(
    values: Array, groups: Array | IntArray, draws: int, seed: int | np.random.Generator
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of values by bootstrap over their groups.

    `values` (shape (N,)): finite; `groups` (shape (N,)): number of the group of each; a group keeps all its values,
    so groups may differ in size; `draws`, `seed`: of the bootstrap.
    """
    own = np.unique(groups, return_inverse=True)[1]
    sums, counts = np.bincount(own, values), np.bincount(own)
    drawn = drawn_groups(len(counts), draws, seed)
    low, high = np.percentile(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1), [2.5, 97.5])
    return float(low), float(high)
