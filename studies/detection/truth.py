"""The true specular mask of a rendered colour frame: what the sensor gets off the specular lobe, by highlights."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import (
    HIGHLIGHT_CONTRAST_SIGMA,
    SPECULAR_DIFFUSE_RATIO,
    SPECULAR_MIN_AREA_PX,
    SPECULAR_PEAK_SHARE,
)

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Labels = npt.NDArray[np.int32]

LEAST = 1e-4
"""Share of full scale below which specular light is none."""


@dataclass(frozen=True)
class SpecularTruth:
    """The highlights of a frame, as the sensor gets them.

    `labels` (shape (H, W)): number of the highlight, from 1; 0 where there is none; `unclear` (shape (H, W)):
    pixels of highlights that nobody need find: below the noise, or of too few pixels. What is detected there is
    counted neither as right nor as wrong.
    """

    labels: Labels
    unclear: Mask

    @property
    def mask(self) -> Mask:
        """Pixels of the highlights, shape (H, W)."""
        return np.asarray(self.labels > 0)

    @property
    def count(self) -> int:
        """How many highlights there are."""
        return int(self.labels.max())


def specular_truth(
    specular: Image,
    other: Image,
    noise: Image | float,
    seen: Mask | None = None,
    peak_share: float = SPECULAR_PEAK_SHARE,
    diffuse_ratio: float = SPECULAR_DIFFUSE_RATIO,
) -> SpecularTruth:
    """Mark the pixels that show a highlight.

    A pixel does where the direct specular light is at least `peak_share` of its own highlight's peak and at least
    `diffuse_ratio` times the light that comes from elsewhere at that pixel. Light beyond full scale does not count:
    where the tissue alone clips, no highlight shows.

    `specular`, `other` (shape (H, W)): direct specular light, and diffuse and indirect light, behind the lens, mean
    of the channels, over full scale; `noise` (shape (H, W)): standard deviation of the channels' mean, over full
    scale; `seen` (shape (H, W)): the pixels inside the view mask; default all; `peak_share`, `diffuse_ratio`: the
    two thresholds.
    """
    shown = np.clip(np.minimum(specular, 1 - np.minimum(other, 1)), 0, None).astype(np.float32)
    bright = (shown >= diffuse_ratio * other) & (shown > LEAST)
    if seen is not None:
        bright &= seen
    # A highlight's own peak is that of the pixels it hangs together with.
    count, labels = cv2.connectedComponents(bright.astype(np.uint8), connectivity=8)
    peaks = _largest(shown, labels, count)
    mask = bright & (shown >= peak_share * peaks[labels])
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    area = np.bincount(labels.ravel(), minlength=count)
    clearness = _largest(shown / np.maximum(noise, 1e-9), labels, count)
    clear = (area >= SPECULAR_MIN_AREA_PX) & (clearness >= HIGHLIGHT_CONTRAST_SIGMA)
    clear[0] = False
    kept = np.where(clear, np.cumsum(clear), 0).astype(np.int32)[labels]
    return SpecularTruth(kept, mask & (kept == 0))


def _largest(values: npt.NDArray[np.floating], labels: Labels, count: int) -> npt.NDArray[np.floating]:
    """Return the largest value of each label, shape (count,); infinity for label 0, which is none."""
    largest = np.zeros(count, dtype=values.dtype)
    rows, columns = np.nonzero(labels)
    np.maximum.at(largest, labels[rows, columns], values[rows, columns])
    largest[0] = np.inf
    return largest
