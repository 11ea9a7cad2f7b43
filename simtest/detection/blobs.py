"""Split highlight pixels into highlights and classify them by the elliptic-shape prior.

Where the normal bisects light and camera the isophotes are nested ellipses with a common centre (theory.md, section 3,
item 3). Highlights that a border cuts, streaks, merged ones, and light that was reflected by tissue before are other
kinds.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection.light_split import SplitLight
from simtest.detection.regions import MARGIN_PX, Region
from simtest.errors import Failure
from simtest.geometry import Array, FittedConic, Image, Mask, fit_ellipses, smooth
from simtest.geometry.level_sets import LevelSet, crossings, level_set_around

Box = tuple[int, int, int, int]

MIN_AREA_PX = 4
"""Fewer pixels are a speck."""

MIN_HALF_HEIGHT_PX = 3
"""Least number of pixels above half height that determine an ellipse, by interpolation between them."""

SMOOTHING_PX = 0.7
"""Smoothing before the shape is measured; a wider one makes any small blob an ellipse."""

NESTED_ISOVALUES = (0.5, 0.65, 0.8)
"""Isophotes whose ellipses are compared."""

RESIDUAL = 0.09
"""Largest RMS distance of an isolated highlight's isophote from its ellipse, as a share of its radius."""

RESIDUAL_CLIPPED = 0.16
"""The same where the sensor is clipped: the isophotes are then low ones of the true lobe, far from the peak."""

WANDER = 0.25
"""Largest distance between the centres of the nested ellipses, as a share of the radius at half height."""

LEAST_AXIS_RATIO = 0.3
"""A longer highlight is a streak: abs(1 + d k) differs so much between its axes that one of them is near 0."""

MIN_CLIPPED_PX = 12
"""With so many clipped pixels above half height, a highlight counts as clipped."""

TOP = 0.8
"""Separate parts of a highlight above this share of its peak are peaks of their own."""

TINT = 0.4
"""Light mirrored by the surface is grey. Where the weakest channel gains less than this share of the strongest one's
gain, the light was reflected by tissue before."""

UNCLIPPED = 0.85
"""Channels above this share of full scale may be partly clipped."""

CLUTTER_PERCENTILE = 90.0
CLUTTER = 0.2
"""Largest specular light, over the peak's, of nine tenths of the surroundings: instruments, pale folds and glistening
patches have more."""

LEAST_CONTRAST = 0.1
"""Least specular light at the peak of an isolated highlight, share of full scale."""

EDGE_PX = 3
"""The picture's edge may cut a highlight within this distance."""

_WIDE = np.ones((7, 7), dtype=np.uint8)


