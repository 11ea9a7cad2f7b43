"""Spots of the tissue become judged highlights, and these a detection."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.detection.blobs import MIN_SHAPE_PX, SINGLE, Highlight, Kind, classify
from simtest.detection.detector import Detection
from simtest.detection.foreign import find_foreign
from simtest.detection.light_split import SplitLight
from simtest.detection.spots import Spot
from simtest.detection.view_mask import View
from simtest.geometry import Image, Mask, smooth
from simtest.geometry.patch import rows_and_columns

SHAPE_PX = 0.7
"""Smoothing of the specular light before the shape of highlights is measured."""

DIM, CLEARLY_CLIPPED = 0.8, 0.1
"""Where the normal bisects light and camera, one lobe is as bright at every distance, over the tissue beside it. So
where more than the second share of one highlight is clipped, a resolved one below the first share of its light is
dim."""

FOOT_REACH = 0.8
"""A highlight's foot reaches this share of its radius at half height beyond that: a Gaussian's at a tenth of it."""

PLATEAU, GLARE = 0.97, 0.7
"""All channels are clipped above this share of the clipped value, and where a spot's shape is judged above the second:
demosaicing and JPEG round them off."""

ON_FOREIGN = 0.5
"""A spot of which more than this share lies on text or an instrument is none of the tissue's."""


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


def tissue_spots(spots: list[Spot], shape: tuple[int, ...]) -> tuple[list[Spot], Mask, Mask]:
    """Return the spots that lie on no text or instrument, the pixels of all, and those of text and instruments."""
    bright = _pixels(spots, shape)
    foreign = find_foreign(bright)
    if foreign.any():
        spots = [spot for spot in spots if not foreign[spot.crop][spot.mask].mean() > ON_FOREIGN]
    return spots, bright, foreign


def judge_spots(
    spots: list[Spot], light: SplitLight, linear: Image, bright: Mask, clipped: tuple[Mask, Mask], candidates: Mask,
    seen: Mask | None,
) -> ColourDetection:  # fmt: skip
    """Classify spots, leave out pale tissue, and find the pixels that show a highlight.

    Parameters
    ----------
    spots : list of Spot
        On tissue.
    light : SplitLight
        The frame's two parts.
    linear : ndarray, shape (H, W, 3)
        The frame.
    bright, candidates : ndarray of bool, shape (H, W)
        Pixels of all spots, and those that may belong to a highlight.
    clipped : tuple of ndarray of bool
        As `plateaus` returns them.
    seen : ndarray of bool, shape (H, W), optional
        The view; default everywhere.
    """
    made = classify(spots, smooth(light.specular, SHAPE_PX, seen), light, linear, bright, *clipped, seen)
    kept = [(spot, highlight) for spot, highlight in zip(spots, made, strict=True) if highlight is not None]
    # pixels that show a highlight
    mask = _pixels([spot for spot, _ in kept], candidates.shape)
    more = (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue) & candidates
    mask |= _feet([spot for spot, _ in kept], mask, light.specular, more)
    return ColourDetection(light, mask, _with_dim_marked([highlight for _, highlight in kept], light))


def detection_of(found: ColourDetection, frame: Frame, view: View, isolated: bool) -> Detection:
    """Return the detection of a frame; `isolated` leaves out the kinds that carry no normal, but for clusters."""
    kinds = (*SINGLE, Kind.CLUSTER) if isolated else tuple(Kind)
    taken = tuple(highlight for highlight in found.highlights if highlight.kind in kinds)
    others = tuple(highlight for highlight in found.highlights if highlight.kind not in kinds)
    specular = replace(frame, seen=view.seen, light=found.light.specular)
    return Detection(tuple(highlight.region for highlight in taken), specular, taken, others, view)


def _pixels(spots: list[Spot], shape: tuple[int, ...]) -> Mask:
    """Return the pixels of spots."""
    mask = np.zeros(shape, dtype=bool)
    for spot in spots:
        mask[spot.crop] |= spot.mask
    return mask


def _with_dim_marked(highlights: list[Highlight], light: SplitLight) -> list[Highlight]:
    """Return highlights of which those are marked that are dim beside clipped ones."""
    pixels = [highlight.region.peak[::-1] for highlight in highlights]
    total = [float(light.specular[pixel]) + float(light.tissue[pixel]) for pixel in pixels]
    shining = [own for own, each in zip(total, highlights, strict=True) if each.clipped > CLEARLY_CLIPPED]
    least = DIM * max(shining, default=0.0)
    return [
        replace(each, dim=True) if each.area_px >= MIN_SHAPE_PX and own < least else each
        for own, each in zip(total, highlights, strict=True)
    ]


def _feet(spots: list[Spot], mask: Mask, specular: Image, more: Mask) -> Mask:
    """Return which of more pixels belong to the nearest spot: near it, and not far below its peak."""
    if not spots:
        return mask
    number = np.zeros(mask.shape, dtype=np.int32)
    for i, spot in enumerate(spots):
        number[spot.crop][spot.mask] = i
    # Ways between pixels stay inside the box around all of them.
    x, y, width, height = cv2.boundingRect((mask | more).view(np.uint8))
    box = np.s_[y : y + height, x : x + width]
    away, nearest = cv2.distanceTransformWithLabels(
        (~mask[box]).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, dtype=np.int32)
    owner[nearest[mask[box]]] = number[mask]
    down, right = rows_and_columns((more & ~mask)[box])
    rows, columns = down + y, right + x
    mine = owner[nearest[down, right]]
    reach = np.array([FOOT_REACH * np.sqrt(spot.area_px / np.pi) + 1 for spot in spots])
    peak = np.array([spot.value for spot in spots])
    near = (away[down, right] <= reach[mine]) & (specular[rows, columns] >= SPECULAR_PEAK_SHARE * peak[mine])
    feet = np.zeros(mask.shape, dtype=bool)
    feet[rows[near], columns[near]] = True
    return feet


def plateaus(linear: Image, clipped: Mask) -> tuple[Mask, Mask]:
    """Return where all channels are clipped, and where they are nearly so."""
    if not clipped.any():
        return clipped, clipped
    channels = cv2.split(np.ascontiguousarray(linear))
    least = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
    # the least value that a clipped channel has
    full = float(linear[clipped].max(axis=1).min())
    return np.asarray(least >= PLATEAU * full), np.asarray(least >= GLARE * full)
