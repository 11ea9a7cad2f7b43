"""`colour`: highlights of a colour frame by the tissue's own colour, and which of them are isolated."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.calibration.frame import MAD_TO_SIGMA, median
from simtest.conventions import SPECULAR_DIFFUSE_RATIO, SPECULAR_PEAK_SHARE
from simtest.detection.classify import MIN_SHAPE_PX, classify
from simtest.detection.detector import SINGLE, Detection, Highlight, Kind
from simtest.detection.spots import ColourPicture, SpecularSpot, SplitLight, fill, find_spots
from simtest.detection.view import find_foreign, view_of
from simtest.errors import InputError
from simtest.geometry import Camera, Image, Mask
from simtest.geometry.patch import dilated, rows_and_columns

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

FOOT = 0.4
"""A highlight's pixels are searched for down to this share of what its peak must have."""

LEAST_SPECULAR = 0.02
"""Least specular light, share of full scale: two steps of an 8-bit sRGB picture at mid tones."""

DIM, CLEARLY_CLIPPED = 0.8, 0.1
"""Where the normal bisects light and camera, one lobe is as bright at every distance, over the tissue beside it. So
where more than the second share of one highlight is clipped, a resolved one below the first share of its light is
dim."""

FOOT_REACH = 0.8
"""A highlight's foot reaches this share of its radius at half height beyond that: a Gaussian's at a tenth of it."""

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


def detect_colour(
    linear: Image, clipped: Mask, seen: Mask | None = None, keep_overlays: bool = False
) -> ColourDetection:
    """Find the highlights of a colour frame.

    In a highlight's pixels the specular light is at least the tissue's, at least 10 % of the highlight's peak, and more
    than noise. Both parts follow from the tissue's own colour around each pixel (`split_light`), so there is no global
    threshold. `linear`, shape (H, W, 3), is white-balanced, share of full scale: light mirrored by the surface is grey.
    `clipped`, shape (H, W), is where a channel is clipped, `seen` are the pixels inside the view, default all. With
    `keep_overlays` text and squares are taken for tissue.
    """
    picture = ColourPicture.of(linear, clipped, seen)
    light, shape = picture.light, clipped.shape
    specular, tissue = (picture.smoothed(part, SMOOTHING_PX) for part in (light.specular, light.tissue))
    noise = NOISE_LEFT * light.noise
    # candidates: pixels that may belong to a highlight, and what its peak must have
    ratio = max(FAINT_RATIO, TEXTURE_FACTOR * _texture(specular, tissue, ~clipped & picture.inside))
    candidates = specular >= np.maximum(max(FOOT * LEAST_SPECULAR, NOISE_FACTOR * noise), FOOT * ratio * tissue)
    candidates &= picture.inside
    least = np.maximum(max(LEAST_SPECULAR, PEAK_NOISE * noise), ratio * tissue)
    # what shines, on tissue or not
    total, bare = specular + tissue, ~dilated(candidates, 2) & picture.inside
    spots = find_spots(specular, tissue, candidates, least, noise, picture.flat)
    spots = _brighter_than_around(spots, total, bare, ratio)
    bright = _pixels(spots, shape)
    foreign = find_foreign(bright, not keep_overlays)
    spots = [spot for spot in spots if not foreign[spot.crop][spot.mask].mean() > ON_FOREIGN]
    # Only now: text is known by whole lines.
    spots = [spot for spot in spots if _stands_out(spot, total, bare)]
    judged = [
        (spot, highlight)
        for spot, highlight in zip(spots, classify(spots, picture, bright), strict=True)
        if highlight is not None
    ]
    spots = [spot for spot, _ in judged]
    # pixels that show a highlight
    mask = _pixels(spots, shape)
    mask |= _feet(
        spots, mask, light.specular, (light.specular >= SPECULAR_DIFFUSE_RATIO * light.tissue) & candidates & ~foreign
    )
    return ColourDetection(light, mask, _with_dim_marked([highlight for _, highlight in judged], light))