class Kind(StrEnum):
    """Kinds of highlights; only isolated ones carry one normal."""

    ISOLATED = "isolated"
    ELONGATED = "elongated"
    MERGED = "merged"
    BORDER = "border"
    INTER_REFLECTION = "inter_reflection"
    SMALL = "small"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Highlight:
    """A highlight of a colour frame.

    Parameters
    ----------
    region : Region
        Region of interest; its contrast is the specular light at the peak, share of full scale.
    kind : Kind
        Its kind.
    score : float
        In [0, 1]: likeness of shape, colour and height to an isolated highlight's.
    area_px : int
        Pixels above half of its peak.
    axis_ratio, residual, wander : float or None
        Of its ellipse at half height; RMS distance from it, and largest distance between the nested ellipses' centres,
        as shares of its radius; None where no ellipse fits.
    tint : float
        Gain of the weakest channel over the tissue around, over that of the strongest: 1 for grey light.
    clutter : float
        Specular light of the surroundings, over the peak's.
    outline : ndarray, shape (N, 2)
        Its isophote at half height, px, closed; empty where it does not close.
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

    @property
    def is_isolated(self) -> bool:
        """Whether it may carry one normal."""
        return self.kind is Kind.ISOLATED


@dataclass(frozen=True)
class _Peak:
    """A peak with its isophotes, in a crop of the frame; isophotes that do not close are None."""

    pixel: tuple[int, int]
    value: float
    sets: tuple[LevelSet | None, ...]
    corner: tuple[int, int]
    at_border: bool
    several: bool
    clipped: bool
    area_px: int


def highlights_of(
    mask: Mask, light: SplitLight, linear: Image, clipped: Mask, seen: Mask | None = None
) -> list[Highlight]:
    """Find and classify the highlights among the pixels of a mask, shape (H, W), the brightest first.

    `linear` is the frame, shape (H, W, 3), `clipped` where a channel is clipped, `seen` the view, both (H, W).
    """
    # peaks of each connected part
    smoothed = smooth(light.specular, SMOOTHING_PX, seen)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    found: list[_Peak] = []
    for label in range(1, count):
        x, y, width, height, area = (int(v) for v in stats[label])
        if area >= MIN_AREA_PX:
            inside = labels[y : y + height, x : x + width] == label
            found += _peaks(smoothed, inside, (x, y, width, height), clipped, seen)
    # ellipses of all isophotes at once, then the kinds
    fits = _fit([part for peak in found for part in peak.sets])
    step = len(NESTED_ISOVALUES)
    made = [_classified(peak, fits[i * step : (i + 1) * step], linear, mask, light) for i, peak in enumerate(found)]
    order = sorted(range(len(found)), key=lambda i: -found[i].value)
    return [made[i] for i in order]


def _peaks(smoothed: Image, inside: Mask, box: Box, clipped: Mask, seen: Mask | None) -> list[_Peak]:
    """Find the peaks of connected pixels whose half-height isophote holds no higher one, the brightest first."""
    # a crop that holds the isophotes
    x, y, width, height = box
    left, top = max(x - width - MARGIN_PX, 0), max(y - height - MARGIN_PX, 0)
    crop = np.s_[top : y + 2 * height + MARGIN_PX, left : x + 2 * width + MARGIN_PX]
    values = smoothed[crop]
    visible = None if seen is None else seen[crop]
    here = np.zeros(values.shape, dtype=bool)
    here[y - top : y - top + height, x - left : x - left + width] = inside
    # candidates: local maxima
    maxima = here & (values >= cv2.dilate(values, np.ones((3, 3), np.uint8)))
    rows, columns = np.nonzero(maxima)
    taken, found = np.zeros(values.shape, dtype=bool), []
    for i in np.argsort(-values[rows, columns], kind="stable"):
        row, column = int(rows[i]), int(columns[i])
        if taken[row, column]:
            continue
        region = _half_height(values, column, row)
        higher = bool((taken & region).any())
        taken |= region
        if not higher:
            peak = _traced(values, (column, row), (left, top), region, (clipped[crop], visible))
            found.append(peak if peak.sets[0] is not None else _bordering(peak, region, visible, smoothed.shape))
    return found


def _half_height(values: Image, column: int, row: int) -> Mask:
    """Return the connected pixels above half height."""
    marks = (values >= HIGHLIGHT_ISOVALUE * values[row, column]).astype(np.uint8)
    cv2.floodFill(marks, None, (column, row), 2, flags=4)
    return np.asarray(marks == 2)


def _traced(
    values: Image, pixel: tuple[int, int], corner: tuple[int, int], region: Mask, masks: tuple[Mask, Mask | None]
) -> _Peak:
    """Trace a peak's isophotes."""
    column, row = pixel
    clipped, visible = masks
    value = float(values[row, column])
    sets = tuple(level_set_around(values, pixel, t * value, visible) for t in NESTED_ISOVALUES)
    # several peaks, or a clipped plateau
    count, _, stats, _ = cv2.connectedComponentsWithStats(((values >= TOP * value) & region).astype(np.uint8))
    several = int(np.count_nonzero(stats[1:count, cv2.CC_STAT_AREA] >= 2)) > 1
    in_frame = (column + corner[0], row + corner[1])
    flat = int(np.count_nonzero(clipped & region)) >= MIN_CLIPPED_PX
    return _Peak(in_frame, value, sets, corner, False, several, flat, int(np.count_nonzero(region)))


def _bordering(peak: _Peak, region: Mask, visible: Mask | None, shape: tuple[int, ...]) -> _Peak:
    """Mark a peak whose open isophote the view's border cuts; else it runs into other bright tissue."""
    rows, columns = np.nonzero(region)
    x, y = columns + peak.corner[0], rows + peak.corner[1]
    edge = bool((x == 0).any() or (y == 0).any() or (x == shape[1] - 1).any() or (y == shape[0] - 1).any())
    cut = visible is not None and bool((cv2.dilate(region.astype(np.uint8), _WIDE) > 0)[~visible].any())
    return replace(peak, at_border=edge or cut)


def _fit(sets: list[LevelSet | None]) -> list[FittedConic | None]:
    """Fit ellipses to the borders of level sets; None where there is none or no ellipse fits."""
    contours = [crossings([part]).points for part in sets if part is not None]
    conics = fit_ellipses(contours)
    fitted = iter(range(len(contours)))
    made: list[FittedConic | None] = []
    for part in sets:
        conic = None if part is None else conics[next(fitted)]
        made.append(None if isinstance(conic, Failure) else conic)
    return made


