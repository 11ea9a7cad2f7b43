"""A level-set function on a regular grid, evaluated only where its zero can be.

Blocks of cells are halved, from coarse to fine. In a block of half diagonal r about c, F has no zero if
abs(F(c)) > L r, with L a bound on its slope there: such a block gets the value F(c), whose sign is right. The other
nodes get F itself, so marching cubes find the same triangles as on the whole grid.
"""

from collections.abc import Callable

import numpy as np

from simtest.runtime.arrays import AnyArray, Array

SIDES = (16, 8, 4, 2)
"""Cells along the side of a block, from coarse to fine."""

POINTS = 8192
"""Points that are evaluated together: their temporaries stay in the processor's cache."""

ROUNDING = 1e-9
"""Relative margin of the bound, for rounding."""


def level_grid(
    values: Callable[[Array], Array],
    slopes: Callable[[Array, float], Array],
    axes: list[Array],
    sides: tuple[int, ...] = SIDES,
) -> Array:
    """Return F at the nodes of a grid, exact at the corners of every cell that its zero passes.

    Parameters
    ----------
    values : Callable
        F at points, shape (N, 3), mm.
    slopes : Callable
        Upper bounds of the gradient's length within a radius, mm, of points.
    axes : list of ndarray
        The nodes' coordinates along x, y and z, mm, evenly spaced.
    sides : tuple of int
        See `SIDES`; each is a multiple of the next.
    """
    shape = tuple(len(axis) for axis in axes)
    spacing = float(axes[0][1] - axes[0][0])
    near = np.ones([-(-size // sides[0]) for size in shape], dtype=bool)
    coarse = np.empty(near.shape)
    for side, finer in zip(sides, (*sides[1:], 1), strict=True):
        # The blocks that may hold the zero, by F at their centres
        blocks, radius = np.nonzero(near), side * spacing * np.sqrt(3) / 2
        centres = np.stack([axis[0] + (i + 0.5) * side * spacing for axis, i in zip(axes, blocks, strict=True)], axis=1)
        f = in_blocks(values, centres)
        coarse[blocks] = f
        near[blocks] = np.abs(f) <= in_blocks(_within(slopes, radius), centres) * radius * (1 + ROUNDING)
        # Blocks of the next side, in the end nodes; some of them lie beyond the grid.
        sizes = [-(-size // finer) for size in shape]
        coarse, near = _halved(coarse, side // finer, sizes), _halved(near, side // finer, sizes)
    # The corners of all cells of the blocks that are left: a block's own nodes, and the next ones along each axis.
    for axis in range(3):
        rolled = np.moveaxis(near, axis, 0)
        rolled[1:] |= rolled[:-1].copy()
    nodes = np.nonzero(near)
    coarse[nodes] = in_blocks(values, np.stack([axis[i] for axis, i in zip(axes, nodes, strict=True)], axis=1))
    return coarse


def in_blocks(function: Callable[[Array], Array], points: Array) -> Array:
    """Return a function of points, shape (N, 3), computed for some of them at a time."""
    parts = [function(points[start : start + POINTS]) for start in range(0, max(len(points), 1), POINTS)]
    return np.concatenate(parts) if len(parts) > 1 else parts[0]


def _within(slopes: Callable[[Array, float], Array], radius: float) -> Callable[[Array], Array]:
    return lambda points: slopes(points, radius)


def _halved(blocks: AnyArray, ratio: int, sizes: list[int]) -> AnyArray:
    """Cut each block into `ratio` ones along each axis, which take its value, and drop those beyond the grid."""
    for axis, size in enumerate(sizes):
        blocks = np.repeat(blocks, ratio, axis=axis).take(range(size), axis=axis)
    return blocks
