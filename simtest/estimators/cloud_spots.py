"""The bright spots of a frame: maxima that a saddle parts from any brighter one, each with its centroid.

On a relief these are what can be seen of the glints (theory.md 7.1b). Estimator `cloud` groups them.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.geometry import Array, Image, Mask, smooth
from simtest.geometry.patch import share_of_noise

SMOOTHING_PX = 0.7
"""Gaussian smoothing before maxima are looked for: that of a lens, so that one spot of noise is no maximum."""

SADDLE = 0.8
"""Two maxima are two spots if the saddle between them is below this share of the lower one."""

STEP, LEVELS = 0.9, 40
"""Each threshold over the last, and how many: the faintest spot has 1.5 % of the brightest one's light."""

NOISE_FACTOR = 10.0
"""A spot's peak stands so many standard deviations of the noise above its surroundings."""

FAINTEST = 0.25
"""A spot's peak over that of the bright spots. Where the misfit has a minimum above 0 there is a fainter spot, which is
no glint and lies far out more often."""

LEAST_CONTRAST = 0.5
"""A spot's peak over the light around it: texture and shading of the tissue stay below."""

PART_CONTRAST = 0.3
"""Light this much over that around is no diffuse light."""

BRIGHT_QUANTILE = 0.8
"""The bright spots are those around this quantile of all peaks above the noise."""

LEAST_PX = 3
"""Pixels above half of a spot's own peak."""

BACKGROUND_SCALE = 8
"""The background is the median of a picture that is so many times smaller, over 5 x 5 of its pixels."""


@dataclass(frozen=True)
class Spots:
    """The bright spots of a frame, the brightest first.

    Parameters
    ----------
    points_px : ndarray, shape (N, 2)
        Centroid of each spot's pixels, px.
    areas_px : ndarray, shape (N,)
        Number of pixels above half of its peak, or above the saddle where that is higher.
    peaks : ndarray, shape (N,)
        Light at the peak above the background, frame units.
    """

    points_px: Array
    areas_px: Array
    peaks: Array


def find_spots(frame: Frame) -> Spots:
    """Find the bright spots of a frame.

    The light is the frame's specular light where a detector split it off; else, of a coloured frame, that of the
    weakest channel: what a wet surface mirrors is white, and tissue is not.
    """
    light, noise = _light(frame)
    around, brightest_near = _background_of(frame, light)
    above = light - around
    if frame.light is not None:
        # Where a detector split the light there is none around: a spot is bright beside what it took off.
        brightest_near = np.maximum(brightest_near, _background(_tissue(frame))[1])
    if frame.seen is not None:
        above = np.where(frame.seen, above, np.float32(0))
    least = NOISE_FACTOR * noise
    brightest = float(above.max(initial=0.0))
    if not brightest > max(least, 0.0):
        return Spots(np.empty((0, 2)), np.empty(0), np.empty(0))
    # What tissue, not its wet surface, sends back is no spot, however bright.
    above = np.where(above >= HIGHLIGHT_ISOVALUE * LEAST_CONTRAST * brightest_near, above, np.float32(0))
    spots = _maxima(above, brightest_near, brightest, max(least, brightest * STEP**LEVELS))
    if not len(spots.peaks):
        return spots
    kept = spots.peaks >= FAINTEST * np.quantile(spots.peaks, BRIGHT_QUANTILE)
    return Spots(spots.points_px[kept], spots.areas_px[kept], spots.peaks[kept])


def bright_parts(frame: Frame) -> Mask:
    """Return where the light stands above that of the tissue around, shape (H, W): spots, faint ones too."""
    return _above(frame)[1]


def _above(frame: Frame) -> tuple[Image, Mask]:
    """Return the light less that of the tissue around, and where this is no diffuse light, shape (H, W)."""
    light, noise = _light(frame)
    around, _ = _background_of(frame, light)
    above = light - around
    tissue = around if frame.light is None else np.maximum(around, _background(_tissue(frame))[0])
    return above, np.asarray(above > np.maximum(PART_CONTRAST * tissue, NOISE_FACTOR * noise))


def _light(frame: Frame) -> tuple[Image, float]:
    """Return the light in which spots are looked for, smoothed, shape (H, W), and the noise that is left in it."""
    noise = float(np.median(frame.noise)) * share_of_noise(SMOOTHING_PX)
    if frame.light is None and frame.encoded.ndim == 3:
        # The noise of the mean is known; the minimum has about that of one channel.
        return _tissue(frame), noise * float(np.sqrt(frame.encoded.shape[2]))
    return smooth(frame.corrected.intensity, SMOOTHING_PX, frame.seen), noise


