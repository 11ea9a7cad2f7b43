"""Lines of space drawn into the image: the pixels that they cross, where nothing hides them."""

import cv2
import numpy as np

from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array, Image, IntArray, Mask

BEHIND = 1.02
"""A point is hidden if it lies farther away than this times the surface around its pixel."""

STEP_PX = 0.5
"""Between the points of a stroke."""

MOST_STEPS = 4096
"""Points of one stroke: it is longer than any frame."""


class Strokes:
    """Marks the pixels that lines cross.

    Parameters
    ----------
    camera : Camera
        The camera.
    depth : ndarray, shape (H, W)
        Distance along the rays through the pixels' centres, mm; NaN where there is no surface.

    Attributes
    ----------
    marked : ndarray of bool, shape (H, W)
        The pixels.
    """

    def __init__(self, camera: Camera, depth: Image) -> None:
        self.camera = camera
        self.marked: Mask = np.zeros((camera.height, camera.width), dtype=bool)
        # The farthest around: a line at an edge of the depth may be seen beside it.
        known = np.where(np.isfinite(depth), depth, np.float32(np.inf)).astype(np.float32)
        self._farthest = BEHIND * cv2.dilate(known, np.ones((3, 3), np.uint8))

    def project(self, points: Array) -> Array:
        """Return the pixels of points, shape (N, 3), camera frame, mm; NaN where the lens images nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.camera.project(points)

    def draw(self, points: Array, line: IntArray) -> None:
        """Draw lines through points, shape (N, 3), camera frame, mm; `line` is the index of each point's, in order."""
        if not len(points):
            return
        places, distances = self.project(points), np.linalg.norm(points, axis=1)
        self._mark(places, distances)
        # Straight strokes from each point to the next of its line.
        linked = np.flatnonzero((line[1:] == line[:-1]) & np.isfinite(places[1:] + places[:-1]).all(axis=1))
        starts, ends = places[linked], places[linked + 1]
        size = np.array([self.camera.width, self.camera.height])
        inside = (np.maximum(starts, ends) > 0).all(axis=1) & (np.minimum(starts, ends) < size).all(axis=1)
        linked, starts, ends = linked[inside], starts[inside], ends[inside]
        # Points between the two ends of each stroke.
        steps = np.clip(np.ceil(np.linalg.norm(ends - starts, axis=1) / STEP_PX), 1, MOST_STEPS).astype(np.int64)
        inner = steps - 1
        stroke = np.repeat(np.arange(len(steps)), inner)
        number = 1 + np.arange(len(stroke)) - np.repeat(np.cumsum(inner) - inner, inner)
        between = starts[stroke] + (number / steps[stroke])[:, None] * (ends - starts)[stroke]
        nearer = np.minimum(distances[linked], distances[linked + 1])
        self._mark(between, nearer[stroke])

    def _mark(self, places: Array, distances: Array) -> None:
        """Mark the pixels of positions that are not hidden at their distances."""
        with np.errstate(invalid="ignore"):
            inside = ((places >= 0) & (places < [self.camera.width, self.camera.height])).all(axis=1)
        column, row = places[inside].astype(np.int64).T
        seen = distances[inside] <= self._farthest[row, column]
        self.marked[row[seen], column[seen]] = True