def _texture(specular: Image, tissue: Image, inside: Mask) -> float:
    """Return the robust spread of specular light over the tissue's, where the tissue's colour varies by itself."""
    # By all light: the tissue's part is filled in from around where a pixel has no colour, as a dark background has.
    sound = inside & (specular + tissue > TEXTURE_LIGHT) & (tissue > 0)
    values = specular[::2, ::2][sound[::2, ::2]] / tissue[::2, ::2][sound[::2, ::2]]
    if len(values) < MIN_TEXTURE_PX:
        return 0.0
    middle = float(median(values))
    return MAD_TO_SIGMA * float(median(np.abs(values - middle)))


def _brighter_than_around(spots: list[SpecularSpot], total: Image, bare: Mask, ratio: float) -> list[SpecularSpot]:
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


def _stands_out(spot: SpecularSpot, total: Image, bare: Mask) -> bool:
    """Return whether no bare tissue beside a spot comes near to its light; a wide one needs not be asked."""
    if spot.area_px > NARROW_PX:
        return True
    (x, y), (height, width) = spot.corner, spot.mask.shape
    left, top = max(x - BESIDE_PX, 0), max(y - BESIDE_PX, 0)
    beside = np.s_[top : y + height + BESIDE_PX, left : x + width + BESIDE_PX]
    column, row = spot.peaks[0]
    return bool(total[beside].max(where=bare[beside], initial=0) <= STANDS_OUT * total[row, column])


def _pixels(spots: list[SpecularSpot], shape: tuple[int, ...]) -> Mask:
    """Return the pixels of spots."""
    mask = np.zeros(shape, dtype=bool)
    for spot in spots:
        mask[spot.crop] |= spot.mask
    return mask


def _with_dim_marked(highlights: list[Highlight], light: SplitLight) -> list[Highlight]:
    """Return highlights of which those are marked that are dim beside clipped ones."""
    pixels = [highlight.region.peak[::-1] for highlight in highlights]
    totals = [float(light.specular[pixel]) + float(light.tissue[pixel]) for pixel in pixels]
    shining = [total for total, each in zip(totals, highlights, strict=True) if each.clipped > CLEARLY_CLIPPED]
    least = DIM * max(shining, default=0.0)
    return [
        replace(each, dim=True) if each.area_px >= MIN_SHAPE_PX and total < least else each
        for total, each in zip(totals, highlights, strict=True)
    ]


def _feet(spots: list[SpecularSpot], mask: Mask, specular: Image, more: Mask) -> Mask:
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
    nearest_spot = owner[nearest[down, right]]
    reach = np.array([FOOT_REACH * np.sqrt(spot.area_px / np.pi) + 1 for spot in spots])
    peak = np.array([spot.value for spot in spots])
    bright = specular[rows, columns] >= SPECULAR_PEAK_SHARE * peak[nearest_spot]
    near = bright & (away[down, right] <= reach[nearest_spot])
    feet = np.zeros(mask.shape, dtype=bool)
    feet[rows[near], columns[near]] = True
    return feet


@dataclass(frozen=True)
class ColourDetector:
    """Highlights by the tissue's own colour (`detect_colour`).

    Where the camera has no view mask the view is found in the picture. Estimators see the specular light alone.

    Parameters
    ----------
    isolated : bool
        Leave out highlights of the other kinds, but for clusters: these are told, and no estimator answers for them.
    keep_overlays : bool
        Take text and squares that are drawn on the picture for tissue.
    """

    isolated: bool = True
    keep_overlays: bool = False

    def detect(self, frame: Frame, camera: Camera, priors: Priors = NO_PRIORS) -> Detection:
        """Find the highlights of a frame; raise `InputError` where it has not three channels."""
        if frame.encoded.ndim != 3 or frame.encoded.shape[2] != 3:
            raise InputError(f"frame has shape {frame.encoded.shape}: detection by colour takes (H, W, 3)")
        view = view_of(frame)
        detected = detect_colour(frame.channels, frame.clipped, view.seen, self.keep_overlays)
        kinds = (*SINGLE, Kind.CLUSTER) if self.isolated else tuple(Kind)
        taken = tuple(highlight for highlight in detected.highlights if highlight.kind in kinds)
        others = tuple(highlight for highlight in detected.highlights if highlight.kind not in kinds)
        specular = replace(frame, seen=view.seen, light=detected.light.specular)
        return Detection(tuple(highlight.region for highlight in taken), specular, taken, others, view)


colour = ColourDetector()
