"""Splits highlight pixels into highlights and tells their kinds by the elliptic-shape prior.

Where the normal bisects light and camera the isophotes are nested ellipses with a common centre (theory.md, section 3,
item 3). What is cut by a border, long, several run together, or light that has met tissue before, is another kind.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
import numpy.typing as npt

from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.detection.light_split import SplitLight
from simtest.detection.regions import MARGIN_PX, Region
from simtest.errors import Failure
from simtest.geometry import FittedConic, fit_ellipses, smooth
from simtest.geometry.level_sets import LevelSet, crossings, level_set_around

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]
Box = tuple[int, int, int, int]

MIN_AREA_PX = 4
"""Fewer pixels are a speck."""

MIN_HALF_HEIGHT_PX = 3
"""Least pixels above half height that give an ellipse, by interpolation between them."""

SMOOTHING_PX = 0.7
"""Before the shape is judged; wider smoothing makes any small blob an ellipse."""

NESTED_ISOVALUES = (0.5, 0.65, 0.8)
"""Isophotes whose ellipses are compared."""

RESIDUAL = 0.09
"""Most that an isophote of an isolated highlight differs from its ellipse, RMS, as a share of its radius."""

RESIDUAL_CLIPPED = 0.16
"""The same where the sensor is clipped: its isophotes are low ones of the true lobe, far from the peak."""

WANDER = 0.25
"""Most that the centres of the nested ellipses lie apart, as a share of the radius at half height."""

LEAST_AXIS_RATIO = 0.3
"""A longer spot is a streak: abs(1 + d k) differs so much along its axes that one of them is near 0."""

MIN_CLIPPED_PX = 12

TOP = 0.8
"""Parts of a highlight above this share of its peak that do not hang together are peaks of their own."""

TINT = 0.4
"""Light off the surface is grey. Where the least channel gains less than this share of what the most gains, the light
has met tissue before."""


UNCLIPPED = 0.85
"""Channels above this share of full scale may be clipped in part."""

CLUTTER_PERCENTILE = 90.0
CLUTTER = 0.2
"""Most specular light, over the peak's, that nine tenths of the surroundings may show: instruments, pale folds and
glistening patches show more."""

LEAST_CONTRAST = 0.1
"""Least specular light at the peak of an isolated highlight, share of full scale."""

EDGE_PX = 3
"""A highlight so near to the picture's edge may be cut by it."""

_WIDE = np.ones((7, 7), dtype=np.uint8)


class Kind(StrEnum):
    """What a highlight is."""

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
        Where it is; its contrast is the specular light at the peak, share of full scale.
    kind : Kind
        What it is.
    score : float
        In [0, 1]: how well its shape, colour and height are those of an isolated highlight.
    area_px : int
        Pixels above half of its peak.
    axis_ratio, residual, wander : float or None
        Of its ellipse at half height; RMS distance from it, and how far the nested ellipses' centres lie apart, as
        shares of its radius; None where no ellipse fits.
    tint : float
        What the least channel gains over the tissue around, over what the most gains: 1 for grey light.
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
    outline: npt.NDArray[np.float64]

    @property
    def is_isolated(self) -> bool:
        """Whether it may carry one normal."""
        return self.kind is Kind.ISOLATED


@dataclass(frozen=True)
class _Found:
    """A peak with its isophotes, in a crop of the frame; isophotes that do not close are None."""

    peak: tuple[int, int]
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
    """Tell the highlights of a frame.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Pixels of highlights.
    light : SplitLight
        The frame's light.
    linear : ndarray of float32, shape (H, W, 3)
        The frame.
    clipped : ndarray of bool, shape (H, W)
        Where a channel is clipped.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the view; default all.

    Returns
    -------
    list of Highlight
        The brightest first.
    """
    smoothed = smooth(light.specular, SMOOTHING_PX, seen)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    found: list[_Found] = []
    for label in range(1, count):
        x, y, width, height, area = (int(v) for v in stats[label])
        if area >= MIN_AREA_PX:
            inside = labels[y : y + height, x : x + width] == label
            found += _peaks(smoothed, inside, (x, y, width, height), clipped, seen)
    fits = _fit([part for spot in found for part in spot.sets])
    step = len(NESTED_ISOVALUES)
    made = [_judge(spot, fits[i * step : (i + 1) * step], linear, mask, light) for i, spot in enumerate(found)]
    return sorted(made, key=lambda highlight: -highlight.region.contrast)


