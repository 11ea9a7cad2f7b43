"""Classify the spots of a frame by the elliptic-shape prior.

Where the normal bisects light and camera the isophotes are nested ellipses with a common centre (theory.md, section 3,
item 3). Highlights that a border cuts, streaks, clusters, and light that was reflected by tissue before are other
kinds.
"""

from dataclasses import dataclass, field
from enum import StrEnum

import cv2
import numpy as np

from simtest.calibration.calibration import brightest_channel, mean_channel
from simtest.calibration.frame import median
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection.light_split import BLOCKS, NEIGHBOURHOOD, SplitLight
from simtest.detection.regions import MARGIN_PX, Region
from simtest.detection.spots import Spot
from simtest.errors import Failure
from simtest.geometry import Array, FittedConic, Image, Mask, fit_ellipses
from simtest.geometry.level_sets import LevelSet, crossings, level_set_around
from simtest.runtime.arrays import Index, short_repr

Box = tuple[int, int, int, int]
_Fitted = tuple[Array, FittedConic]
"""An isophote's points and its ellipse."""

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

_WIDE = np.ones((7, 7), dtype=np.uint8)


class Kind(StrEnum):
    """Kinds of highlights; isolated, clipped and small ones may carry one normal."""

    ISOLATED = "isolated"
    CLIPPED = "clipped"
    SMALL = "small"
    CLUSTER = "cluster"
    ELONGATED = "elongated"
    MERGED = "merged"
    BORDER = "border"
    INTER_REFLECTION = "inter_reflection"
    UNCLEAR = "unclear"


SINGLE = frozenset({Kind.ISOLATED, Kind.CLIPPED, Kind.SMALL})
"""Kinds that may carry one normal."""


@dataclass(frozen=True)
class Highlight:
    """A highlight of a colour frame, or several that touch.

    Parameters
    ----------
    region : Region
        Region of interest; its contrast is the specular light at the peak, share of full scale.
    kind : Kind
        Its kind.
    score : float
        In [0, 1]: likeness of shape, colour and height to an isolated highlight's.
    area_px : int
        Pixels above half of its peak, a cluster's above half of its peaks and the saddles between them.
    axis_ratio, residual, wander : float or None
        Of its ellipse at half height; RMS distance from it, and largest distance between the nested ellipses' centres,
        as shares of its radius; None where no ellipse fits.
    tint : float
        Gain of the weakest channel over the tissue around, over that of the strongest: 1 for grey light.
    clutter : float
        Specular light of the surroundings, over the peak's.
    outline : ndarray, shape (N, 2)
        Its isophote at half height, px, closed; the border of its pixels where that is open or holds other highlights.
    peaks : ndarray of int, shape (P, 2)
        Column and row of each highlight in it, the brightest first; one but for clusters.
    clipped : float
        Share of its pixels that are clipped.
    dim : bool
        Whether it is resolved and darker than clipped highlights of the frame: the normal may only come near the
        bisector there (theory.md 7.1b).
    """

    region: Region
    kind: Kind
    score: float
    area_px: int
    axis_ratio: float | None
    residual: float | None
    wander: float | None
    tint: float
    clutter: float
    outline: Array
    peaks: Index = field(default_factory=lambda: np.empty((0, 2), dtype=np.intp))
    clipped: float = 0.0
    dim: bool = False

    __repr__ = short_repr

    @property
    def is_isolated(self) -> bool:
        """Whether it may carry one normal."""
        return self.kind in SINGLE


@dataclass(frozen=True)
class _Traced:
    """A spot with its isophotes, in a crop of the frame; isophotes that do not close are None."""

    spot: Spot
    sets: tuple[LevelSet | None, ...]
    corner: tuple[int, int]
    at_border: bool
    clipped_px: int
    white_px: int


def classify(
    spots: list[Spot], smoothed: Image, light: SplitLight, linear: Image, mask: Mask, clipped: Mask,
    white: Mask, seen: Mask | None = None,
) -> list[Highlight | None]:  # fmt: skip
    """Classify spots; None where one is pale tissue.

    Parameters
    ----------
    spots : list of Spot
        Of the same frame.
    smoothed : ndarray, shape (H, W)
        Specular light, smoothed.
    light : SplitLight
        The frame's two parts.
    linear : ndarray, shape (H, W, 3)
        The frame.
    mask : ndarray of bool, shape (H, W)
        Pixels that show a highlight.
    clipped : ndarray of bool, shape (H, W)
        Where all channels are clipped.
    white : ndarray of bool, shape (H, W)
        Where they are nearly so.
    seen : ndarray of bool, shape (H, W), optional
        The view; default everywhere.
    """
    traced = [_traced(spot, smoothed, (clipped, white), seen) for spot in spots]
    # ellipses of all isophotes at once
    fits = _fit(traced)
    return [_classified(one, fitted, linear, mask, light, seen) for one, fitted in zip(traced, fits, strict=True)]


