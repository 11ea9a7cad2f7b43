"""`colour`: highlights of a colour frame by the tissue's own colour, and which of them are isolated."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.detection.blobs import Highlight, classify
from simtest.detection.detector import Detection
from simtest.detection.light_split import SplitLight, split_light
from simtest.detection.spots import find_spots
from simtest.detection.view_mask import View, find_view
from simtest.errors import InputError
from simtest.geometry import Camera, Image, Mask, smooth

SMOOTHING_PX = 0.35
"""Smoothing before highlights are told apart and their shape is measured; a wider one makes any small blob an ellipse."""

NOISE_LEFT = 0.8
"""What this smoothing leaves of white noise, 1 / (2 sqrt(pi) width)."""

NOISE_FACTOR = 4.0
"""Specular light above so many standard deviations is more than noise."""

PEAK_NOISE = 10.0
"""A highlight's peak stands at least so many standard deviations high."""

FAINT_RATIO = 0.25
"""At a highlight's peak the specular light is at least this share of the tissue's: a fifth of all light, as for a
visible highlight (theory.md 7.1b)."""

PLATEAU = 0.97
"""Channels above this share of the clipped value count as clipped: demosaicing and JPEG round them."""

FOOT = 0.4
"""Its pixels are searched for down to this share of that."""

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
    smoothed = smooth(light.specular, SMOOTHING_PX, seen)
    tissue = smooth(light.tissue, SMOOTHING_PX, seen)
    noise = NOISE_LEFT * light.noise
    # candidates: pixels that may belong to a highlight, and what its peak must have
    floor = max(LEAST_SPECULAR, NOISE_FACTOR * noise)
    candidates = smoothed >= np.maximum(floor, FOOT * FAINT_RATIO * tissue)
    if seen is not None:
        candidates &= seen
    least = np.maximum(max(LEAST_SPECULAR, PEAK_NOISE * noise), FAINT_RATIO * tissue)
    spots = find_spots(smoothed, tissue, candidates, least, noise, _all_clipped(linear, clipped))
    # pixels that show a highlight
    bright = (light.specular >= floor) & (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue)
    shown = np.zeros(bright.shape, dtype=bool)
    for spot in spots:
        shown[spot.crop] |= spot.mask
    mask = _above_own_peak(bright & candidates, light.specular) | shown
    highlights = classify(spots, smoothed, light, linear, mask, clipped, seen)
    return ColourDetection(light, mask, highlights)


def _all_clipped(linear: Image, clipped: Mask) -> Mask:
    """Return where all channels are clipped, by the least value that a clipped one has."""
    if not clipped.any():
        return clipped
    most = linear.max(axis=2)
    return np.asarray(linear.min(axis=2) >= PLATEAU * most[clipped].min())


def _above_own_peak(above: Mask, specular: Image) -> Mask:
    """Remove pixels far below their highlight's own peak."""
    count, labels = cv2.connectedComponents(above.astype(np.uint8), connectivity=8)
    if count < 2:
        return above
    # peak of each connected part
    rows, columns = np.nonzero(above)
    number = labels[rows, columns]
    peaks = np.zeros(count, dtype=np.float32)
    np.maximum.at(peaks, number, specular[rows, columns])
    # reject low pixels
    kept = specular[rows, columns] >= SPECULAR_PEAK_SHARE * peaks[number]
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
