"""Split a colour frame into light from the tissue and light from its wet surface, by the tissue's own colour.

A glossy surface mirrors the colour of the lamp, which a white-balanced camera shows as grey. That adds the same to all
channels, so the difference of the largest and the smallest channel is that of the tissue alone (dichromatic model,
Shafer 1985). In tissue the ratio of mean and difference is nearly constant around a pixel; times the pixel's difference
it is the tissue's part of the light, whatever the shading. The rest is specular.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import estimate_noise
from simtest.geometry import Image, Mask

BLOCKS = 160
"""The tissue's colour is measured in square blocks, so many along the picture's longer side ..."""

NEIGHBOURHOOD = 25
"""... and is the median of so many by so many of them: wider than highlights, and narrower than organs."""

LEAST_LIGHT = 0.01
"""Below this share of full scale a pixel's colour is not used."""

LEAST_COLOUR = 0.08
"""Least difference of the channels over their mean: the colour of greyer tissue does not differ from a highlight's."""

_LOG_FACTORS = (float(np.log(1 / 3)), float(np.log(1 / LEAST_COLOUR)))
"""Range of the logarithm of the mean over the difference of the channels."""

CANDIDATE = 0.5
"""Where the specular light is at least this share of the tissue's, the latter is filled in from around the pixel."""

_AROUND = np.ones((3, 3), dtype=np.uint8)
_WIDE = np.ones((5, 5), dtype=np.uint8)


@dataclass(frozen=True)
class SplitLight:
    """The two parts of a frame's light, shape (H, W), share of full scale.

    Specular light is mirrored by the surface: about 0 elsewhere, with the noise of the difference, and 0 outside the
    view. The rest is the tissue's. `noise` is the standard deviation of the specular part from pixel to pixel.
    """

    specular: Image
    tissue: Image
    noise: float


def split_light(linear: Image, clipped: Mask, seen: Mask | None = None) -> SplitLight:
    """Split a frame of linear values, shape (H, W, 3), shares of full scale.

    `clipped`, shape (H, W), is where a channel is clipped, `seen` the pixels inside the view, default all.
    """
    channels = cv2.split(np.ascontiguousarray(linear))
    least = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
    most = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
    intensity = (channels[0] + channels[1] + channels[2]) / np.float32(3)
    inside = np.ones(least.shape, dtype=bool) if seen is None else seen
    sound = inside & (cv2.dilate(clipped.astype(np.uint8), _AROUND) == 0)
    # tissue by its colour: mean over difference from around, times the pixel's difference
    difference = most - least
    factor, floor = _tissue_colour(intensity, difference, least, sound)
    # The difference is smoothed: its noise would be the tissue's, which has no fine detail that matters.
    tissue = np.minimum(factor * cv2.GaussianBlur(difference, (0, 0), 1.0), intensity)
    tissue = fill(tissue, sound)
    # under highlights: filled in from clean pixels
    specular = intensity - tissue
    candidate = specular >= CANDIDATE * tissue
    clean = sound & (cv2.dilate(candidate.astype(np.uint8), _WIDE) == 0)
    tissue = np.where(candidate | ~sound, fill(tissue, clean), tissue)
    # The least channel less the tissue's part of it bounds the specular light too, and is the better measure where the
    # largest channel is clipped.
    specular = np.minimum(intensity - tissue, least - floor * tissue)
    specular[~inside] = 0
    return SplitLight(specular, intensity - specular, estimate_noise(specular, seen))


def _tissue_colour(intensity: Image, difference: Image, least: Image, sound: Mask) -> tuple[Image, Image]:
    """Return at each pixel the mean of the tissue's channels over their difference, and the least over the mean."""
    height, width = intensity.shape
    block = max(height, width) / BLOCKS
    size = (max(round(width / block), 1), max(round(height / block), 1))
    # means over each block's bright, sound pixels
    weight = (sound & (intensity > LEAST_LIGHT)).astype(np.float32)
    sums = [cv2.resize(v * weight, size, interpolation=cv2.INTER_AREA) for v in (intensity, difference, least, weight)]
    mean, gap, low, share = sums
    known = (share > 0.25) & (mean > 0)
    factor = np.where(known, mean / np.maximum(gap, LEAST_COLOUR * np.maximum(mean, 1e-9)), 0)
    floor = np.where(known, low / np.maximum(mean, 1e-9), 0)
    # medians over the neighbourhood, and back to the frame's size
    maps = []
    for values, low_end, high_end in ((np.log(np.maximum(factor, 1 / 3)), *_LOG_FACTORS), (floor, 0.0, 1.0)):
        around = _median(fill(values.astype(np.float32), known), low_end, high_end)
        maps.append(cv2.resize(around, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.exp(maps[0]), maps[1]


def _median(values: Image, low: float, high: float) -> Image:
    """Return the median of each neighbourhood, in 255 steps between two ends, as fine as tissue's colour is even."""
    steps = np.rint((np.clip(values, low, high) - low) * (255 / (high - low))).astype(np.uint8)
    edge = NEIGHBOURHOOD // 2
    padded = cv2.copyMakeBorder(steps, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    around = cv2.medianBlur(padded, NEIGHBOURHOOD)[edge:-edge, edge:-edge]
    return (low + around.astype(np.float32) * ((high - low) / 255)).astype(np.float32)


def fill(values: Image, known: Mask) -> Image:
    """Fill unknown values, shape (H, W), smoothly from known ones, by averages over ever coarser pixels.

    Known values are unchanged; where none is known the result is 0.
    """
    weight = known.astype(np.float32)
    # down: sums of known values over ever coarser pixels
    levels = [(values * weight, weight)]
    while max(levels[-1][0].shape) > 1:
        rows, columns = levels[-1][0].shape
        size = ((columns + 1) // 2, (rows + 1) // 2)
        levels.append(tuple(cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in levels[-1]))
    # up: what a pixel lacks comes from the coarser level
    filled = levels[-1][0] / np.maximum(levels[-1][1], np.float32(1e-12))
    for part, share in levels[-2::-1]:
        rows, columns = part.shape
        coarse = cv2.resize(filled, (columns, rows), interpolation=cv2.INTER_LINEAR)
        filled = part + (1 - share) * coarse
    return np.asarray(filled, dtype=np.float32)