def _traced(spot: Spot, smoothed: Image, full: tuple[Mask, Mask], seen: Mask | None) -> _Traced:
    """Trace a spot's isophotes; a cluster and a shoulder have none of their own."""
    height, width = spot.mask.shape
    x, y = spot.corner
    left, top = max(x - width // 2 - MARGIN_PX, 0), max(y - height // 2 - MARGIN_PX, 0)
    crop = np.s_[top : y + height + height // 2 + MARGIN_PX, left : x + width + width // 2 + MARGIN_PX]
    visible = None if seen is None else seen[crop]
    none: tuple[LevelSet | None, ...] = (None,) * len(NESTED_ISOVALUES)
    sets = none
    if (len(spot.peaks) == 1 or spot.melted) and not spot.touches:
        column, row = int(spot.peaks[0, 0]) - left, int(spot.peaks[0, 1]) - top
        peak = float(smoothed[crop][row, column])
        sets = tuple(level_set_around(smoothed[crop], (column, row), t * peak, visible) for t in NESTED_ISOVALUES)
        # A lower, separate bump may hang on below the mask's pixels: then the isophote is not the spot's own.
        if sets[0] is not None and np.count_nonzero(sets[0].inside) > LEAK * spot.area_px + LEAK_PX:
            sets = none
    clipped, white = (int(np.count_nonzero(part[spot.crop] & spot.mask)) for part in full)
    return _Traced(spot, sets, (left, top), _at_border(spot, smoothed.shape, seen), clipped, white)


def _fit(traced: list[_Traced]) -> list[list[_Fitted]]:
    """Fit ellipses to the isophotes of each spot, outwards in, up to the first that is open or no ellipse."""
    contours: list[list[Array]] = []
    for one in traced:
        closed = [part for part in one.sets if part is not None]
        found = crossings(closed) if closed else None
        contours.append([] if found is None else found.each(found.points))
    conics = iter(fit_ellipses([points for each in contours for points in each]))
    fits: list[list[_Fitted]] = []
    for one, each in zip(traced, contours, strict=True):
        points = iter(each)
        fitted = [None if part is None else (next(points), next(conics)) for part in one.sets]
        made: list[_Fitted] = []
        for pair in fitted:
            if pair is None or isinstance(pair[1], Failure):
                break
            made.append((pair[0], pair[1]))
        fits.append(made)
    return fits


def _classified(
    one: _Traced, fits: list[_Fitted], linear: Image, mask: Mask, light: SplitLight, seen: Mask | None
) -> Highlight | None:
    """Return the highlight of a spot with its kind and score; None where it is pale tissue."""
    spot, area = one.spot, one.spot.area_px
    # measurements
    outline, box = _outline(one, light.specular.shape)
    axis_ratio, residual, wander = _shape(fits)
    tint, clutter, surround = _around(spot, box, linear, mask, light, seen)
    kind = _kind(one, axis_ratio, residual, wander, tint, clutter)
    long = area >= MIN_SHAPE_PX and axis_ratio is not None and axis_ratio < ROUND
    if long or kind not in (*SINGLE, Kind.UNCLEAR):
        wide = area >= WIDE_PX
        across = 2 * np.sqrt(area / np.pi) / max(light.specular.shape)
        glaring = one.white_px >= GLARING * area and (
            across < WIDEST * NEIGHBOURHOOD / BLOCKS or one.clipped_px >= CLIPPED_CORE * area
        )
        if surround > (PALE_WIDE if wide else PALE) and not glaring:
            return None
    # score
    score = 0.0
    if axis_ratio is not None and residual is not None and wander is not None:
        height = spot.value / (spot.value + max(10 * light.noise, 1e-6))
        score = float(
            np.exp(-((residual / RESIDUAL) ** 2 + (wander / WANDER) ** 2) / 4) * min(max(tint, 0), 1) * height
        )
    column, row = (int(v) for v in spot.peaks[0])
    return Highlight(
        Region(box, (column, row), spot.value), kind, round(score, 4), area, axis_ratio, residual, wander, tint,
        clutter, outline, spot.peaks if kind is Kind.CLUSTER else spot.peaks[:1], one.clipped_px / area,
    )  # fmt: skip


def _kind(
    one: _Traced, axis_ratio: float | None, residual: float | None, wander: float | None, tint: float, clutter: float
) -> Kind:
    """Return the kind of a spot: the first reason against an isolated highlight."""
    area, flat = one.spot.area_px, one.clipped_px
    allowed = RESIDUAL_CLIPPED if one.white_px >= MIN_CLIPPED_PX else RESIDUAL
    fine = residual is not None and residual <= allowed and wander is not None and wander <= WANDER
    small = area < MIN_SHAPE_PX
    # One ellipse is one highlight, whatever the outline of its clipped pixels.
    if len(one.spot.peaks) > 1 and not (one.spot.melted and fine and not small):
        return Kind.CLUSTER
    if one.at_border:
        return Kind.BORDER
    if tint < TINT:
        return Kind.INTER_REFLECTION
    if one.spot.touches or one.sets[0] is None:
        return Kind.MERGED
    if not small and axis_ratio is not None and axis_ratio < LEAST_AXIS_RATIO:
        return Kind.ELONGATED
    if not (small or fine):
        return Kind.MERGED
    if clutter > CLUTTER:
        return Kind.UNCLEAR
    if flat >= LEAST_CLIPPED_PX and flat >= CLIPPED_SHARE * area:
        return Kind.CLIPPED
    return Kind.SMALL if small else Kind.ISOLATED


def _outline(one: _Traced, shape: tuple[int, ...]) -> tuple[Array, Box]:
    """Return the isophote at half height, or the border of the pixels, and the region of interest around them."""
    half, (x, y), (rows, columns) = one.sets[0], one.spot.corner, one.spot.mask.shape
    own = border_of(one.spot.mask) + one.spot.corner if half is None else half.polygon + PIXEL_CENTRE + one.corner
    x0, x1 = x - columns // 2 - MARGIN_PX, x + columns + columns // 2 + MARGIN_PX
    y0, y1 = y - rows // 2 - MARGIN_PX, y + rows + rows // 2 + MARGIN_PX
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])
    return own, (x0, y0, x1 - x0, y1 - y0)


