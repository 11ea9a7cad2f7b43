"""Which of a surface's highlight points are isolated, visible highlights (theory.md section 6)."""

import math
import warnings
from dataclasses import dataclass

import numpy as np

from simtest.calibration import NoiseModel
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_CONTRAST_SIGMA, HIGHLIGHT_MIN_GAIN, PIXEL_CENTRE
from simtest.detection import contrast, half_height_component
from simtest.detection.regions import Component
from simtest.geometry import smooth
from simtest.rendering import HighlightPoint
from simtest.runtime.arrays import Array, Image, Mask
from simtest.runtime.files import Json

Pixel = tuple[int, int]
"""Row and column."""

MAX_CLIMB_PX = 12
"""Smoothing moves a lopsided highlight's maximum away from its true BP, by no more than this."""


@dataclass(frozen=True, kw_only=True)
class TrueHighlight(HighlightPoint):
    """A highlight point with the verdict on whether it is a true isolated highlight.

    Parameters
    ----------
    peak_snr : float
        Peak above its surroundings over the standard deviation of the noise at the peak's level; inf without noise, 0
        where it has no closed isophote.
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

    @property
    def isolated(self) -> bool:
        """Whether it is a true isolated highlight."""
        return not self.why_not

    @property
    def highlight(self) -> "TrueHighlight":
        """Itself: deprecated, from when the verdict stood around the highlight."""
        warnings.warn("TrueHighlight.highlight is deprecated: use the highlight itself", DeprecationWarning, 2)
        return self

    def to_json(self) -> dict[str, Json]:
        """Return position, normal and curvature of the fine surface and of the base, and verdict."""
        return {
            "light": self.light,
            "bp_px": self.bp_px.tolist(),
            "position_mm": self.position.tolist(),
            "normal": self.normal.tolist(),
            "distance_mm": self.distance,
            "kd_min": self.kd_min,
            "kd_max": self.kd_max,
            "normal_base": self.normal_base.tolist(),
            "kd_min_base": self.kd_min_base,
            "kd_max_base": self.kd_max_base,
            "pool": self.pool,
            "radius_px": self.radius_px if math.isfinite(self.radius_px) else None,
            "cloud": self.cloud,
            "isolated": self.isolated,
            "why_not": self.why_not or None,
        }


def judge(
    points: list[HighlightPoint],
    light: Image,
    noise: NoiseModel,
    full_scale: float,
    channels: int = 1,
    seen: Mask | None = None,
    single: bool = False,
) -> list[TrueHighlight]:
    """Judge each highlight point by the noise-free frame.

    Parameters
    ----------
    points : list of HighlightPoint
        All points where the normal bisects light and camera.
    light : ndarray of float32, shape (H, W)
        Noise-free radiance behind the lens, mean of `channels` channels.
    noise : NoiseModel
        Of one channel.
    full_scale : float
        Radiance at full scale; 0 where there is no light at all.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.
    single : bool
        Whether an isolated highlight holds one lit highlight point alone: on a relief, where glints melt.
    """
    # The maximum that each point makes in the frame as detectors see it, and whose it is.
    smoothed = smooth(light, DEFAULT_SMOOTHING_PX, seen)
    peaks = [_peak_pixel(smoothed, point) for point in points]
    owners = _owners(points, peaks)
    # Verdicts.
    highlights = []
    for point, peak in zip(points, peaks, strict=True):
        sigma = float(noise.at(smoothed[peak] / full_scale, channels)) * full_scale if full_scale > 0 else 0.0
        others = [own.bp_px for own in points if own.lit and own is not point] if single else []
        snr, why_not = _verdict(point, smoothed, seen, peak, owners.get(peak) is point, sigma, others)
        highlights.append(TrueHighlight(**vars(point), peak_snr=snr, why_not=why_not))
    return highlights


def may_be_isolated(point: HighlightPoint) -> bool:
    """Return whether `judge` may call a highlight point isolated: by light and shape alone, whatever the frame."""
    return point.lit and not point.min_gain <= HIGHLIGHT_MIN_GAIN


def region_of(point: HighlightPoint, smoothed: Image, seen: Mask | None = None) -> Component | None:
    """Return the pixels above half height of the maximum that a highlight point makes.

    None where a higher maximum lies in it. `smoothed` is the noise-free smoothed light, shape (H, W); `seen` are the
    pixels inside the camera's view mask, default all.
    """
    return half_height_component(smoothed, *_peak_pixel(smoothed, point), seen)


def _owners(points: list[HighlightPoint], peaks: list[Pixel]) -> dict[Pixel, HighlightPoint]:
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


def _verdict(
    point: HighlightPoint,
    smoothed: Image,
    seen: Mask | None,
    peak: Pixel,
    owns_peak: bool,
    sigma: float,
    others: list[Array],
) -> tuple[float, str]:
    """Return peak SNR and the first condition that a highlight point fails.

    `sigma` is the noise at its peak; `others` are the points that may not lie in its half-height region, px.
    """
    # Without a maximum of its own it has no SNR.
    if not point.lit:
        return 0.0, "in shadow"
    component = half_height_component(smoothed, *peak, seen) if owns_peak else None
    if component is None:
        return 0.0, "part of a brighter one"
    height = contrast(smoothed, component, float(smoothed[peak]), seen)
    snr = height / sigma if sigma > 0 else np.inf if height > 0 else 0.0
    if any(component.holds(other) for other in others):
        return snr, "holds several glints"
    # Shape, frame, noise: in the order of theory.md section 6.
    if point.min_gain <= HIGHLIGHT_MIN_GAIN:
        return snr, f"min abs(1 + d k) at most {HIGHLIGHT_MIN_GAIN:g}"
    if not component.closed:
        return snr, "isophote at t = 0.5 leaves the frame"
    if snr < HIGHLIGHT_CONTRAST_SIGMA:
        return snr, f"peak below {HIGHLIGHT_CONTRAST_SIGMA:g} sigma"
    return snr, ""


def _peak_pixel(smoothed: Image, point: HighlightPoint) -> Pixel:
    """Climb from the true BP to the local maximum."""
    column, row = (int(v) for v in point.bp_px)
    row, column = min(row, smoothed.shape[0] - 1), min(column, smoothed.shape[1] - 1)
    for _ in range(MAX_CLIMB_PX):
        top, left = max(row - 1, 0), max(column - 1, 0)
        window = smoothed[top : row + 2, left : column + 2]
        step = divmod(int(window.argmax()), window.shape[1])
        if (step[0] + top, step[1] + left) == (row, column):
            break
        row, column = step[0] + top, step[1] + left
    return row, column
