"""`peaks`: isolated peaks of the mean of the channels that have the shape of a point highlight.

Peaks are local maxima whose isophote at half height closes inside the frame and holds no higher one. Where the normal
bisects the directions to light and camera, the isophotes are ellipses of one shape and centre for every isotropic
reflectance, and a glossy lobe falls off at least as fast as a Gaussian (theory.md section 3, items 1 and 3). Another
kind of peak is where the normal only comes closest to the bisector, at misfit w: there J^T w = 0, so the misfit's
Jacobian J is singular, the quadratic term along that direction is small or zero, and the peak is flat-topped with bent
or pointed isophotes. Ridges, corners of folds and merged highlights look like that.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.calibration.frame import median
from simtest.conventions import (
    HIGHLIGHT_CONTRAST_SIGMA,
    HIGHLIGHT_ELLIPSE_RESIDUAL,
    HIGHLIGHT_ISOVALUE,
    HIGHLIGHT_WIDTH_EXCESS,
)
from simtest.detection.detector import Detection, Region
from simtest.detection.view import view_of
from simtest.errors import Failure
from simtest.geometry import Camera, FittedConic, Patch, fit_ellipse, smooth
from simtest.geometry.patch import connected, dilated, share_of_noise
from simtest.runtime.arrays import AnyArray, Image, Mask

Box = tuple[int, int, int, int]
"""Column, row, width, height."""

EXPANSION = 2.0
"""Region of interest over the highlight's size at half height; a Gaussian at t = 0.1 is 1.8 times that size."""

MARGIN_PX = 8
MIN_AREA_PX = 12
"""Fewer pixels above half height determine no ellipse."""

MAX_PEAKS = 2000
"""Only so many local maxima, the brightest, are examined."""

NOISE_FREE_SHARE = 1e-3
"""Least contrast where the noise is 0, as a share of the frame's maximum."""

RESIDUAL_ISOVALUE = 0.7
"""The isophote that is compared with an ellipse: lower ones reach farther out, where curvature changes, and higher
ones are noisier."""

TOP_ISOVALUE = 0.8
"""The isophote whose width is compared with that at half height."""

SCALE = 0.2
"""A peak is smoothed by this share of its radius at half height before its shape is measured."""

NOISE_FACTOR = 2.0
"""Standard deviations of a contour's noise that the residual may have on top, added in squares."""

MIN_FLAT_PX = 12
"""So many pixels with the frame's largest value are clipped ones, not an accident."""

LEAST_LEVEL = 0.05
"""Widths are measured at no less than this share of a peak's height above its surroundings."""


@dataclass(frozen=True)
class Component:
    """The connected pixels above half of a peak's value: a mask whose first pixel is (x, y) in the frame.

    It is closed if it stays clear of the frame's border and of pixels outside the view mask.
    """

    mask: Mask
    x: int
    y: int
    closed: bool

    @property
    def crop(self) -> tuple[slice, slice]:
        """Rows and columns of the mask in the frame."""
        height, width = self.mask.shape
        return slice(self.y, self.y + height), slice(self.x, self.x + width)

    def holds(self, points_px: AnyArray) -> Mask:
        """Return which points, px, shape (N, 2), lie in one of the pixels."""
        columns, rows = (np.floor(points_px).astype(int) - [self.x, self.y]).T
        height, width = self.mask.shape
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        inside[inside] = self.mask[rows[inside], columns[inside]]
        return np.asarray(inside)


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
        component = half_height_component(image, row, column, seen)
        if component is None:
            continue
        taken[component.crop] |= component.mask
        # reject: open, too low or too small
        if isolated and not component.closed:
            continue
        height_above = contrast(image, component, float(image[row, column]), seen)
        if height_above >= threshold[row, column] and np.count_nonzero(component.mask) >= MIN_AREA_PX:
            regions.append(Region(_expanded_box(component, image.shape), (column, row), height_above))
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
    box = np.s_[top : top + height, left : left + width]
    outside = np.ones((height, width), dtype=bool) if seen is None else seen[box].copy()
    rows, columns = np.nonzero(component.mask)
    outside[rows + component.y - top, columns + component.x - left] = False
    around = image[box][outside]
    if around.size:
        return peak - float(median(around))
    return peak - float(image.min() if seen is None else image.min(where=seen, initial=np.inf))


