"""Which of a surface's true highlights are isolated, visible ones (theory.md section 6)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.calibration import NoiseModel
from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_CONTRAST_SIGMA, HIGHLIGHT_MIN_GAIN, PIXEL_CENTRE
from simtest.detection import contrast, half_height_component
from simtest.detection.regions import Component
from simtest.geometry import smooth
from simtest.rendering import TrueHighlight

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

MAX_CLIMB_PX = 12
"""Smoothing moves a lopsided highlight's maximum away from its true BP, by no more than this."""


@dataclass(frozen=True)
class JudgedHighlight:
    """A true highlight with the verdict.

    Parameters
    ----------
    highlight : TrueHighlight
        Where it is.
    peak_snr : float
        Peak above its surroundings over the standard deviation of the noise at the peak's level; inf without noise, 0
        where it has no closed isophote.
    why_not : str
        Empty for a true isolated highlight, else the first condition that it fails.
    """

    highlight: TrueHighlight
    peak_snr: float
    why_not: str

    @property
    def isolated(self) -> bool:
        """Whether it is a true isolated highlight."""
        return not self.why_not


def judge(
    highlights: list[TrueHighlight],
    light: Image,
    noise: NoiseModel,
    full_scale: float,
    channels: int = 1,
    seen: Mask | None = None,
) -> list[JudgedHighlight]:
    """Judge each true highlight by the noise-free frame.

    Parameters
    ----------
    highlights : list of TrueHighlight
        All points where the normal bisects light and camera.
    light : ndarray of float32, shape (H, W)
        Noise-free radiance behind the lens, mean of the channels.
    noise : NoiseModel
        Of one channel.
    full_scale : float
        Radiance at full scale; 0 where there is no light at all.
    channels : int
        How many channels were averaged.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.

    Returns
    -------
    list of JudgedHighlight
        In the same order.
    """
    smoothed = smooth(light, DEFAULT_SMOOTHING_PX, seen)
    peaks = [_peak_pixel(smoothed, highlight) for highlight in highlights]
    owners = _owners(highlights, peaks)

    def sigma(peak: tuple[int, int]) -> float:
        if full_scale <= 0:
            return 0.0
        return float(noise.at(smoothed[peak] / full_scale, channels)) * full_scale

    return [
        _judge(h, (smoothed, seen), peak, owners.get(peak) is h, sigma(peak))
        for h, peak in zip(highlights, peaks, strict=True)
    ]


def region_of(highlight: TrueHighlight, smoothed: Image, seen: Mask | None = None) -> Component | None:
    """Give the pixels above half height of the maximum that a true highlight makes.

    Parameters
    ----------
    highlight : TrueHighlight
        The highlight.
    smoothed : ndarray of float32, shape (H, W)
        Noise-free smoothed light.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.

    Returns
    -------
    Component or None
        None where a higher maximum lies in it.
    """
    return half_height_component(smoothed, *_peak_pixel(smoothed, highlight), seen)


def _owners(highlights: list[TrueHighlight], peaks: list[tuple[int, int]]) -> dict[tuple[int, int], TrueHighlight]:
    """Give to each maximum of the smoothed frame the lit true BP nearest to it; smoothing may merge several."""
    owners: dict[tuple[int, int], TrueHighlight] = {}
    for highlight, peak in zip(highlights, peaks, strict=True):
        if not highlight.lit:
            continue
        place = np.array([peak[1] + PIXEL_CENTRE, peak[0] + PIXEL_CENTRE])
        rival = owners.setdefault(peak, highlight)
        if np.hypot(*(highlight.bp_px - place)) < np.hypot(*(rival.bp_px - place)):
            owners[peak] = highlight
    return owners


def _judge(
    highlight: TrueHighlight,
    frame: tuple[Image, Mask | None],
    peak: tuple[int, int],
    owns_peak: bool,
    noise: float,
) -> JudgedHighlight:
    """Judge one true highlight by the smoothed frame and what of it is seen."""
    smoothed, seen = frame
    if not highlight.lit:
        return JudgedHighlight(highlight, 0.0, "in shadow")
    if not owns_peak:
        return JudgedHighlight(highlight, 0.0, "part of a brighter one")
    row, column = peak
    component = half_height_component(smoothed, row, column, seen)
    if component is None:
        return JudgedHighlight(highlight, 0.0, "part of a brighter one")
    height = contrast(smoothed, component, float(smoothed[row, column]), seen)
    snr = height / noise if noise > 0 else np.inf if height > 0 else 0.0
    if highlight.min_gain <= HIGHLIGHT_MIN_GAIN:
        return JudgedHighlight(highlight, snr, f"min abs(1 + d k) at most {HIGHLIGHT_MIN_GAIN:g}")
    if not component.closed:
        return JudgedHighlight(highlight, snr, "isophote at t = 0.5 leaves the frame")
    if snr < HIGHLIGHT_CONTRAST_SIGMA:
        return JudgedHighlight(highlight, snr, f"peak below {HIGHLIGHT_CONTRAST_SIGMA:g} sigma")
    return JudgedHighlight(highlight, snr, "")


def _peak_pixel(smoothed: Image, highlight: TrueHighlight) -> tuple[int, int]:
    """Give row and column of the local maximum that a climb from the true BP reaches."""
    column, row = (int(v) for v in highlight.bp_px)
    row, column = min(row, smoothed.shape[0] - 1), min(column, smoothed.shape[1] - 1)
    for _ in range(MAX_CLIMB_PX):
        top, left = max(row - 1, 0), max(column - 1, 0)
        window = smoothed[top : row + 2, left : column + 2]
        step = divmod(int(window.argmax()), window.shape[1])
        if (step[0] + top, step[1] + left) == (row, column):
            break
        row, column = step[0] + top, step[1] + left
    return row, column
