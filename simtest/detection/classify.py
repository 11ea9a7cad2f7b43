"""Classify the spots of a frame by the elliptic-shape prior.

Where the normal bisects light and camera the isophotes are nested ellipses with a common centre (theory.md, section 3,
item 3). Highlights that a border cuts, streaks, clusters, and light that was reflected by tissue before are other
kinds.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration.calibration import brightest_channel, mean_channel
from simtest.calibration.frame import median
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection.detector import SINGLE, Highlight, Kind, Region
from simtest.detection.peaks import Box, grown_box
from simtest.detection.spots import BLOCKS, NEIGHBOURHOOD, ColourPicture, SpecularSpot
from simtest.errors import Failure
from simtest.geometry import Array, FittedConic, Image, Mask, fit_ellipses
from simtest.geometry.level_sets import LevelSet, crossings, level_set_around
from simtest.geometry.patch import dilated
from simtest.runtime.fitted import fitted_number

SHAPE_PX = 0.7
"""Smoothing of the specular light before the shape of highlights is measured."""

MIN_AREA_PX = 4
"""Fewer pixels tell nothing of their surroundings."""

MIN_SHAPE_PX = 12
"""Fewer pixels above half height determine no ellipse: the highlight is small, and its shape is not judged."""

NESTED_ISOVALUES = (0.5, 0.65, 0.8)
"""Isophotes whose ellipses are compared."""

ROUND = 0.3
"""A shape is a highlight's whatever shines around from this axis ratio on: pale strips of tissue are longer."""

RESIDUAL = 0.09
"""Largest RMS distance of an isolated highlight's isophote from its ellipse, as a share of its radius."""

RESIDUAL_CLIPPED = 0.16
"""The same where the sensor is clipped: the isophotes are then low ones of the true lobe, far from the peak."""

WANDER = 0.25
"""Largest distance between the centres of the nested ellipses, as a share of the radius at half height."""

LEAST_AXIS_RATIO = 0.12
"""A longer highlight is a streak, as on an instrument; on tissue so long a one bends, or lies where abs(1 + d k) is
near 0."""

MIN_CLIPPED_PX = 12
"""With so many pixels that are nearly clipped above half height the shape is that of a clipped highlight."""

CLIPPED_SHARE = 0.5
"""With this share of the pixels above half height clipped, and the least that follows, a highlight counts as clipped:
what is left of its lobe is the rim."""

LEAST_CLIPPED_PX = 4

TINT = 0.4
"""Light mirrored by the surface is grey. Where the weakest channel gains less than this share of the strongest one's
gain, the light was reflected by tissue before."""

UNCLIPPED = 0.85
"""Channels above this share of full scale may be partly clipped."""

CLUTTER_SHARE = 0.9
CLUTTER = 0.2
"""Largest specular light, over the peak's, of nine tenths of the surroundings: instruments, pale folds and glistening
patches have more."""

PALE, PALE_WIDE, WIDE_PX = 0.6, 0.4, 200
PALE_SHARE = 0.75
"""Where the brightest quarter of the surroundings is brighter than this share of a spot that has no highlight's shape
(the second share from so many pixels on), the spot is pale tissue, ..."""

GLARING, WIDEST, CLIPPED_CORE = 0.2, 0.5, 0.02
"""... unless more than this share of it is white, and it is narrower than the second share of the neighbourhood that
the tissue's colour is taken from (a wider one would be its own measure), or the third share of it is clipped."""

LEAK, LEAK_PX = 1.3, 4
"""An isophote at half height that holds more than this share of the spot's pixels, and this number on top, holds
something else besides."""

FOOT_REACH, FARTHEST_PX = 0.7, 10
"""Clutter is looked for beyond this share of a radius from the isophote at half height, and no farther off."""

REACH_PX = 3
"""So near to a spot a border may cut it, and light is no surroundings of it."""

EDGE_STEP = fitted_number("fold_edge.step")
EDGE_NEAR, EDGE_SECTORS = 0.4, 8
"""The ring around a spot in which an edge shows begins this share of a radius from it, and has so many sectors."""

_Contour = tuple[Array, FittedConic]
"""An isophote's points and its ellipse."""


