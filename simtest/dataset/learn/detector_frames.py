"""Frames of a dataset with the pixels of their visible highlights: examples for a network that finds these."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from simtest.calibration import srgb_encode
from simtest.conventions import HIGHLIGHT_CONTRAST_SIGMA
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.learn.spots import sample_frame
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.sample import Sample
from simtest.errors import InputError
from simtest.runtime.arrays import AnyArray, IntArray
from simtest.validation.runner import Progress

TISSUE, HIGHLIGHT, UNJUDGED, OUTSIDE = range(4)
"""What a pixel is: of no highlight; of one that need be found; of one that need not, or of an instrument; outside the
view."""

LEAST_RADIUS_PX = 1.0
"""Smaller highlights need not be found."""

OWN_MOMENT = 0.25
"""Added to the second moments of a highlight's pixels: a bump is at least about a pixel wide."""

FULL = 255
"""Value of a bump's top."""

FIELDS_READ = ("image", "visible", INSTRUMENT)


@dataclass(frozen=True)
class DetectorFrames:
    """N frames.

    Parameters
    ----------
    picture : ndarray of uint8, shape (N, H, W, 3)
        R G B, sRGB-encoded; a channel that the sensor clipped is 255.
    state : ndarray of uint8, shape (N, H, W)
        What each pixel is: `TISSUE`, `HIGHLIGHT`, `UNJUDGED` or `OUTSIDE`.
    bump : ndarray of uint8, shape (N, H, W)
        A Gaussian around the middle of each highlight with the second moments of its pixels; 255 at its top.
    region : ndarray of int16, shape (N, H, W)
        1 + the index of the visible highlight whose pixel it is; negative where that need not be found; 0 elsewhere.
    """

    picture: AnyArray
    state: AnyArray
    bump: AnyArray
    region: AnyArray


def read_frames(folder: str | Path, split: str, progress: Progress | None = None) -> DetectorFrames:
    """Read the frames of a split; raise errors as `simtest.dataset.read`, and `InputError` where their sizes differ."""
    total = len(sample_positions(folder, split))
    rows: list[tuple[AnyArray, ...]] = []
    for number, sample in enumerate(read_samples(folder, split, FIELDS_READ)):
        row = frame_example(sample)
        if rows and row[1].shape != rows[0][1].shape:
            (height, width), (first_height, first_width) = row[1].shape, rows[0][1].shape
            raise InputError(
                f"{sample.key}: has {width} x {height} px; must be {first_width} x {first_height} as the first frame"
            )
        rows.append(row)
        if progress:
            progress(number + 1, total + 1, f"{split} split: frames read")
    if not rows:
        empty = np.empty((0, 1, 1), dtype=np.uint8)
        return DetectorFrames(np.empty((0, 1, 1, 3), dtype=np.uint8), empty, empty, empty.astype(np.int16))
    return DetectorFrames(*(np.stack(parts) for parts in zip(*rows, strict=True)))


def frame_example(sample: Sample) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Return picture, state, bump and region of a sample (see `DetectorFrames`)."""
    frame = sample_frame(sample)
    picture = np.rint(FULL * srgb_encode(np.clip(frame.channels, 0, 1))).astype(np.uint8)
    level = frame.calibration.saturation_level
    if level is not None:
        picture[frame.encoded >= np.float32(level)] = FULL
    visible = sample.images["visible"].astype(np.int32)
    needed = needs_be_found(sample.meta["visible_highlights"])
    region = np.where(np.append(False, needed)[visible], visible, -visible)
    state = np.full(visible.shape, TISSUE, dtype=np.uint8)
    # Light of a highlight that need not be found reaches a pixel farther than its pixels.
    state[cv2.dilate((region < 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0] = UNJUDGED
    state[region > 0] = HIGHLIGHT
    state[sample.images[INSTRUMENT] > 0] = UNJUDGED
    if frame.seen is not None:
        state[~frame.seen] = OUTSIDE
    return picture, state, bumps(np.maximum(region, 0)), region.astype(np.int16)


def needs_be_found(visible: Sequence[Any]) -> AnyArray:
    """Return which visible highlights a detector must find, shape (N,).

    They stand 10 noise deviations high, are clear of the border, and lie on tissue.
    """
    return np.array(
        [
            bool(spot["whole"])
            and spot.get("instrument") is None
            and (spot["peak_snr"] is None or float(str(spot["peak_snr"])) >= HIGHLIGHT_CONTRAST_SIGMA)
            and float(str(spot["area_px"])) >= np.pi * LEAST_RADIUS_PX**2
            for spot in visible
        ],
        dtype=bool,
    )


def bumps(region: IntArray) -> AnyArray:
    """Return the Gaussian of each region, numbered from 1, inside its pixels, uint8, shape (H, W)."""
    rows, columns = np.nonzero(region)
    number = region[rows, columns]
    count = np.maximum(np.bincount(number), 1)

    def mean(values: AnyArray) -> AnyArray:
        return np.asarray(np.bincount(number, weights=values) / count)

    down, right = rows - mean(rows)[number], columns - mean(columns)[number]
    a, b, c = mean(down * down) + OWN_MOMENT, mean(down * right), mean(right * right) + OWN_MOMENT
    a, b, c = a[number], b[number], c[number]
    distance2 = (c * down**2 - 2 * b * down * right + a * right**2) / (a * c - b * b)
    made = np.zeros(region.shape, dtype=np.uint8)
    made[rows, columns] = np.rint(FULL * np.exp(-distance2 / 2))
    return made
