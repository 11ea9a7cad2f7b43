"""`colour`: highlights of a colour frame by the tissue's own colour, and which of them are isolated."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.detection.blobs import MIN_AREA_PX, Highlight, highlights_of
from simtest.detection.detector import Detection
from simtest.detection.light_split import SplitLight, split_light
from simtest.detection.view_mask import View, find_view
from simtest.errors import InputError
from simtest.geometry import Camera, Image, Mask

NOISE_FACTOR = 4.0
"""Specular light above so many standard deviations is more than noise."""

FAINT_RATIO = 0.6
"""Highlights are searched for where the specular light is this share of the tissue's; their pixels are those above
`SPECULAR_DIFFUSE_RATIO`."""

LEAST_SPECULAR = 0.01
"""Least specular light, share of full scale: two steps of an 8-bit sRGB picture at mid tones."""


@dataclass(frozen=True)
class ColourDetection:
    """The light of a colour frame in its two parts, the pixels of highlights of every kind, shape (H, W), and these.

    The highlights come brightest first.
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

    In a highlight's pixels the specular light is at least the tissue's, at least 10 % of the highlight's peak, and more
    than noise. Both parts follow from the tissue's own colour around each pixel (`split_light`), so there is no global
    threshold.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear values, share of full scale; white-balanced: light mirrored by the surface is grey.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.
    """
    light = split_light(linear, clipped, seen)
    least = max(LEAST_SPECULAR, NOISE_FACTOR * light.noise)
    seen_light = light.specular >= least
    mask = _above_own_peak(seen_light & (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue), light.specular)
    # A small highlight, blurred by lens and sensor, may nowhere be as bright as the tissue under it.
    wider = _above_own_peak(seen_light & (light.specular >= FAINT_RATIO * light.tissue), light.specular)
    return ColourDetection(light, mask, highlights_of(wider, light, linear, clipped, seen))


def _above_own_peak(above: Mask, specular: Image) -> Mask:
    """Remove specks, and pixels far below their highlight's own peak."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(above.astype(np.uint8), connectivity=8)
    if count < 2:
        return above
    # peak of each connected part
    rows, columns = np.nonzero(above)
    number = labels[rows, columns]
    peaks = np.zeros(count, dtype=np.float32)
    np.maximum.at(peaks, number, specular[rows, columns])
    # reject small parts and low pixels
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_AREA_PX
    kept = large[number] & (specular[rows, columns] >= SPECULAR_PEAK_SHARE * peaks[number])
    mask = np.zeros(above.shape, dtype=bool)
    mask[rows[kept], columns[kept]] = True
    return mask


@dataclass(frozen=True)
class ColourDetector:
    """Highlights by the tissue's own colour (`detect_colour`).

    Where the camera has no view mask the view is found in the picture. Estimators see the specular light alone.

    Parameters
    ----------
    isolated : bool
        Leave out highlights of the other kinds.
    """

    isolated: bool = True

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the highlights of a frame; raise `InputError` where it has not three channels."""
        if frame.encoded.ndim != 3 or frame.encoded.shape[2] != 3:
            raise InputError(f"frame has shape {frame.encoded.shape}: detection by colour takes (H, W, 3)")
        view = find_view(frame.encoded) if frame.seen is None else View(frame.seen)
        found = detect_colour(frame.channels, frame.clipped, view.seen)
        taken = tuple(found.isolated if self.isolated else found.highlights)
        others = tuple(highlight for highlight in found.highlights if self.isolated and not highlight.is_isolated)
        specular = replace(frame, seen=view.seen, light=found.light.specular)
        return Detection(tuple(highlight.region for highlight in taken), specular, taken, others, view)


colour = ColourDetector()