@dataclass(frozen=True)
class Measured:
    """A spot with what its kind is judged by; fields that are not named here are those of `Highlight`.

    Parameters
    ----------
    half : LevelSet or None
        Its isophote at half height in its region, None where that is open or not its own.
    at_border : bool
        Whether the picture's edge or the view's border may cut it.
    clipped_px, white_px : int
        Its pixels all of whose channels are clipped, and nearly so.
    surround : float
        Light of its surroundings over its own.
    """

    spot: SpecularSpot
    box: Box
    half: LevelSet | None
    axis_ratio: float | None
    residual: float | None
    wander: float | None
    at_border: bool
    clipped_px: int
    white_px: int
    tint: float
    clutter: float
    surround: float

    @property
    def has_shape(self) -> bool:
        """Whether it has pixels enough for an ellipse."""
        return self.spot.area_px >= MIN_SHAPE_PX


def classify(spots: list[SpecularSpot], picture: ColourPicture, bright: Mask) -> list[Highlight | None]:
    """Classify the spots of a picture, whose pixels are `bright`, shape (H, W); None where one is pale tissue."""
    smoothed = picture.smoothed(picture.light.specular, SHAPE_PX)
    boxes = [grown_box(spot.corner, spot.mask.shape[::-1], smoothed.shape) for spot in spots]
    isophotes = [_isophotes(spot, box, smoothed, picture) for spot, box in zip(spots, boxes, strict=True)]
    judged: list[Highlight | None] = []
    # ellipses of all isophotes at once
    for spot, box, sets, fits in zip(spots, boxes, isophotes, _fit(isophotes), strict=True):
        clipped, white = (int(np.count_nonzero(part[spot.crop] & spot.mask)) for part in (picture.flat, picture.white))
        at_border = _at_border(spot, picture)
        one = Measured(
            spot, box, sets[0], *_shape(fits), at_border, clipped, white, *_around(spot, box, picture, bright)
        )
        kind = _kind(one)
        if _is_pale(one, kind, max(smoothed.shape)):
            judged.append(None)
            continue
        if kind in SINGLE and edge_step(spot, picture, bright) > EDGE_STEP:
            kind = Kind.BORDER
        judged.append(_highlight(one, kind))
    return judged


def _isophotes(spot: SpecularSpot, box: Box, smoothed: Image, picture: ColourPicture) -> tuple[LevelSet | None, ...]:
    """Trace a spot's isophotes in its region; None where open, and for a cluster or a shoulder, which has none."""
    none = (None,) * len(NESTED_ISOVALUES)
    if spot.touches or (len(spot.peaks) > 1 and not spot.melted):
        return none
    left, top, width, height = box
    crop = np.s_[top : top + height, left : left + width]
    column, row = int(spot.peaks[0, 0]) - left, int(spot.peaks[0, 1]) - top
    values, seen = smoothed[crop], None if picture.seen is None else picture.seen[crop]
    peak = float(values[row, column])
    sets = tuple(level_set_around(values, (column, row), t * peak, seen) for t in NESTED_ISOVALUES)
    # A lower, separate bump may hang on below the mask's pixels: then the isophote is not the spot's own.
    leaks = sets[0] is not None and np.count_nonzero(sets[0].inside) > LEAK * spot.area_px + LEAK_PX
    return none if leaks else sets


def _fit(isophotes: list[tuple[LevelSet | None, ...]]) -> list[list[_Contour]]:
    """Fit ellipses to the isophotes of each spot, outwards in, up to the first that is open or no ellipse."""
    contours: list[list[Array]] = []
    for sets in isophotes:
        closed = [each for each in sets if each is not None]
        traced = crossings(closed) if closed else None
        contours.append([] if traced is None else traced.each(traced.points))
    conics = iter(fit_ellipses([points for each in contours for points in each]))
    fits: list[list[_Contour]] = []
    for sets, each in zip(isophotes, contours, strict=True):
        points = iter(each)
        pairs = [None if part is None else (next(points), next(conics)) for part in sets]
        fitted: list[_Contour] = []
        for pair in pairs:
            if pair is None or isinstance(pair[1], Failure):
                break
            fitted.append((pair[0], pair[1]))
        fits.append(fitted)
    return fits


