"""Which of a surface's true highlights are isolated, visible ones (theory.md section 6)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_CONTRAST_SIGMA, HIGHLIGHT_MIN_GAIN
from simtest.detection import contrast, half_height_component
from simtest.geometry import smooth
from simtest.render import TrueHighlight

Image = npt.NDArray[np.float32]

PEAK_WINDOW_PX = 3
"""The radiance's local maximum is looked for this near to the true BP, which lies between pixels."""


@dataclass(frozen=True)
class JudgedHighlight:
    """A true highlight with the verdict.

    Parameters
    ----------
    highlight : TrueHighlight
        Where it is.
    peak_snr : float
        Peak above its surroundings over the noise; inf without noise, 0 where it has no closed isophote.
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
    highlights: list[TrueHighlight], radiance: Image, noise_sigma: float, full_scale: float
) -> list[JudgedHighlight]:
    """Judge each true highlight by the noise-free frame.

    Parameters
    ----------
    highlights : list of TrueHighlight
        All points where the normal bisects light and camera.
    radiance : ndarray of float32, shape (H, W)
        Noise-free radiance.
    noise_sigma : float
        Share of full scale.
    full_scale : float
        Radiance at full scale.

    Returns
    -------
    list of JudgedHighlight
        In the same order.
    """
    smoothed = smooth(radiance, DEFAULT_SMOOTHING_PX)
    return [_judge(highlight, smoothed, noise_sigma * full_scale) for highlight in highlights]


def _judge(highlight: TrueHighlight, smoothed: Image, noise: float) -> JudgedHighlight:
    if not highlight.lit:
        return JudgedHighlight(highlight, 0.0, "in shadow")
    row, column = _peak_pixel(smoothed, highlight)
    component = half_height_component(smoothed, row, column)
    if component is None:
        return JudgedHighlight(highlight, 0.0, "part of a brighter one")
    height = contrast(smoothed, component, float(smoothed[row, column]))
    snr = height / noise if noise > 0 else np.inf if height > 0 else 0.0
    if highlight.min_gain <= HIGHLIGHT_MIN_GAIN:
        return JudgedHighlight(highlight, snr, f"min abs(1 + d k) at most {HIGHLIGHT_MIN_GAIN:g}")
    if not component.closed:
        return JudgedHighlight(highlight, snr, "isophote at t = 0.5 leaves the frame")
    if snr < HIGHLIGHT_CONTRAST_SIGMA:
        return JudgedHighlight(highlight, snr, f"peak below {HIGHLIGHT_CONTRAST_SIGMA:g} sigma")
    return JudgedHighlight(highlight, snr, "")


def _peak_pixel(smoothed: Image, highlight: TrueHighlight) -> tuple[int, int]:
    """Give row and column of the brightest smoothed pixel next to the true BP."""
    x, y = (int(v) for v in highlight.bp_px)
    top, left = max(y - PEAK_WINDOW_PX, 0), max(x - PEAK_WINDOW_PX, 0)
    window = smoothed[top : y + PEAK_WINDOW_PX + 1, left : x + PEAK_WINDOW_PX + 1]
    row, column = np.unravel_index(int(window.argmax()), window.shape)
    return int(row) + top, int(column) + left