def grown_box(corner: tuple[int, int], size: tuple[int, int], shape: tuple[int, ...]) -> Box:
    """Return a box, of a first pixel and a size as (x, y), grown by `EXPANSION` and `MARGIN_PX`, inside the frame."""
    starts, sizes = [], []
    for start, length, end in zip(corner, size, shape[1::-1], strict=True):
        grow = int(length * (EXPANSION - 1) / 2) + MARGIN_PX
        starts.append(max(start - grow, 0))
        sizes.append(min(start + length + grow, end) - starts[-1])
    return starts[0], starts[1], sizes[0], sizes[1]


def _expanded_box(component: Component, shape: tuple[int, ...]) -> Box:
    """Return the region of interest around a component, inside the frame."""
    rows, columns = np.flatnonzero(component.mask.any(axis=1)), np.flatnonzero(component.mask.any(axis=0))
    corner = component.x + int(columns[0]), component.y + int(rows[0])
    return grown_box(corner, (int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1), shape)


@dataclass(frozen=True)
class PeakShape:
    """How a peak differs from a point highlight.

    Parameters
    ----------
    residual, residual_noise : float
        RMS distance of the isophote at t = 0.7 from its ellipse, as a share of the ellipse's radius, and the noise's
        part of it.
    width_excess, width_noise : float
        Width of the isophote at t = 0.8 over that at t = 0.5, in the direction where this is largest, over the same
        ratio of a Gaussian on the same surroundings, less 1, and the noise's part of it: 0 for a Gaussian, negative
        for a sharper peak, NaN where the peak is clipped or a width cannot be measured.
    """

    residual: float
    residual_noise: float
    width_excess: float
    width_noise: float

    @property
    def is_highlight(self) -> bool:
        """Whether the shape differs from a point highlight's by no more than thresholds and noise."""
        # Residual and noise add in squares, excess and noise linearly: a wide Phong lobe (n = 10 to 50) has an excess
        # of 0.01 to 0.025 of its own.
        bent = self.residual > math.hypot(HIGHLIGHT_ELLIPSE_RESIDUAL, NOISE_FACTOR * self.residual_noise)
        flat = self.width_excess > HIGHLIGHT_WIDTH_EXCESS + self.width_noise
        return not (bent or flat)


def flat_pixels(frame: npt.NDArray[np.floating], seen: Mask | None = None) -> Mask | None:
    """Find the clipped pixels of a frame, shape (H, W) or (H, W, C), without a calibration.

    They are those of the view, `seen`, default all, where a channel has the largest value there; None where these are
    so few that they may be an accident.
    """
    largest = frame >= (frame if seen is None else frame[seen]).max(initial=-np.inf)
    mask = np.asarray(largest if largest.ndim == 2 else largest.any(axis=2))
    mask = mask if seen is None else mask & seen
    return mask if np.count_nonzero(mask) >= MIN_FLAT_PX else None


def peak_shape(patch: Patch, region: Region, noise: float, clipped: Mask | None = None) -> PeakShape | Failure:
    """Measure a peak's shape; a Failure where an isophote does not close or no ellipse fits.

    Parameters
    ----------
    patch : Patch
        The region's smoothed crop.
    region : Region
        For the peak's contrast; that of a given region is the peak itself.
    noise : float
        Standard deviation of the smoothed frame's noise at the peak, in the patch's units.
    clipped : ndarray of bool, shape (H, W), optional
        Where the frame is clipped (see `flat_pixels`), besides the patch's own mask.
    """
    # ellipses of three isophotes
    clean, left = _at_own_scale(patch)
    contours = clean.crossings_of((HIGHLIGHT_ISOVALUE, RESIDUAL_ISOVALUE, TOP_ISOVALUE))
    fits = []
    for contour in contours:
        fitted = contour if isinstance(contour, Failure) else fit_ellipse(contour)
        if isinstance(fitted, Failure):
            return fitted
        fits.append(fitted)
    at_half, at_residual, at_top = fits
    points = contours[1]
    assert not isinstance(points, Failure)
    # their levels over the surroundings
    contrast = patch.peak_value if region.contrast is None else region.contrast
    height = contrast - (patch.peak_value - clean.peak_value)
    half, level, top = (
        1 - (1 - t) * clean.peak_value / height for t in (HIGHLIGHT_ISOVALUE, RESIDUAL_ISOVALUE, TOP_ISOVALUE)
    )
    excess = math.nan
    x, y, width, box_height = region.box
    masks = (patch.saturated, None if clipped is None else clipped[y : y + box_height, x : x + width])
    cut = any(mask is not None and bool((mask & patch.inside(TOP_ISOVALUE)).any()) for mask in masks)
    if half >= LEAST_LEVEL and not cut:
        gaussian = math.sqrt(math.log(top) / math.log(half))
        excess = _largest_width_ratio(at_top, at_half) / gaussian - 1
    relative = left * noise / height
    residual = float(np.sqrt(np.mean((at_residual.relative_radii(points) - 1) ** 2)))
    return PeakShape(residual, relative / _slope(level), excess, relative / _slope(top))


