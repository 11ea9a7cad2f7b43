"""Two other detectors of specular pixels, to compare with: a fixed threshold, and a published method.

No package on PyPI offers a published detector for endoscopy; the second is written here from the description in the
article, with the article's parameters.
"""

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage

Picture = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

THRESHOLDS = (140, 160, 180, 200, 220, 240)
"""Tried for the fixed threshold; the one with the best Dice on the tuning frames is used."""

T1, T2_ABS, T2_REL = 240.0, 190.0, 1.0
TUNED_T2_REL = (1.0, 1.2, 1.5, 2.0, 3.0)
"""Tried for the published method on the tuning frames, beside the article's 1.0."""

MEDIAN_PX, N_MIN, T3 = 30, 5000, 5.0


def fixed_threshold(picture: Picture, threshold: int) -> Mask:
    """Take pixels whose luma is at least the threshold and whose saturation (HSV) is below 0.4."""
    luma = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    saturation = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)[:, :, 1]
    return np.asarray((luma >= threshold) & (saturation < 0.4 * 255))


def arnold(picture: Picture, t2_rel: float = T2_REL) -> Mask:
    """Detect as Arnold, Ghosh, Ameling and Lacey (EURASIP Journal on Image and Video Processing 2010, 814319) describe.

    Module 1 takes intense pixels: green, blue or luma above 240, green and blue weighed by how their 95th percentiles
    compare with luma's. Module 2 asks for contrast: intense pixels by the lower threshold 190 are filled with the mean
    colour around them, the result is median filtered (30 px), and a pixel is specular where a channel exceeds that by
    more than its channel's contrast coefficient allows. Large regions (above 5000 px) whose contour has hardly any
    gradient are dropped.
    """
    values = picture.astype(np.float32)
    red, green, blue = (values[:, :, i] for i in range(3))
    luma = 0.2989 * red + 0.5870 * green + 0.1140 * blue
    top = float(np.percentile(luma, 95))
    of_green, of_blue = (float(np.percentile(channel, 95)) / max(top, 1.0) for channel in (green, blue))

    def intense(level: float) -> Mask:
        return np.asarray((green > of_green * level) | (blue > of_blue * level) | (luma > level))

    filled = _fill_with_colour_around(values, intense(T2_ABS))
    contrast = np.zeros(luma.shape, dtype=np.float32)
    for i in range(3):
        # OpenCV's median needs an odd width.
        background = cv2.medianBlur(filled[:, :, i].astype(np.uint8), MEDIAN_PX + 1).astype(np.float32)
        channel = values[:, :, i]
        coefficient = float(channel.mean()) / max(float(channel.mean() + channel.std()), 1e-6)
        contrast = np.maximum(contrast, coefficient * channel / np.maximum(background, 1.0))
    return _without_smooth_areas(intense(T1) | (contrast > t2_rel), luma)


def _fill_with_colour_around(values: npt.NDArray[np.float32], mask: Mask) -> npt.NDArray[np.float32]:
    """Return each region of a mask the mean colour of the ring 2 to 4 px around it."""
    near = cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0
    labels, count = ndimage.label(near)
    filled = values.copy()
    for number, box in enumerate(ndimage.find_objects(labels, count), start=1):
        wide = tuple(slice(max(part.start - 3, 0), part.stop + 3) for part in box)
        inside = labels[wide] == number
        ring = (cv2.dilate(inside.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))) > 0) & ~inside
        ring &= ~near[wide]
        if ring.any():
            filled[wide][inside] = values[wide][ring].mean(axis=0)
    return filled


def _without_smooth_areas(mask: Mask, luma: npt.NDArray[np.float32]) -> Mask:
    gradient = np.hypot(cv2.Sobel(luma, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(luma, cv2.CV_32F, 0, 1) / 8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    kept = np.ones(count, dtype=bool)
    kept[0] = False
    for number in range(1, count):
        if stats[number, cv2.CC_STAT_AREA] > N_MIN:
            region = labels == number
            rim = region & ~(cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
            kept[number] = bool(gradient[rim].mean() > T3)
    return np.asarray(kept[labels])
