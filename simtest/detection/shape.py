"""Whether a peak has the shape of a point highlight.

Where the normal bisects the directions to light and camera, the isophotes are ellipses of one shape and centre for
every isotropic reflectance, and the glossy lobe falls off at least as soon as a Gaussian (theory.md section 3, items 1
and 3). A peak of another kind is where the normal only comes closest to the bisector w: there J^T w = 0, so that the
misfit's Jacobian J is singular, the quadratic term along that direction is small or gone, and the peak is flat-topped
with bent or pointed isophotes. Ridges, corners of folds and several highlights run together look like that.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import (
    DEFAULT_SMOOTHING_PX,
    HIGHLIGHT_ELLIPSE_RESIDUAL,
    HIGHLIGHT_ISOVALUE,
    HIGHLIGHT_WIDTH_EXCESS,
)
from simtest.detection.regions import Region
from simtest.errors import Failure
from simtest.geometry import FittedConic, Patch, fit_ellipse, smooth

Mask = npt.NDArray[np.bool_]

RESIDUAL_ISOVALUE = 0.7
"""Where the isophote is compared with an ellipse: lower ones reach farther out, where curvature changes, and higher
ones are noisier."""

TOP_ISOVALUE = 0.8
"""The isophote whose width is compared with that at half height."""

SCALE = 0.2
"""A peak is smoothed by this share of its radius at half height before its shape is judged."""

NOISE_FACTOR = 2.0
"""How many standard deviations of a contour's noise the residual may have on top, in squares."""

MIN_FLAT_PX = 12
"""As many pixels of the frame's very largest value are clipped ones."""

LEAST_LEVEL = 0.05
"""Least share of a peak's height above its surroundings at which a width means anything."""


@dataclass(frozen=True)
class PeakShape:
    """How a peak differs from a point highlight.

    Parameters
    ----------
    residual : float
        RMS distance of the isophote at t = 0.7 from its ellipse, as a share of the ellipse's radius.
    residual_noise : float
        What the frame's noise adds to it.
    width_excess : float
        How much wider the isophote at t = 0.8 is than a Gaussian's over the same surroundings would be, in the
        direction in which it is widest, relative to that at t = 0.5; 0 for a Gaussian, negative for a sharper peak,
        NaN where the peak is clipped or a width cannot be told.
    width_noise : float
        What the noise adds to it.
    """

    residual: float
    residual_noise: float
    width_excess: float
    width_noise: float

    @property
    def is_highlight(self) -> bool:
        """Whether the shape speaks against a point highlight by no more than the thresholds and the noise."""
        # The residual adds to the noise in squares. The excess adds to it as it is: a wide Phong lobe (n = 10 to 50)
        # has 0.01 to 0.025 of its own.
        bent = self.residual > math.hypot(HIGHLIGHT_ELLIPSE_RESIDUAL, NOISE_FACTOR * self.residual_noise)
        flat = self.width_excess > HIGHLIGHT_WIDTH_EXCESS + self.width_noise
        return not (bent or flat)


def flat_pixels(frame: npt.NDArray[np.floating]) -> Mask | None:
    """Tell which pixels of a frame, shape (H, W) or (H, W, C), are clipped, whatever the calibration knows of it.

    Returns
    -------
    ndarray of bool, shape (H, W), or None
        Where a channel has the frame's largest value; None where these are too few to be more than an accident.
    """
    largest = frame >= frame.max()
    mask = np.asarray(largest if largest.ndim == 2 else largest.any(axis=2))
    return mask if np.count_nonzero(mask) >= MIN_FLAT_PX else None


def peak_shape(patch: Patch, region: Region, noise: float, clipped: Mask | None = None) -> PeakShape | Failure:
    """Measure a peak's shape.

    Parameters
    ----------
    patch : Patch
        The region's smoothed crop.
    region : Region
        For the peak's contrast.
    noise : float
        Standard deviation of the smoothed frame's noise at the peak, in the patch's units.
    clipped : ndarray of bool, shape (H, W), optional
        Where the frame is clipped (see `flat_pixels`), beside what the patch knows of it.

    Returns
    -------
    PeakShape or Failure
        A Failure where an isophote does not close or no ellipse fits.
    """
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
    height = region.contrast - (patch.peak_value - clean.peak_value)
    half, level, top = (
        1 - (1 - t) * clean.peak_value / height for t in (HIGHLIGHT_ISOVALUE, RESIDUAL_ISOVALUE, TOP_ISOVALUE)
    )
    excess = math.nan
    if half >= LEAST_LEVEL and not _clipped(patch, region, clipped):
        gaussian = math.sqrt(math.log(top) / math.log(half))
        excess = _largest_width_ratio(at_top, at_half) / gaussian - 1
    relative = left * noise / height
    return PeakShape(_residual(at_residual, points), relative / _slope(level), excess, relative / _slope(top))


def _at_own_scale(patch: Patch) -> tuple[Patch, float]:
    """Smooth a peak by a share of its width, which leaves a Gaussian one; gives also the share of the noise left."""
    width = math.sqrt(float(np.count_nonzero(patch.inside(HIGHLIGHT_ISOVALUE))) / math.pi)
    more = SCALE * width
    if more <= DEFAULT_SMOOTHING_PX / 2:
        return patch, 1.0
    values = smooth(patch.values, more)
    rows, columns = np.nonzero(patch.inside(TOP_ISOVALUE))
    highest = int(np.argmax(values[rows, columns]))
    height, wide = values.shape
    found = Patch.cut(values, (0, 0, wide, height), (int(columns[highest]), int(rows[highest])), patch.origin_px)
    if isinstance(found, Failure):
        return patch, 1.0
    return found, DEFAULT_SMOOTHING_PX / math.hypot(DEFAULT_SMOOTHING_PX, more)


def _slope(level: float) -> float:
    """Give -dI/d(log r) of a Gaussian of height 1 at a level: noise over it moves a contour by that share of r."""
    level = max(level, LEAST_LEVEL)
    return -2 * level * math.log(level)


def _clipped(patch: Patch, region: Region, clipped: Mask | None) -> bool:
    x, y, width, height = region.box
    masks = (patch.saturated, None if clipped is None else clipped[y : y + height, x : x + width])
    return any(mask is not None and bool((mask & patch.inside(TOP_ISOVALUE)).any()) for mask in masks)


def _quadratic(fitted: FittedConic) -> tuple[np.ndarray, np.ndarray]:
    """Give centre, px, and Q of an ellipse (x - centre)^T Q (x - centre) = 1."""
    C = fitted.normalised
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    T = fitted.normalised_from_image
    return np.linalg.solve(T[:2, :2], centre - T[:2, 2]), T[:2, :2].T @ C[:2, :2] @ T[:2, :2] / level


def _residual(fitted: FittedConic, points: np.ndarray) -> float:
    centre, Q = _quadratic(fitted)
    gap = points - centre
    radius = np.sqrt(np.einsum("ni,ij,nj->n", gap, Q, gap))
    return float(np.sqrt(np.mean((radius - 1) ** 2)))


def _largest_width_ratio(inner: FittedConic, outer: FittedConic) -> float:
    """Give the largest ratio of the widths of two ellipses over all directions.

    The widths' squares are w^T Q^-1 w, so it is the largest generalised eigenvalue of the two inverses.
    """
    ratios = np.linalg.eigvals(np.linalg.solve(_quadratic(inner)[1], _quadratic(outer)[1]))
    return float(np.sqrt(ratios.real.max()))