def _peaks(smoothed: Image, inside: Mask, box: Box, clipped: Mask, seen: Mask | None) -> list[_Found]:
    """Find the peaks of connected pixels whose half-height isophote holds no higher one, the brightest first."""
    x, y, width, height = box
    left, top = max(x - width - MARGIN_PX, 0), max(y - height - MARGIN_PX, 0)
    crop = np.s_[top : y + 2 * height + MARGIN_PX, left : x + 2 * width + MARGIN_PX]
    values = smoothed[crop]
    visible = None if seen is None else seen[crop]
    here = np.zeros(values.shape, dtype=bool)
    here[y - top : y - top + height, x - left : x - left + width] = inside
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
            spot = _spot(values, (column, row), (left, top), region, (clipped[crop], visible))
            found.append(spot if spot.sets[0] is not None else _bordering(spot, region, visible, smoothed.shape))
    return found


def _half_height(values: Image, column: int, row: int) -> Mask:
    marks = (values >= HIGHLIGHT_ISOVALUE * values[row, column]).astype(np.uint8)
    cv2.floodFill(marks, None, (column, row), 2, flags=4)
    return np.asarray(marks == 2)


def _spot(
    values: Image, pixel: tuple[int, int], corner: tuple[int, int], region: Mask, masks: tuple[Mask, Mask | None]
) -> _Found:
    column, row = pixel
    clipped, visible = masks
    peak = float(values[row, column])
    sets = tuple(level_set_around(values, pixel, t * peak, visible) for t in NESTED_ISOVALUES)
    count, _, stats, _ = cv2.connectedComponentsWithStats(((values >= TOP * peak) & region).astype(np.uint8))
    several = int(np.count_nonzero(stats[1:count, cv2.CC_STAT_AREA] >= 2)) > 1
    place = (column + corner[0], row + corner[1])
    flat = int(np.count_nonzero(clipped & region)) >= MIN_CLIPPED_PX
    return _Found(place, peak, sets, corner, False, several, flat, int(np.count_nonzero(region)))


def _bordering(spot: _Found, region: Mask, visible: Mask | None, shape: tuple[int, ...]) -> _Found:
    """Tell of an open isophote whether the view's border cuts it, or it runs into other bright tissue."""
    rows, columns = np.nonzero(region)
    x, y = columns + spot.corner[0], rows + spot.corner[1]
    edge = bool((x == 0).any() or (y == 0).any() or (x == shape[1] - 1).any() or (y == shape[0] - 1).any())
    cut = visible is not None and bool((cv2.dilate(region.astype(np.uint8), _WIDE) > 0)[~visible].any())
    return replace(spot, at_border=edge or cut)


def _fit(sets: list[LevelSet | None]) -> list[FittedConic | None]:
    contours = [crossings([part]).points for part in sets if part is not None]
    conics = fit_ellipses(contours)
    fitted = iter(range(len(contours)))
    made: list[FittedConic | None] = []
    for part in sets:
        conic = None if part is None else conics[next(fitted)]
        made.append(None if isinstance(conic, Failure) else conic)
    return made


def _judge(spot: _Found, fits: list[FittedConic | None], linear: Image, mask: Mask, light: SplitLight) -> Highlight:
    outline, box = _outline(spot, light.specular.shape)
    axis_ratio, residual, wander = _shape(spot, fits)
    tint, clutter = _around(spot, box, linear, mask, light)
    allowed = RESIDUAL_CLIPPED if spot.clipped else RESIDUAL
    fine = residual is not None and residual <= allowed and wander is not None and wander <= WANDER
    long = axis_ratio is not None and axis_ratio < LEAST_AXIS_RATIO
    if spot.at_border or _near_edge(outline, light.specular.shape):
        kind = Kind.BORDER
    elif tint < TINT:
        kind = Kind.INTER_REFLECTION
    elif spot.area_px < MIN_HALF_HEIGHT_PX:
        kind = Kind.SMALL
    elif spot.several or not (fine or long):
        kind = Kind.MERGED
    elif long:
        kind = Kind.ELONGATED
    elif clutter > CLUTTER or spot.value < LEAST_CONTRAST:
        kind = Kind.UNCLEAR
    else:
        kind = Kind.ISOLATED
    score = 0.0
    if axis_ratio is not None and residual is not None and wander is not None:
        height = spot.value / (spot.value + max(10 * light.noise, 1e-6))
        score = float(
            np.exp(-((residual / RESIDUAL) ** 2 + (wander / WANDER) ** 2) / 4) * min(max(tint, 0), 1) * height
        )
    region = Region(box, spot.peak, spot.value)
    return Highlight(region, kind, round(score, 4), spot.area_px, axis_ratio, residual, wander, tint, clutter, outline)