def border_of(mask: Mask) -> Array:
    """Return the border of a mask's largest part along the edges of its pixels, closed, shape (N, 2)."""
    # Thrice as fine, so that the contour, which runs through pixels, lies within a third of one.
    fine = np.kron(mask, np.ones((3, 3), dtype=bool)).astype(np.uint8)
    contours, _ = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=cv2.contourArea)[:, 0]
    corners = np.rint((contour + 0.5) / 3)
    corners = np.concatenate([corners, corners[:1]])
    return corners[np.append(True, (corners[1:] != corners[:-1]).any(axis=1))]


def _at_border(spot: Spot, shape: tuple[int, ...], seen: Mask | None) -> bool:
    """Return whether the picture's edge or the view's border may cut a spot."""
    (x, y), (height, width) = spot.corner, spot.mask.shape
    if x <= 0 or y <= 0 or x + width >= shape[1] or y + height >= shape[0]:
        return True
    if seen is None:
        return False
    reach = _WIDE.shape[0] // 2
    left, top = max(x - reach, 0), max(y - reach, 0)
    around = ~seen[top : y + height + reach, left : x + width + reach]
    if not around.any():
        return False
    own = np.zeros(around.shape, dtype=np.uint8)
    own[y - top : y - top + height, x - left : x - left + width] = spot.mask
    return bool((cv2.dilate(own, _WIDE) > 0)[around].any())


def _shape(fits: list[_Fitted]) -> tuple[float | None, float | None, float | None]:
    """Return axis ratio, residual and wander (see `Highlight`); None where the ellipse at half height is missing."""
    if not fits:
        return None, None, None
    residuals = [float(np.sqrt(np.mean((conic.relative_radii(points) - 1) ** 2))) for points, conic in fits]
    shapes = [conic.centre_and_matrix for _, conic in fits]
    low, high = np.linalg.eigvalsh(shapes[0][1])
    wander = max(float(np.hypot(*(centre - shapes[0][0]))) for centre, _ in shapes) * (low * high) ** 0.25
    return float(np.sqrt(low / high)), float(np.mean(residuals)), float(wander)


def _around(
    spot: Spot, box: Box, linear: Image, mask: Mask, light: SplitLight, seen: Mask | None
) -> tuple[float, float, float]:
    """Return tint and clutter of a highlight (see `Highlight`), and the light of its surroundings over its own.

    The channels are ranked by the tissue around it.
    """
    x, y, width, height = box
    crop = np.s_[y : y + height, x : x + width]
    values, specular = linear[crop], light.specular[crop]
    # surroundings: away from all highlights, inside the view
    visible = np.ones(specular.shape, dtype=bool) if seen is None else seen[crop]
    bright = mask[crop] | (specular > HIGHLIGHT_ISOVALUE * spot.value)
    around = visible & (cv2.dilate(bright.astype(np.uint8), _WIDE) == 0)
    if np.count_nonzero(around) < MIN_AREA_PX:
        return 1.0, 0.0, 0.0
    # The foot of a wide highlight reaches farther, and is no clutter.
    far, reach = around, min(int(FOOT_REACH * np.sqrt(spot.area_px / np.pi)), FARTHEST_PX)
    if reach > _WIDE.shape[0] // 2:
        far = visible & (cv2.dilate(bright.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) == 0)
        far = far if np.count_nonzero(far) >= MIN_AREA_PX else around
    clutter = _ranked(specular[far], CLUTTER_SHARE) / spot.value
    surroundings = values[around]
    tissue = _medians(surroundings)
    own = _medians(linear[spot.crop][spot.mask])
    brighter = _ranked(mean_channel(surroundings[None])[0], PALE_SHARE)
    surround = brighter / max(float(own.mean()), 1e-6)
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
