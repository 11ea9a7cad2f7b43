"""Which of a surface's highlight points are isolated, visible highlights (theory.md section 6)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtest.conventions import (
    DEFAULT_SMOOTHING_PX,
    HIGHLIGHT_CONTRAST_SIGMA,
    HIGHLIGHT_ISOVALUE,
    HIGHLIGHT_MIN_GAIN,
    PIXEL_CENTRE,
)
from simtest.detection import contrast, half_height_component
from simtest.detection.peaks import Component, component_above
from simtest.geometry import smooth
from simtest.rendering import HighlightPoint
from simtest.runtime.arrays import Array, Image, IntArray, Mask, short_repr
from simtest.runtime.files import Json

Pixel = tuple[int, int]
"""Row and column."""


@dataclass(frozen=True, kw_only=True)
class TrueHighlight(HighlightPoint):
    """A highlight point with the verdict on whether it is a true isolated highlight.

    Parameters
    ----------
    peak_snr : float
        Peak above its surroundings, up to where the sensor clips, over the standard deviation of the noise there
        (`noise_at`); inf without noise, 0 where it has no closed isophote.
    why_not : str
        Empty for a true isolated highlight, else the first condition that it fails.
    radius_px : float
        Of the circle that has the highlight's area above half height, from its shape alone (theory.md 7.3), px; NaN
        where it was not computed.
    cloud : int or None
        Number of its cloud, an index in `RenderedView.clouds`; None where its cloud's centre is not in view.
    """

    peak_snr: float
    why_not: str
    radius_px: float = math.nan
    cloud: int | None = None

    __repr__ = short_repr

    @property
    def isolated(self) -> bool:
        """Whether it is a true isolated highlight."""
        return not self.why_not

    def to_json(self) -> dict[str, Json]:
        """Return position, normal and curvature of the fine surface and of the base, and verdict."""
        return {
            "light": self.light,
            "bp_px": self.bp_px.tolist(),
            "position_mm": self.position.tolist(),
            "normal": self.normal.tolist(),
            "direction_min": self.direction_min.tolist(),
            "distance_mm": self.distance,
            "kd_min": self.kd_min,
            "kd_max": self.kd_max,
            "normal_base": self.normal_base.tolist(),
            "kd_min_base": self.kd_min_base,
            "kd_max_base": self.kd_max_base,
            "pool": self.pool,
            "radius_px": self.radius_px if math.isfinite(self.radius_px) else None,
            "cloud": self.cloud,
            "lit": self.lit,
            "hidden": self.hidden,
            "peak_snr": self.peak_snr if math.isfinite(self.peak_snr) else None,
            "isolated": self.isolated,
            "why_not": self.why_not or None,
        }


@dataclass(frozen=True)
class Examined:
    """What a highlight point makes of the noise-free frame, whatever the noise.

    Parameters
    ----------
    peak : tuple of int
        Row and column of the maximum that it makes.
    level : float
        Smoothed light there.
    height : float or None
        The maximum above its surroundings; None where it has no closed region of its own.
    why_not : str
        Empty for what is isolated if it stands above the noise, else the first condition that it fails.
    """

    peak: Pixel
    level: float
    height: float | None
    why_not: str


def examine(
    points: Sequence[HighlightPoint], light: Image, seen: Mask | None = None, single: bool = False
) -> list[Examined]:
    """Examine each highlight point in the noise-free frame.

    Parameters
    ----------
    points : sequence of HighlightPoint
        All points where the normal bisects light and camera.
    light : ndarray of float32, shape (H, W)
        Noise-free radiance behind the lens, mean of the channels.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.
    single : bool
        Whether an isolated highlight holds one lit highlight point alone: on a relief, where glints melt.
    """
    # The maximum that each point makes in the frame as detectors see it, and whose it is.
    smoothed = smooth(light, DEFAULT_SMOOTHING_PX, seen)
    peaks = [_peak_pixel(smoothed, point) for point in points]
    owners = _owners(points, peaks)
    lit = [point for point in points if point.lit] if single else []
    pixels = np.array([point.bp_px for point in lit]).reshape(-1, 2).astype(int)
    examined = []
    for point, peak in zip(points, peaks, strict=True):
        others = pixels[[own is not point for own in lit]] if single and owners.get(peak) is point else pixels[:0]
        height, why_not = _examined(point, smoothed, seen, peak, owners.get(peak) is point, others)
        examined.append(Examined(peak, float(smoothed[peak]), height, why_not))
    return examined


def verdicts(
    points: Sequence[HighlightPoint], examined: Sequence[Examined], sigmas: Array, clip: float = math.inf
) -> list[TrueHighlight]:
    """Judge highlight points that were examined.

    Parameters
    ----------
    points, examined : sequence
        Of the same length.
    sigmas : ndarray, shape (N,)
        Noise at each one's peak, radiance; 0 without noise.
    clip : float
        Radiance at which the sensor's values end.
    """
    highlights = []
    for point, each, sigma in zip(points, examined, sigmas.tolist(), strict=True):
        # Without a maximum of its own it has no SNR.
        snr = 0.0
        if each.height is not None:
            height = min(each.level, clip) - min(each.level - each.height, clip)
            snr = height / sigma if sigma > 0 else np.inf if height > 0 else 0.0
        faint = f"peak below {HIGHLIGHT_CONTRAST_SIGMA:g} sigma" if snr < HIGHLIGHT_CONTRAST_SIGMA else ""
        highlights.append(TrueHighlight(**vars(point), peak_snr=snr, why_not=each.why_not or faint))
    return highlights


def may_be_isolated(point: HighlightPoint) -> bool:
    """Return whether a highlight point may be isolated: by light and shape alone, whatever the frame."""
    return point.lit and not point.min_gain <= HIGHLIGHT_MIN_GAIN


def lobe_region(point: HighlightPoint, specular: Image, at_point: float) -> tuple[float, Component | None]:
    """Return the peak that a highlight point makes in the lobe's light, and the connected pixels above half of it.

    The peak is the brightest pixel uphill from the point, or the light `at_point` (`Session.lobe_at`) where that is
    more: a highlight smaller than a pixel has none that reaches half of it, and no region. `specular` is the lobe's
    noise-free light before the lens, shape (H, W).
    """
    row, column = _peak_pixel(specular, point)
    brightest = float(specular[row, column])
    peak = max(at_point, brightest)
    level = HIGHLIGHT_ISOVALUE * peak
    return peak, component_above(specular, row, column, level) if brightest >= level > 0 else None


def _owners(points: Sequence[HighlightPoint], peaks: list[Pixel]) -> dict[Pixel, HighlightPoint]:
    """Assign each maximum of the smoothed frame to the nearest lit BP: smoothing may merge several highlights."""
    owners: dict[Pixel, HighlightPoint] = {}
    for point, peak in zip(points, peaks, strict=True):
        if not point.lit:
            continue
        centre = np.array([peak[1] + PIXEL_CENTRE, peak[0] + PIXEL_CENTRE])
        rival = owners.setdefault(peak, point)
        if np.hypot(*(point.bp_px - centre)) < np.hypot(*(rival.bp_px - centre)):
            owners[peak] = point
    return owners


def _examined(
    point: HighlightPoint, smoothed: Image, seen: Mask | None, peak: Pixel, owns_peak: bool, others: IntArray
) -> tuple[float | None, str]:
    """Return the height of a highlight point's maximum and the first condition but that of noise that it fails.

    `others` are columns and rows, shape (N, 2), of the points that may not lie in its half-height region.
    """
    if not point.lit:
        return None, "hidden by an instrument" if point.hidden else "in shadow"
    component = half_height_component(smoothed, *peak, seen) if owns_peak else None
    # Uphill may lead far: to another highlight, or to where the base is brightest.
    if component is None or not component.holds(point.bp_px[None]).all():
        return None, "part of a brighter one"
    height = contrast(smoothed, component, float(smoothed[peak]), seen)
    if component.holds(others).any():
        return height, "holds several glints"
    # Shape, frame, noise: in the order of theory.md section 6.
    if point.min_gain <= HIGHLIGHT_MIN_GAIN:
        return height, f"min abs(1 + d k) at most {HIGHLIGHT_MIN_GAIN:g}"
    if not component.closed:
        return height, "isophote at t = 0.5 leaves the frame"
    return height, ""


def _peak_pixel(smoothed: Image, point: HighlightPoint) -> Pixel:
    """Climb from the true BP to the local maximum."""
    column, row = (int(v) for v in point.bp_px)
    row, column = min(row, smoothed.shape[0] - 1), min(column, smoothed.shape[1] - 1)
    while True:
        top, left = max(row - 1, 0), max(column - 1, 0)
        window = smoothed[top : row + 2, left : column + 2]
        step = divmod(int(window.argmax()), window.shape[1])
        if (step[0] + top, step[1] + left) == (row, column):
            return row, column
        row, column = step[0] + top, step[1] + left
