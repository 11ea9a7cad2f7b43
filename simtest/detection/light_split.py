"""Splits a colour frame into light off the tissue and light off its wet surface, by the tissue's own colour.

What a glossy surface mirrors has the colour of the lamp, which a white-balanced camera shows as grey. It adds the same
to all channels, so that the difference of the largest and the smallest channel is that of the tissue alone (dichromatic
model, Shafer 1985). Over the tissue around, mean over difference is nearly constant; times the difference it gives the
tissue's part of each pixel, whatever the shading. The rest is specular.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.detection.noise import estimate_noise

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

BLOCKS = 160
"""The tissue's colour is asked for in square blocks, so many along the picture's longer side ..."""

NEIGHBOURHOOD = 25
"""... and is the median of so many by so many of them: wider than highlights, and narrower than organs."""

LEAST_LIGHT = 0.01
"""Share of full scale below which a pixel has no colour worth asking."""

LEAST_COLOUR = 0.08
"""Least difference of the channels over their mean: greyer tissue cannot be told from a highlight by its colour."""

_LOG_FACTORS = (float(np.log(1 / 3)), float(np.log(1 / LEAST_COLOUR)))
"""Range of the logarithm of the mean over the difference of the channels."""

CANDIDATE = 0.5
"""Where the specular light is this share of the tissue's, the latter is taken from around, not from the pixel."""

_AROUND = np.ones((3, 3), dtype=np.uint8)
_WIDE = np.ones((5, 5), dtype=np.uint8)


@dataclass(frozen=True)
class SplitLight:
    """The two parts of a frame's light, share of full scale.

    Parameters
    ----------
    intensity : ndarray of float32, shape (H, W)
        Mean of the channels.
    specular : ndarray of float32, shape (H, W)
        What the surface mirrors; about 0 elsewhere, with the noise of the difference; 0 outside the view.
    tissue : ndarray of float32, shape (H, W)
        The rest.
    noise : float
        Standard deviation of the specular part from pixel to pixel.
    """

    intensity: Image
    specular: Image
    tissue: Image
    noise: float


def split_light(linear: Image, clipped: Mask, seen: Mask | None = None) -> SplitLight:
    """Split a frame.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear values, share of full scale.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.

    Returns
    -------
    SplitLight
    """
    channels = cv2.split(np.ascontiguousarray(linear))
    least = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
    most = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
    intensity = (channels[0] + channels[1] + channels[2]) / np.float32(3)
    inside = np.ones(least.shape, dtype=bool) if seen is None else seen
    sound = inside & (cv2.dilate(clipped.astype(np.uint8), _AROUND) == 0)
    difference = most - least
    factor, floor = _tissue_colour(intensity, difference, least, sound)
    # Noise of the difference is noise of the tissue's part, which has no fine detail of its own that would count.
    tissue = np.minimum(factor * cv2.GaussianBlur(difference, (0, 0), 1.0), intensity)
    tissue = fill(tissue, sound)
    specular = intensity - tissue
    candidate = specular >= CANDIDATE * tissue
    clean = sound & (cv2.dilate(candidate.astype(np.uint8), _WIDE) == 0)
    tissue = np.where(candidate | ~sound, fill(tissue, clean), tissue)
    # Of the least channel too, the tissue has its part: what is left bounds the specular light, and where the largest
    # channel is clipped it is the better measure.
    specular = np.minimum(intensity - tissue, least - floor * tissue)
    specular[~inside] = 0
    return SplitLight(intensity, specular, intensity - specular, estimate_noise(specular, seen))


def _tissue_colour(intensity: Image, difference: Image, least: Image, sound: Mask) -> tuple[Image, Image]:
    """Give, at each pixel, the mean of the tissue's channels over their difference, and the least over the mean."""
    height, width = intensity.shape
    block = max(height, width) / BLOCKS
    size = (max(round(width / block), 1), max(round(height / block), 1))
    asked = sound & (intensity > LEAST_LIGHT)
    weight = asked.astype(np.float32)
    sums = [cv2.resize(v * weight, size, interpolation=cv2.INTER_AREA) for v in (intensity, difference, least, weight)]
    mean, gap, low, share = sums
    known = (share > 0.25) & (mean > 0)
    factor = np.where(known, mean / np.maximum(gap, LEAST_COLOUR * np.maximum(mean, 1e-9)), 0)
    floor = np.where(known, low / np.maximum(mean, 1e-9), 0)
    maps = []
    for values, low_end, high_end in ((np.log(np.maximum(factor, 1 / 3)), *_LOG_FACTORS), (floor, 0.0, 1.0)):
        around = _median(fill(values.astype(np.float32), known), low_end, high_end)
        maps.append(cv2.resize(around, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.exp(maps[0]), maps[1]


def _median(values: Image, low: float, high: float) -> Image:
    """Give the median of each neighbourhood, in 255 steps between two ends: as fine as the tissue's colour is even."""
    steps = np.rint((np.clip(values, low, high) - low) * (255 / (high - low))).astype(np.uint8)
    edge = NEIGHBOURHOOD // 2
    padded = cv2.copyMakeBorder(steps, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    around = cv2.medianBlur(padded, NEIGHBOURHOOD)[edge:-edge, edge:-edge]
    return (low + around.astype(np.float32) * ((high - low) / 255)).astype(np.float32)


def fill(values: Image, known: Mask) -> Image:
    """Fill what is not known smoothly from what is, by averages over ever coarser pixels.

    Parameters
    ----------
    values : ndarray of float32, shape (H, W)
        Values; those not known are not looked at.
    known : ndarray of bool, shape (H, W)
        Which are known. Where none is, zeros are given.

    Returns
    -------
    ndarray of float32, shape (H, W)
        The known values as they are.
    """
    weight = known.astype(np.float32)
    levels = [(values * weight, weight)]
    while max(levels[-1][0].shape) > 1:
        rows, columns = levels[-1][0].shape
        size = ((columns + 1) // 2, (rows + 1) // 2)
        levels.append(tuple(cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in levels[-1]))
    filled = levels[-1][0] / np.maximum(levels[-1][1], np.float32(1e-12))
    for part, share in levels[-2::-1]:
        rows, columns = part.shape
        coarse = cv2.resize(filled, (columns, rows), interpolation=cv2.INTER_LINEAR)
        # A pixel known in part takes the rest from the coarser level.
        filled = part + (1 - share) * coarse
    return np.asarray(filled, dtype=np.float32)