def _outline(spot: _Found, shape: tuple[int, ...]) -> tuple[npt.NDArray[np.float64], Box]:
    """Give the isophote at half height as a polygon, and the region of interest around it."""
    half = spot.sets[0]
    if half is None:
        outline = np.empty((0, 2))
        x, y = spot.peak
        reach = int(np.sqrt(spot.area_px)) + MARGIN_PX
        x0, y0, x1, y1 = x - reach, y - reach, x + reach + 1, y + reach + 1
    else:
        outline = half.polygon() + PIXEL_CENTRE + spot.corner
        rows, columns = half.inside.shape
        x, y = half.corner[0] + spot.corner[0], half.corner[1] + spot.corner[1]
        x0, x1 = x - columns // 2 - MARGIN_PX, x + columns + columns // 2 + MARGIN_PX
        y0, y1 = y - rows // 2 - MARGIN_PX, y + rows + rows // 2 + MARGIN_PX
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, shape[1]), min(y1, shape[0])
    return outline, (x0, y0, x1 - x0, y1 - y0)


def _near_edge(outline: npt.NDArray[np.float64], shape: tuple[int, ...]) -> bool:
    """Tell whether an isophote comes so near to the picture's edge that it may be cut there."""
    edge = [shape[1] - EDGE_PX, shape[0] - EDGE_PX]
    return bool((outline < EDGE_PX).any() or (outline > edge).any())


def _shape(spot: _Found, fits: list[FittedConic | None]) -> tuple[float | None, float | None, float | None]:
    """Give axis ratio, residual and wander; None where the ellipse at half height is missing."""
    half, contour = fits[0], spot.sets[0]
    if half is None or contour is None:
        return None, None, None
    centres, residuals = [], []
    for conic, part in zip(fits, spot.sets, strict=True):
        if conic is None or part is None:
            break
        centre, Q = _quadratic(conic)
        gap = crossings([part]).points - centre
        away = np.sqrt(np.einsum("ni,ij,nj->n", gap, Q, gap)) - 1
        centres.append(centre)
        residuals.append(float(np.sqrt(np.mean(away**2))))
    low, high = np.linalg.eigvalsh(_quadratic(half)[1])
    wander = max(float(np.hypot(*(centre - centres[0]))) for centre in centres) * (low * high) ** 0.25
    return float(np.sqrt(low / high)), float(np.mean(residuals)), float(wander)


def _quadratic(fitted: FittedConic) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Give centre, px, and Q of an ellipse (x - centre)^T Q (x - centre) = 1."""
    C = fitted.normalised
    centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
    level = -(C[2, 2] + C[:2, 2] @ centre)
    T = fitted.normalised_from_image
    Q = T[:2, :2].T @ C[:2, :2] @ T[:2, :2] / level
    return np.asarray(np.linalg.solve(T[:2, :2], centre - T[:2, 2])), np.asarray(Q)


def _around(spot: _Found, box: Box, linear: Image, mask: Mask, light: SplitLight) -> tuple[float, float]:
    """Give the tint of a highlight's light, and how much the specular light around it varies, over its peak.

    The tint is what the tissue's weakest channel gains over the tissue around, over what its strongest gains.
    """
    x, y, width, height = box
    crop = np.s_[y : y + height, x : x + width]
    values, specular = linear[crop], light.specular[crop]
    bright = mask[crop] | (specular > HIGHLIGHT_ISOVALUE * spot.value)
    around = cv2.dilate(bright.astype(np.uint8), _WIDE) == 0
    if np.count_nonzero(around) < MIN_AREA_PX:
        return 1.0, 0.0
    clutter = float(np.percentile(specular[around], CLUTTER_PERCENTILE)) / spot.value
    # Channels near full scale have lost their gain; the rim keeps it.
    shown = (specular >= 0.3 * spot.value) & (values.max(axis=2) < UNCLIPPED)
    if np.count_nonzero(shown) < MIN_AREA_PX:
        return 1.0, clutter
    tissue = np.median(values[around], axis=0)
    gain = values[shown].mean(axis=0) - tissue
    weakest, strongest = float(gain[tissue.argmin()]), float(gain[tissue.argmax()])
    return (min(weakest / strongest, 1.0) if strongest > 0 else 1.0), clutter