def _kind(one: Measured) -> Kind:
    """Return the kind of a spot: the first reason against an isolated highlight."""
    allowed = RESIDUAL_CLIPPED if one.white_px >= MIN_CLIPPED_PX else RESIDUAL
    fine = one.residual is not None and one.residual <= allowed and one.wander is not None and one.wander <= WANDER
    # One ellipse is one highlight, whatever the outline of its clipped pixels.
    if len(one.spot.peaks) > 1 and not (one.spot.melted and fine and one.has_shape):
        return Kind.CLUSTER
    if one.at_border:
        return Kind.BORDER
    if one.tint < TINT:
        return Kind.INTER_REFLECTION
    if one.spot.touches or one.half is None:
        return Kind.MERGED
    if one.has_shape and one.axis_ratio is not None and one.axis_ratio < LEAST_AXIS_RATIO:
        return Kind.ELONGATED
    if one.has_shape and not fine:
        return Kind.MERGED
    if one.clutter > CLUTTER:
        return Kind.UNCLEAR
    if one.clipped_px >= LEAST_CLIPPED_PX and one.clipped_px >= CLIPPED_SHARE * one.spot.area_px:
        return Kind.CLIPPED
    return Kind.ISOLATED if one.has_shape else Kind.SMALL


def _is_pale(one: Measured, kind: Kind, longer_side_px: int) -> bool:
    """Return whether a spot that has no highlight's shape is pale tissue."""
    area = one.spot.area_px
    long = one.has_shape and one.axis_ratio is not None and one.axis_ratio < ROUND
    if not long and kind in (*SINGLE, Kind.UNCLEAR):
        return False
    narrow = 2 * np.sqrt(area / np.pi) / longer_side_px < WIDEST * NEIGHBOURHOOD / BLOCKS
    glaring = one.white_px >= GLARING * area and (narrow or one.clipped_px >= CLIPPED_CORE * area)
    return one.surround > (PALE_WIDE if area >= WIDE_PX else PALE) and not glaring


def _highlight(one: Measured, kind: Kind) -> Highlight:
    """Return the highlight of a spot."""
    spot = one.spot
    column, row = (int(v) for v in spot.peaks[0])
    return Highlight(
        Region(one.box, (column, row), spot.value), kind, spot.area_px, one.axis_ratio, one.residual,
        one.wander, one.tint, one.clutter, _outline(one), spot.peaks if kind is Kind.CLUSTER else spot.peaks[:1],
        one.clipped_px / spot.area_px,
    )  # fmt: skip


def _outline(one: Measured) -> Array:
    """Return the isophote at half height, or the border of the pixels."""
    if one.half is None:
        return border_of(one.spot.mask) + one.spot.corner
    return one.half.polygon + PIXEL_CENTRE + one.box[:2]


def border_of(mask: Mask) -> Array:
    """Return the border of a mask's largest part along the edges of its pixels, closed, shape (N, 2)."""
    # Thrice as fine, so that the contour, which runs through pixels, lies within a third of one.
    fine = np.kron(mask, np.ones((3, 3), dtype=bool)).astype(np.uint8)
    contours, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=cv2.contourArea)[:, 0]
    corners = np.rint((contour + 0.5) / 3)
    corners = np.concatenate([corners, corners[:1]])
    return corners[np.append(True, (corners[1:] != corners[:-1]).any(axis=1))]


def _at_border(spot: SpecularSpot, picture: ColourPicture) -> bool:
    """Return whether the picture's edge or the view's border may cut a spot."""
    (x, y), (height, width), seen = spot.corner, spot.mask.shape, picture.inside
    if x <= 0 or y <= 0 or x + width >= seen.shape[1] or y + height >= seen.shape[0]:
        return True
    left, top = max(x - REACH_PX, 0), max(y - REACH_PX, 0)
    outside = ~seen[top : y + height + REACH_PX, left : x + width + REACH_PX]
    if not outside.any():
        return False
    spot_mask = np.zeros(outside.shape, dtype=bool)
    spot_mask[y - top : y - top + height, x - left : x - left + width] = spot.mask
    return bool(dilated(spot_mask, REACH_PX)[outside].any())


