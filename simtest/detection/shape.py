"""Test whether a peak has the shape of a point highlight.

Where the normal bisects the directions to light and camera, the isophotes are ellipses of one shape and centre for
every isotropic reflectance, and a glossy lobe falls off at least as fast as a Gaussian (theory.md section 3, items 1
and 3). Another kind of peak is where the normal only comes closest to the bisector, at misfit w: there J^T w = 0, so
the misfit's Jacobian J is singular, the quadratic term along that direction is small or zero, and the peak is
flat-topped with bent or pointed isophotes. Ridges, corners of folds and merged highlights look like that.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import HIGHLIGHT_ELLIPSE_RESIDUAL, HIGHLIGHT_ISOVALUE, HIGHLIGHT_WIDTH_EXCESS
from simtest.detection.regions import Region
from simtest.errors import Failure
from simtest.geometry import FittedConic, Mask, Patch, fit_ellipse, smooth
from simtest.geometry.patch import share_of_noise

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
class PeakShape:
    """How a peak differs from a point highlight.

    Parameters
    ----------
    residual : float
        RMS distance of the isophote at t = 0.7 from its ellipse, as a share of the ellipse's radius.
    residual_noise : float
        Contribution of the frame's noise to it.
    width_excess : float
        Width of the isophote at t = 0.8 over that at t = 0.5, in the direction where this is largest, over the same
        ratio of a Gaussian on the same surroundings, less 1: 0 for a Gaussian, negative for a sharper peak, NaN where
        the peak is clipped or a width cannot be measured.
    width_noise : float
        Contribution of the noise to it.
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
    if half >= LEAST_LEVEL and not _clipped(patch, region, clipped):
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
    found = Patch.cut(
        values, (0, 0, wide, height), (int(columns[highest]), int(rows[highest])), patch.origin_px,
        seen=patch.seen, smoothing_px=width_px,
    )  # fmt: skip
    if isinstance(found, Failure):
        return patch, 1.0
    return found, share_of_noise(width_px) / share_of_noise(patch.smoothing_px)


def _slope(level: float) -> float:
    """Return -dI/d(log r) of a Gaussian of height 1 at a level: noise over it is the share of r a contour moves by."""
    level = max(level, LEAST_LEVEL)
    return -2 * level * math.log(level)


def _clipped(patch: Patch, region: Region, clipped: Mask | None) -> bool:
    """Return whether a pixel inside the highest isophote is clipped."""
    x, y, width, height = region.box
    masks = (patch.saturated, None if clipped is None else clipped[y : y + height, x : x + width])
    return any(mask is not None and bool((mask & patch.inside(TOP_ISOVALUE)).any()) for mask in masks)


def _largest_width_ratio(inner: FittedConic, outer: FittedConic) -> float:
    """Return the largest ratio of the widths of two ellipses over all directions.

    The squared widths are w^T Q^-1 w, so it is the root of the largest generalised eigenvalue of the two inverses.
    """
    ratios = np.linalg.eigvals(np.linalg.solve(inner.centre_and_matrix[1], outer.centre_and_matrix[1]))
    return float(np.sqrt(ratios.real.max()))
