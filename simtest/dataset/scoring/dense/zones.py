"""Where a frame's pixels lie relative to its visible highlights: at one, in a ring around one, or elsewhere."""

import cv2
import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, IntArray

RINGS = (1.0, 2.0, 4.0)
"""Outer ends of the rings, as multiples of the highlight's radius, counted from the highlight's edge."""

ZONES = ("highlight", "ring_1", "ring_2", "ring_4", "elsewhere")
"""Names of the zones, by number. A ring is called by its outer end."""


def zones(regions: IntArray) -> npt.NDArray[np.uint8]:
    """Return the zone of each pixel, shape (H, W): an index in `ZONES`.

    A highlight is the region of the spot above half its height, and its radius that of the circle of the same area. A
    pixel outside belongs to the innermost ring that any highlight has there.

    Parameters
    ----------
    regions : ndarray of int, shape (H, W)
        Number of the highlight whose pixel it is, from 1; 0 where there is none (`VisibleSpots.regions`).
    """
    nearness = _radii_away(regions)
    numbers = np.searchsorted(RINGS, nearness, side="left") + 1
    return np.where(regions > 0, 0, numbers).astype(np.uint8)


def _radii_away(regions: IntArray) -> Array:
    """Return the distance from each pixel to a highlight's edge over that one's radius, the least of all highlights."""
    nearness = np.full(regions.shape, np.inf)
    height, width = regions.shape
    for number in range(1, int(regions.max(initial=0)) + 1):
        inside = regions == number
        if not inside.any():
            continue
        radius = float(np.sqrt(inside.sum() / np.pi))
        # Only as far as the outermost ring reaches: a frame may hold hundreds of small highlights.
        reach = int(np.ceil(RINGS[-1] * radius)) + 2
        rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        top, bottom = max(rows[0] - reach, 0), min(rows[-1] + reach + 1, height)
        left, right = max(columns[0] - reach, 0), min(columns[-1] + reach + 1, width)
        window = np.where(inside[top:bottom, left:right], 0, 1).astype(np.uint8)
        # To the centre of the highlight's outermost pixel: its edge lies half a pixel nearer.
        away = (cv2.distanceTransform(window, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) - 0.5) / radius
        view = nearness[top:bottom, left:right]
        np.minimum(view, away, out=view)
    return nearness