def edge_step(spot: SpecularSpot, picture: ColourPicture, bright: Mask) -> float:
    """Return the largest step of all light between opposite sectors of the ring around a spot, over the spot's light.

    A highlight's light stands on that of the tissue under it. Where that ends, at the edge of a fold before a dark
    background or of a shadow, sharpening, coding and mixed pixels leave light that the tissue's colour does not
    explain: a small part of the step beside it.
    """
    (x, y), (height, width), radius = spot.corner, spot.mask.shape, np.sqrt(spot.area_px / np.pi)
    near, far = max(int(EDGE_NEAR * radius), 1), max(int(FOOT_REACH * radius), REACH_PX) + 2
    left, top = max(x - far, 0), max(y - far, 0)
    crop = np.s_[top : y + height + far, left : x + width + far]
    own = np.zeros(picture.inside[crop].shape, dtype=bool)
    own[y - top : y - top + height, x - left : x - left + width] = spot.mask
    ring = dilated(own, far) & ~dilated(own, near) & picture.inside[crop] & ~dilated(bright[crop] & ~own, REACH_PX)
    rows, columns = np.nonzero(ring)
    middle = np.argwhere(own).mean(axis=0)
    turns = np.arctan2(rows - middle[0], columns - middle[1]) / (2 * np.pi)
    sector = np.floor(EDGE_SECTORS * turns).astype(np.intp) % EDGE_SECTORS
    count = np.bincount(sector, minlength=EDGE_SECTORS)
    light = np.bincount(sector, mean_channel(picture.linear[crop])[ring], EDGE_SECTORS) / np.maximum(count, 1)
    both = (count > 0) & (np.roll(count, EDGE_SECTORS // 2) > 0)
    return float(np.abs(light - np.roll(light, EDGE_SECTORS // 2)).max(where=both, initial=0.0)) / spot.value


def _shape(fits: list[_Contour]) -> tuple[float | None, float | None, float | None]:
    """Return axis ratio, residual and wander (see `Highlight`); None where the ellipse at half height is missing."""
    if not fits:
        return None, None, None
    residuals = [float(np.sqrt(np.mean((conic.relative_radii(points) - 1) ** 2))) for points, conic in fits]
    shapes = [conic.centre_and_matrix for _, conic in fits]
    low, high = np.linalg.eigvalsh(shapes[0][1])
    wander = max(float(np.hypot(*(centre - shapes[0][0]))) for centre, _ in shapes) * (low * high) ** 0.25
    return float(np.sqrt(low / high)), float(np.mean(residuals)), float(wander)


def _around(spot: SpecularSpot, box: Box, picture: ColourPicture, bright: Mask) -> tuple[float, float, float]:
    """Return tint and clutter of a highlight (see `Highlight`), and the light of its surroundings over its own.

    The channels are ranked by the tissue around it.
    """
    x, y, width, height = box
    crop = np.s_[y : y + height, x : x + width]
    values, specular, visible = picture.linear[crop], picture.light.specular[crop], picture.inside[crop]
    # surroundings: away from all highlights, inside the view
    shining = bright[crop] | (specular > HIGHLIGHT_ISOVALUE * spot.value)
    around = visible & ~dilated(shining, REACH_PX)
    if np.count_nonzero(around) < MIN_AREA_PX:
        return 1.0, 0.0, 0.0
    # The foot of a wide highlight reaches farther, and is no clutter.
    reach = min(int(FOOT_REACH * np.sqrt(spot.area_px / np.pi)), FARTHEST_PX)
    far = visible & ~dilated(shining, max(reach, REACH_PX))
    far = far if np.count_nonzero(far) >= MIN_AREA_PX else around
    clutter = _ranked(specular[far], CLUTTER_SHARE) / spot.value
    surroundings = values[around]
    tissue = _medians(surroundings)
    spot_light = _medians(picture.linear[spot.crop][spot.mask])
    brighter = _ranked(mean_channel(surroundings[None])[0], PALE_SHARE)
    surround = brighter / max(float(spot_light.mean()), 1e-6)
    # gain of each channel, on the rim: channels near full scale have lost it
    shown = visible & (specular >= 0.3 * spot.value) & (brightest_channel(values) < UNCLIPPED)
    if np.count_nonzero(shown) < MIN_AREA_PX:
        return 1.0, clutter, surround
    gain = values[shown].mean(axis=0) - tissue
    weakest, strongest = float(gain[tissue.argmin()]), float(gain[tissue.argmax()])
    return (min(weakest / strongest, 1.0) if strongest > 0 else 1.0), clutter, surround


def _medians(values: Image) -> Image:
    """Return the median of each channel of some pixels, shape (n, 3), as `np.median` does; faster."""
    return np.array([median(channel) for channel in values.T.copy()])


def _ranked(values: Image, share: float) -> float:
    """Return the value that a share of the values, shape (n,), does not exceed."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])
