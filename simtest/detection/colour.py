"""`colour`: highlights of a colour frame by the tissue's own colour, and which of them are isolated."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.calibration.frame import MAD_TO_SIGMA, median
from simtest.detection.detector import Detection
from simtest.detection.judging import ColourDetection, detection_of, judge_spots, plateaus, tissue_spots
from simtest.detection.light_split import SplitLight, fill, split_light
from simtest.detection.spots import Spot, find_spots
from simtest.detection.view_mask import view_of
from simtest.errors import InputError
from simtest.geometry import Camera, Image, Mask, smooth

SMOOTHING_PX = 0.35
"""Smoothing before highlights are told apart; a wider one melts small ones."""

NOISE_LEFT = 0.8
"""What this smoothing leaves of white noise, 1 / (2 sqrt(pi) width)."""

NOISE_FACTOR = 4.0
"""Specular light above so many standard deviations is more than noise."""

PEAK_NOISE = 10.0
"""A highlight's peak stands at least so many standard deviations high."""

FAINT_RATIO = 0.25
"""At a highlight's peak the specular light is at least this share of the tissue's: a fifth of all light, as for a
visible highlight (theory.md 7.1b)."""

TEXTURE_FACTOR = 6.0
"""... and so many times the spread of that share over the frame: tissue whose colour varies looks like faint
highlights."""

TEXTURE_LIGHT = 0.02
"""Pixels darker than this share of full scale do not count for the spread."""

MIN_TEXTURE_PX = 100

RISE = 0.7
"""At the peak the light is brighter than the tissue around by this share of the least ratio: pale tissue is not."""

STANDS_OUT = 0.8
"""No tissue beside a highlight is brighter than this share of its peak, as of a saddle (theory.md 7.1b). Where chroma
is coarser than luma, as in JPEG, tissue at an edge is paler than farther in, but no brighter."""

BESIDE_PX, NARROW_PX = 6, 64
"""Tissue is beside a highlight within this distance of the box of its pixels. With more pixels than the second number a
spot is no edge, and so wide that shading matters."""

_WIDE = np.ones((5, 5), dtype=np.uint8)

FOOT = 0.4
"""A highlight's pixels are searched for down to this share of what its peak must have."""

LEAST_SPECULAR = 0.02
"""Least specular light, share of full scale: two steps of an 8-bit sRGB picture at mid tones."""


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
    flat, white = plateaus(linear, clipped)
    spots, candidates, bare = colour_spots(light, clipped, flat, seen)
    spots, bright, foreign = tissue_spots(spots, candidates.shape)
    # Only now: text is known by whole lines.
    total = smooth(light.specular, SMOOTHING_PX, seen) + smooth(light.tissue, SMOOTHING_PX, seen)
    spots = [spot for spot in spots if _stands_out(spot, total, bare)]
    return judge_spots(spots, light, linear, bright, (flat, white), candidates & ~foreign, seen)


def colour_spots(
    light: SplitLight, clipped: Mask, flat: Mask, seen: Mask | None = None
) -> tuple[list[Spot], Mask, Mask]:
    """Find what shines in a frame, on tissue or not.

    Parameters
    ----------
    light : SplitLight
        The frame's two parts.
    clipped, flat : ndarray of bool, shape (H, W)
        Where a channel is clipped, and where all are.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.

    Returns
    -------
    list of Spot
        The brightest first.
    candidates, bare : ndarray of bool, shape (H, W)
        Pixels that may belong to a highlight, and those away from all these.
    """
    smoothed = smooth(light.specular, SMOOTHING_PX, seen)
    tissue = smooth(light.tissue, SMOOTHING_PX, seen)
    noise = NOISE_LEFT * light.noise
    # candidates: pixels that may belong to a highlight, and what its peak must have
    ratio = max(FAINT_RATIO, TEXTURE_FACTOR * _texture(smoothed, tissue, clipped, seen))
    candidates = smoothed >= np.maximum(max(FOOT * LEAST_SPECULAR, NOISE_FACTOR * noise), FOOT * ratio * tissue)
    if seen is not None:
        candidates &= seen
    least = np.maximum(max(LEAST_SPECULAR, PEAK_NOISE * noise), ratio * tissue)
    spots = find_spots(smoothed, tissue, candidates, least, noise, flat)
    bare = cv2.dilate(candidates.astype(np.uint8), _WIDE) == 0
    if seen is not None:
        bare &= seen
    return _brighter_than_around(spots, smoothed + tissue, bare, ratio), candidates, bare


def _texture(specular: Image, tissue: Image, clipped: Mask, seen: Mask | None) -> float:
    """Return the robust spread of specular light over the tissue's, where the tissue's colour varies by itself."""
    # By all light: the tissue's part is filled in from around where a pixel has no colour, as a dark background has.
    sound = ~clipped & (specular + tissue > TEXTURE_LIGHT) & (tissue > 0)
    if seen is not None:
        sound &= seen
    values = specular[::2, ::2][sound[::2, ::2]] / tissue[::2, ::2][sound[::2, ::2]]
    if len(values) < MIN_TEXTURE_PX:
        return 0.0
    middle = float(median(values))
    return MAD_TO_SIGMA * float(median(np.abs(values - middle)))


def _brighter_than_around(spots: list[Spot], total: Image, bare: Mask, ratio: float) -> list[Spot]:
    """Leave out spots that are paler than the bare tissue around, but no brighter."""
    if not spots:
        return spots
    around = fill(total, bare)
    rows, columns = (np.array([spot.peaks[0][i] for spot in spots]) for i in (1, 0))
    rise = total[rows, columns] - around[rows, columns]
    return [
        spot
        for spot, more, below in zip(spots, rise, around[rows, columns], strict=True)
        if more >= RISE * ratio * below
    ]


def _stands_out(spot: Spot, total: Image, bare: Mask) -> bool:
    """Return whether no bare tissue beside a spot comes near to its light; a wide one needs not be asked."""
    if spot.area_px > NARROW_PX:
        return True
    (x, y), (height, width) = spot.corner, spot.mask.shape
    left, top = max(x - BESIDE_PX, 0), max(y - BESIDE_PX, 0)
    beside = np.s_[top : y + height + BESIDE_PX, left : x + width + BESIDE_PX]
    column, row = spot.peaks[0]
    return bool(total[beside].max(where=bare[beside], initial=0) <= STANDS_OUT * total[row, column])


@dataclass(frozen=True)
class ColourDetector:
    """Highlights by the tissue's own colour (`detect_colour`).

    Where the camera has no view mask the view is found in the picture. Estimators see the specular light alone.

    Parameters
    ----------
    isolated : bool
        Leave out highlights of the other kinds, but for clusters: these are told, and no estimator answers for them.
    """

    isolated: bool = True

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the highlights of a frame; raise `InputError` where it has not three channels."""
        if frame.encoded.ndim != 3 or frame.encoded.shape[2] != 3:
            raise InputError(f"frame has shape {frame.encoded.shape}: detection by colour takes (H, W, 3)")
        view = view_of(frame)
        found = detect_colour(frame.channels, frame.clipped, view.seen)
        return detection_of(found, frame, view, self.isolated)


colour = ColourDetector()
