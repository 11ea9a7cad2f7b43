"""Specularities of a colour frame: which pixels, which highlights, and which of these are isolated."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.detection.blobs import MIN_AREA_PX, Highlight, highlights_of
from simtest.detection.light_split import SplitLight, split_light

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

NOISE_FACTOR = 4.0
"""Specular light of a pixel is more than noise above so many standard deviations."""

FAINT_RATIO = 0.6
"""Least specular light over the tissue's where a highlight is looked for; its pixels are those above
`SPECULAR_DIFFUSE_RATIO`."""

LEAST_SPECULAR = 0.01
"""Share of full scale that specular light must have: two steps of an 8-bit sRGB picture at mid tones."""


@dataclass(frozen=True)
class ColourDetection:
    """What a colour frame shows.

    Parameters
    ----------
    light : SplitLight
        The frame's light in its two parts.
    mask : ndarray of bool, shape (H, W)
        Pixels of highlights of every kind.
    highlights : list of Highlight
        The brightest first.
    """

    light: SplitLight
    mask: Mask
    highlights: list[Highlight]

    @property
    def isolated(self) -> list[Highlight]:
        """The highlights that may carry one normal."""
        return [highlight for highlight in self.highlights if highlight.is_isolated]


def detect_colour(linear: Image, clipped: Mask, seen: Mask | None = None) -> ColourDetection:
    """Find the highlights of a colour frame.

    Pixels: the specular light is at least the tissue's, at least 10 % of the highlight's peak, and more than noise.
    Both parts come from the tissue's own colour around each pixel (`split_light`), so no threshold is one for all.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear values, share of full scale; white-balanced: light off the surface is grey.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.

    Returns
    -------
    ColourDetection
    """
    light = split_light(linear, clipped, seen)
    least = max(LEAST_SPECULAR, NOISE_FACTOR * light.noise)
    seen_light = light.specular >= least
    mask = _above_own_peak(seen_light & (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue), light.specular)
    # A small highlight, blurred by lens and sensor, may nowhere be as bright as the tissue under it.
    wider = _above_own_peak(seen_light & (light.specular >= FAINT_RATIO * light.tissue), light.specular)
    return ColourDetection(light, mask, highlights_of(wider, light, linear, clipped, seen))


def _above_own_peak(above: Mask, specular: Image) -> Mask:
    """Leave out specks, and pixels far below their highlight's own peak."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(above.astype(np.uint8), connectivity=8)
    if count < 2:
        return above
    rows, columns = np.nonzero(above)
    number = labels[rows, columns]
    peaks = np.zeros(count, dtype=np.float32)
    np.maximum.at(peaks, number, specular[rows, columns])
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_AREA_PX
    kept = large[number] & (specular[rows, columns] >= SPECULAR_PEAK_SHARE * peaks[number])
    mask = np.zeros(above.shape, dtype=bool)
    mask[rows[kept], columns[kept]] = True
    return mask