def _classified(peak: _Peak, fits: list[FittedConic | None], linear: Image, mask: Mask, light: SplitLight) -> Highlight:
    """Return the highlight of a peak with its kind and score."""
    # measurements
    outline, box = _outline(peak, light.specular.shape)
    axis_ratio, residual, wander = _shape(peak, fits)
    tint, clutter = _around(peak, box, linear, mask, light)
    # kind: the first reason against an isolated highlight
    allowed = RESIDUAL_CLIPPED if peak.clipped else RESIDUAL
    fine = residual is not None and residual <= allowed and wander is not None and wander <= WANDER
    long = axis_ratio is not None and axis_ratio < LEAST_AXIS_RATIO
    if peak.at_border or _near_edge(outline, light.specular.shape):
        kind = Kind.BORDER
    elif tint < TINT:
        kind = Kind.INTER_REFLECTION
    elif peak.area_px < MIN_HALF_HEIGHT_PX:
        kind = Kind.SMALL
    elif peak.several or not (fine or long):
        kind = Kind.MERGED
    elif long:
        kind = Kind.ELONGATED
    elif clutter > CLUTTER or peak.value < LEAST_CONTRAST:
        kind = Kind.UNCLEAR
    else:
        kind = Kind.ISOLATED
    # score
    score = 0.0
    if axis_ratio is not None and residual is not None and wander is not None:
        height = peak.value / (peak.value + max(10 * light.noise, 1e-6))
        score = float(
            np.exp(-((residual / RESIDUAL) ** 2 + (wander / WANDER) ** 2) / 4) * min(max(tint, 0), 1) * height
        )
    region = Region(box, peak.pixel, peak.value)
    return Highlight(region, kind, round(score, 4), peak.area_px, axis_ratio, residual, wander, tint, clutter, outline)


def _outline(peak: _Peak, shape: tuple[int, ...]) -> tuple[Array, Box]:
    """Return the isophote at half height as a polygon, and the region of interest around it."""
    half = peak.sets[0]
    if half is None:
        outline = np.empty((0, 2))
        x, y = peak.pixel
        reach = int(np.sqrt(peak.area_px)) + MARGIN_PX
        x0, y0, x1, y1 = x - reach, y - reach, x + reach + 1, y + reach + 1
    else:
        outline = half.polygon() + PIXEL_CENTRE + peak.corner
        rows, columns = half.inside.shape
        x, y = half.corner[0] + peak.corner[0], half.corner[1] + peak.corner[1]
        x0, x1 = x - columns // 2 - MARGIN_PX, x + columns + columns // 2 + MARGIN_PX
        y0, y1 = y - rows // 2 - MARGIN_PX, y + rows + rows // 2 + MARGIN_PX
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])
    return outline, (x0, y0, x1 - x0, y1 - y0)


def _near_edge(outline: Array, shape: tuple[int, ...]) -> bool:
    """Return whether an isophote is so near to the picture's edge that it may be cut there."""
    edge = [shape[1] - EDGE_PX, shape[0] - EDGE_PX]
    return bool((outline < EDGE_PX).any() or (outline > edge).any())


def _shape(peak: _Peak, fits: list[FittedConic | None]) -> tuple[float | None, float | None, float | None]:
    """Return axis ratio, residual and wander (see `Highlight`); None where the ellipse at half height is missing."""
    half, contour = fits[0], peak.sets[0]
    if half is None or contour is None:
        return None, None, None
    # ellipses outwards in, up to the first that is missing
    centres, residuals = [], []
    for conic, part in zip(fits, peak.sets, strict=True):
        if conic is None or part is None:
            break
        away = conic.relative_radii(crossings([part]).points) - 1
        centres.append(conic.centre_and_matrix()[0])
        residuals.append(float(np.sqrt(np.mean(away**2))))
    low, high = np.linalg.eigvalsh(half.centre_and_matrix()[1])
    wander = max(float(np.hypot(*(centre - centres[0]))) for centre in centres) * (low * high) ** 0.25
    return float(np.sqrt(low / high)), float(np.mean(residuals)), float(wander)


def _around(peak: _Peak, box: Box, linear: Image, mask: Mask, light: SplitLight) -> tuple[float, float]:
    """Return tint and clutter of a highlight (see `Highlight`); the channels are ranked by the tissue around it."""
    x, y, width, height = box
    crop = np.s_[y : y + height, x : x + width]
    values, specular = linear[crop], light.specular[crop]
    # surroundings: away from all highlights
    bright = mask[crop] | (specular > HIGHLIGHT_ISOVALUE * peak.value)
    around = cv2.dilate(bright.astype(np.uint8), _WIDE) == 0
    if np.count_nonzero(around) < MIN_AREA_PX:
        return 1.0, 0.0
    clutter = float(np.percentile(specular[around], CLUTTER_PERCENTILE)) / peak.value
    # gain of each channel, on the rim: channels near full scale have lost it
    shown = (specular >= 0.3 * peak.value) & (values.max(axis=2) < UNCLIPPED)
    if np.count_nonzero(shown) < MIN_AREA_PX:
        return 1.0, clutter
    tissue = np.median(values[around], axis=0)
    gain = values[shown].mean(axis=0) - tissue
    weakest, strongest = float(gain[tissue.argmin()]), float(gain[tissue.argmax()])
    return (min(weakest / strongest, 1.0) if strongest > 0 else 1.0), clutter
