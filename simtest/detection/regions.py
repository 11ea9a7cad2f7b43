"""Isolated peaks: local maxima whose isophote at half height closes inside the frame and holds no higher peak."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration.frame import median
from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA, HIGHLIGHT_ISOVALUE
from simtest.geometry.patch import connected, dilated
from simtest.runtime.arrays import Array, Image, Mask

EXPANSION = 2.0
"""Region of interest over the highlight's size at half height; a Gaussian at t = 0.1 is 1.8 times that size."""

MARGIN_PX = 8
MIN_AREA_PX = 12
"""Fewer pixels above half height determine no ellipse."""

MAX_PEAKS = 2000
"""Only so many local maxima, the brightest, are examined."""

NOISE_FREE_SHARE = 1e-3
"""Least contrast where the noise is 0, as a share of the frame's maximum."""


@dataclass(frozen=True)
class Region:
    """The region of interest of a specularity.

    Parameters
    ----------
    box : tuple of int
        Column, row, width, height, px.
    peak : tuple of int
        Column and row of the brightest smoothed pixel.
    contrast : float or None
        Peak above its surroundings, frame units; None for a region that was given, not detected.
    """

    box: tuple[int, int, int, int]
    peak: tuple[int, int]
    contrast: float | None


@dataclass(frozen=True)
class Component:
    """The connected pixels above half of a peak's value: a mask whose first pixel is (x, y) in the frame.

    It is closed if it stays clear of the frame's border and of pixels outside the view mask.
    """

    mask: Mask
    x: int
    y: int
    closed: bool

    def holds(self, point_px: Array) -> bool:
        """Return whether a point, px, lies in one of the pixels."""
        column, row = np.floor(point_px).astype(int) - [self.x, self.y]
        height, width = self.mask.shape
        return 0 <= row < height and 0 <= column < width and bool(self.mask[row, column])


def detect(smoothed: Image, noise: float | Image, isolated: bool = True, seen: Mask | None = None) -> list[Region]:
    """Find the specularities of a frame, the brightest first.

    Each is a local maximum whose isophote at t = 0.5 closes inside the frame without a higher value in it, and which
    stands 10 noise standard deviations above its surroundings.

    Parameters
    ----------
    smoothed : ndarray of float32, shape (H, W)
        Smoothed intensities.
    noise : float, or ndarray of float32, shape (H, W)
        Standard deviation of the unsmoothed frame's noise, frame units; an array where it differs between pixels.
    isolated : bool
        Leave out those whose isophote at t = 0.5 reaches the frame's border, or that of the view.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.
    """
    image = np.where(np.isfinite(smoothed), smoothed, 0).astype(np.float32)
    if seen is not None:
        image[~seen] = 0
    if min(image.shape) < 3 or image.max() <= 0:
        return []
    least = NOISE_FREE_SHARE * float(image.max())
    threshold = np.broadcast_to(np.maximum(HIGHLIGHT_CONTRAST_SIGMA * np.asarray(noise), least), image.shape)
    # candidates: local maxima, the brightest first; each takes the pixels above half its height
    taken = np.zeros(image.shape, dtype=bool)
    regions = []
    for row, column in _local_maxima(image, threshold):
        if taken[row, column]:
            continue
        found = half_height_component(image, row, column, seen)
        if found is None:
            continue
        mask, x, y = found.mask, found.x, found.y
        taken[y : y + mask.shape[0], x : x + mask.shape[1]] |= mask
        # reject: open, too low or too small
        if isolated and not found.closed:
            continue
        height_above = contrast(image, found, float(image[row, column]), seen)
        if height_above >= threshold[row, column] and np.count_nonzero(mask) >= MIN_AREA_PX:
            regions.append(Region(_expanded_box(found, image.shape), (column, row), height_above))
    return regions


def _local_maxima(image: Image, threshold: npt.NDArray[np.floating]) -> list[tuple[int, int]]:
    """Return rows and columns of the local maxima above their threshold, the brightest first."""
    highest = cv2.dilate(image, np.ones((3, 3), np.uint8))
    maxima = (image >= highest) & (image > threshold.astype(np.float32))
    rows, columns = np.nonzero(maxima)
    if len(rows) > MAX_PEAKS:
        # One pixel for each plateau: clipped ones must not crowd out the other peaks.
        labels = connected(maxima, diagonally=True)
        first = np.sort(np.unique(labels[rows, columns], return_index=True)[1])
        rows, columns = rows[first], columns[first]
    order = np.argsort(-image[rows, columns], kind="stable")[:MAX_PEAKS]
    return [(int(rows[i]), int(columns[i])) for i in order]


def half_height_component(image: Image, row: int, column: int, seen: Mask | None = None) -> Component | None:
    """Return the connected pixels above half of the value of the peak at (row, column) of a smoothed image.

    None where they hold a higher peak. `seen` holds the pixels inside the camera's view mask.
    """
    peak = float(image[row, column])
    return component_above(image, row, column, HIGHLIGHT_ISOVALUE * peak, seen, most=peak)


def component_above(
    image: Image, row: int, column: int, level: float, seen: Mask | None = None, most: float = math.inf
) -> Component | None:
    """Return the connected pixels of at least a level around (row, column), which is one; None where one is > `most`.

    `seen` holds the pixels inside the camera's view mask.
    """
    rows, columns = image.shape
    # the window grows until the component no longer touches its sides
    half = 8
    while True:
        y0, y1 = max(row - half, 0), min(row + half + 1, rows)
        x0, x1 = max(column - half, 0), min(column + half + 1, columns)
        window = image[y0:y1, x0:x1]
        labels = connected(window >= level)
        mask = labels == labels[row - y0, column - x0]
        if float(window[mask].max()) > most:
            return None
        edges = ((mask[0], y0 == 0), (mask[-1], y1 == rows), (mask[:, 0], x0 == 0), (mask[:, -1], x1 == columns))
        touched = [at_border for line, at_border in edges if line.any()]
        if all(touched):
            cut = seen is not None and bool((dilated(mask) & ~seen[y0:y1, x0:x1]).any())
            return Component(mask, x0, y0, closed=not touched and not cut)
        half *= 2


def contrast(image: Image, component: Component, peak: float, seen: Mask | None = None) -> float:
    """Return a peak's height above the median of its surroundings, in the units of a smoothed image.

    The surroundings are the region of interest outside the component at half height, inside the view mask `seen`. Where
    the component fills its region, they are the image's least value.
    """
    left, top, width, height = _expanded_box(component, image.shape)
    inside = np.zeros((height, width), dtype=bool)
    rows, columns = np.nonzero(component.mask)
    inside[rows + component.y - top, columns + component.x - left] = True
    if seen is not None:
        inside |= ~seen[top : top + height, left : left + width]
    around = image[top : top + height, left : left + width][~inside]
    least = image.min() if seen is None else image.min(where=seen, initial=np.inf)
    return peak - float(median(around) if around.size else least)


def _expanded_box(component: Component, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return the region of interest around a component, inside the frame."""
    mask, x, y = component.mask, component.x, component.y
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    grow_x = int((columns[-1] - columns[0] + 1) * (EXPANSION - 1) / 2) + MARGIN_PX
    grow_y = int((rows[-1] - rows[0] + 1) * (EXPANSION - 1) / 2) + MARGIN_PX
    x0, x1 = max(x + int(columns[0]) - grow_x, 0), min(x + int(columns[-1]) + 1 + grow_x, shape[1])
    y0, y1 = max(y + int(rows[0]) - grow_y, 0), min(y + int(rows[-1]) + 1 + grow_y, shape[0])
    return x0, y0, x1 - x0, y1 - y0