def _tissue(frame: Frame) -> Image:
    """Return the light of a frame's weakest channel, smoothed, shape (H, W), frame units.

    Between the spots it is the diffuse light, whatever a detector split off.
    """
    gain, values = frame.corrected.gain, frame.channels
    values = values if values.ndim == 2 else values.min(axis=2)
    return smooth(values if gain is None else values * gain, SMOOTHING_PX, frame.seen)


def _background_of(frame: Frame, light: Image) -> tuple[Image, Image]:
    """Return the `_background` of a frame's light.

    A detector's split may leave less than no light in the dark beside an organ. A gap in that is no light either.
    """
    around, near = _background(light)
    return (around, near) if frame.light is None else (np.maximum(around, np.float32(0)), near)


def _background(light: Image) -> tuple[Image, Image]:
    """Return what a picture, shape (H, W), has around its spots: its local median, and the largest of those near.

    At the limb of an organ the median may be that of the dark beside it.
    """
    height, width = light.shape
    size = (max(width // BACKGROUND_SCALE, 5), max(height // BACKGROUND_SCALE, 5))
    small = cv2.resize(light, size, interpolation=cv2.INTER_NEAREST)
    small = cv2.medianBlur(np.ascontiguousarray(small, dtype=np.float32), 5)
    near = cv2.dilate(small, np.ones((5, 5), np.uint8))
    around, highest = (cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in (small, near))
    return np.asarray(around, dtype=np.float32), np.asarray(highest, dtype=np.float32)


def _maxima(above: Image, around: Image, brightest: float, least: float) -> Spots:
    """Find the maxima of a picture by thresholds from bright to faint: a part without a spot yet is a new one."""
    found: list[_Spot] = []
    level = brightest * STEP
    while level >= least:
        parts = cv2.connectedComponentsWithStats((above >= level).astype(np.uint8), connectivity=8)
        _, labels, stats, centroids = parts
        held: dict[int, list[_Spot]] = {}
        for spot in found:
            held.setdefault(int(labels[spot.pixel[1], spot.pixel[0]]), []).append(spot)
        for label in range(1, len(stats)):
            own = held.get(label)
            if own is None:
                own = [_new_spot(above, labels, label, stats[label])]
                found += own
            # Fainter maxima that no saddle parts from the brightest one are none.
            for spot in own[1:]:
                spot.absorbed = SADDLE * spot.peak < level
            apart = [spot for spot in own if not spot.absorbed]
            for spot in apart:
                spot.merged |= len(apart) > 1
            # Alone in its part, and not below half of its peak: these are its pixels, so far.
            if not (spot := apart[0]).merged and (spot.point is None or level >= HIGHLIGHT_ISOVALUE * spot.peak):
                spot.point, spot.area = centroids[label] + PIXEL_CENTRE, int(stats[label, cv2.CC_STAT_AREA])
        found = [spot for spot in found if not spot.absorbed]
        level *= STEP
    kept = [
        spot
        for spot in found
        if spot.area >= LEAST_PX and spot.peak >= LEAST_CONTRAST * around[spot.pixel[1], spot.pixel[0]]
    ]
    kept.sort(key=lambda spot: -spot.peak)
    points = np.array([spot.point for spot in kept]).reshape(-1, 2)
    return Spots(points, np.array([float(spot.area) for spot in kept]), np.array([spot.peak for spot in kept]))


def _new_spot(above: Image, labels: Array, label: int, stats: Array) -> "_Spot":
    """Return the spot of a part of a picture that holds none yet; `stats` are the part's."""
    x, y, width, height = (int(v) for v in stats[:4])
    inside = labels[y : y + height, x : x + width] == label
    values = np.where(inside, above[y : y + height, x : x + width], -np.inf)
    row, column = np.unravel_index(int(values.argmax()), values.shape)
    return _Spot(float(values[row, column]), (x + int(column), y + int(row)))


@dataclass
class _Spot:
    """A spot that is being found: its peak and its pixel, its pixels' centroid and number so far.

    `merged` once its part holds another one, `absorbed` where no saddle parts it from a brighter one.
    """

    peak: float
    pixel: tuple[int, int]
    point: Array | None = None
    area: int = 0
    merged: bool = False
    absorbed: bool = False