def _at_own_scale(patch: Patch) -> tuple[Patch, float]:
    """Smooth a peak by a share of its width, which leaves a Gaussian one; also return the remaining share of noise."""
    width = math.sqrt(float(np.count_nonzero(patch.inside(HIGHLIGHT_ISOVALUE))) / math.pi)
    more = SCALE * width
    if more <= patch.smoothing_px / 2:
        return patch, 1.0
    # the peak of the smoothed patch, near the old one
    values, width_px = smooth(patch.values, more, patch.seen), math.hypot(patch.smoothing_px, more)
    rows, columns = np.nonzero(patch.inside(TOP_ISOVALUE))
    highest = int(np.argmax(values[rows, columns]))
    height, wide = values.shape
    smoothed = Patch.cut(
        values, (0, 0, wide, height), (int(columns[highest]), int(rows[highest])), patch.origin_px,
        seen=patch.seen, smoothing_px=width_px,
    )  # fmt: skip
    if isinstance(smoothed, Failure):
        return patch, 1.0
    return smoothed, share_of_noise(width_px) / share_of_noise(patch.smoothing_px)


def _slope(level: float) -> float:
    """Return -dI/d(log r) of a Gaussian of height 1 at a level: noise over it is the share of r a contour moves by."""
    level = max(level, LEAST_LEVEL)
    return -2 * level * math.log(level)


def _largest_width_ratio(inner: FittedConic, outer: FittedConic) -> float:
    """Return the largest ratio of the widths of two ellipses over all directions.

    The squared widths are w^T Q^-1 w, so it is the root of the largest generalised eigenvalue of the two inverses.
    """
    ratios = np.linalg.eigvals(np.linalg.solve(inner.centre_and_matrix[1], outer.centre_and_matrix[1]))
    return float(np.sqrt(ratios.real.max()))


@dataclass(frozen=True)
class PeakDetector:
    """Peaks of the smoothed mean of the channels.

    Parameters
    ----------
    isolated : bool
        Leave out peaks whose isophote at t = 0.5 does not close inside the frame and the view, and those whose shape is
        not that of one point highlight (`simtest.detection.peak_shape`).
    """

    isolated: bool = True

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the peaks of a frame (see `simtest.detection.Detector`)."""
        regions = detect(frame.smoothed, frame.noise, self.isolated, frame.seen)
        if self.isolated:
            flat = flat_pixels(frame.encoded, frame.seen)
            regions = [region for region in regions if _is_highlight(region, frame, flat)]
        return Detection(tuple(regions), frame, view=view_of(frame, search=False))


peaks = PeakDetector()


def _is_highlight(region: Region, frame: Frame, flat: Mask | None) -> bool:
    """Return whether nothing in a peak's shape speaks against one point highlight."""
    patch, noise, (column, row) = frame.patch(region.box, region.peak), frame.noise, region.peak
    at_peak = noise if isinstance(noise, float) else float(noise[row, column])
    left = share_of_noise(frame.smoothing_px) * at_peak
    shape = patch if isinstance(patch, Failure) else peak_shape(patch, region, left, flat)
    return isinstance(shape, Failure) or shape.is_highlight
