"""True highlights of a noise-free frame (theory.md sections 6 and 7.1b).

Which of a surface's highlight points are isolated, visible highlights; which cloud each belongs to, around a highlight
point of the base; and which spots can be seen. On a relief the highlight points, glints, melt, and minima of the misfit
above 0 shine too: a visible spot may hold several glints or none. It is a local maximum of the light behind the lens
whose saddle to any brighter one is below 0.8 of it, found by another algorithm than the detector's (detection.spots):
the truth shares no code with what it judges.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration.calibration import mean_channel
from simtest.conventions import (
    DEFAULT_SMOOTHING_PX,
    HIGHLIGHT_CONTRAST_SIGMA,
    HIGHLIGHT_ISOVALUE,
    HIGHLIGHT_MIN_GAIN,
    PIXEL_CENTRE,
)
from simtest.detection import contrast, half_height_component
from simtest.detection.peaks import Component, component_above
from simtest.geometry import smooth
from simtest.geometry.patch import connected
from simtest.rendering import HighlightPoint, Session
from simtest.rendering.frames import MisfitMaps
from simtest.runtime.arrays import Array, Image, IntArray, Mask, short_repr
from simtest.runtime.files import Json

SADDLE = 0.8
"""A maximum counts if its saddle to any brighter one is below this share of it."""

LEAST_SPECULAR = 1 - SADDLE
"""So the lobe must give at least this share of the light at the maximum: the rest is no highlight."""

DARK = 1e-6
"""Light below this share of the frame's maximum is darkness."""

REACH_PX = 4.0
"""A descent that ends farther than this from all highlight points of the base belongs to none in view."""

NO_HIGHLIGHT = "no highlight in view"
SEVERAL = "holds several glints"
STREAK = f"min abs(1 + d k) at most {HIGHLIGHT_MIN_GAIN:g}"
LEAVES_FRAME = "isophote at t = 0.5 leaves the frame"
FAINT = f"peak below {HIGHLIGHT_CONTRAST_SIGMA:g} sigma"
"""Why a frame shows no isolated highlight, most often (theory.md section 6)."""

REMEDIES = {
    NO_HIGHLIGHT: "no normal in view is half-way between light and camera; look at a wall from beside the "
    "axis (in a lumen surface.view = off_axis, surface.look_ahead_mm = 5), or take a wider field of view",
    SEVERAL: "take a smoother relief (surface.relief) or a camera nearer to the wall",
    STREAK: "the wall bends about the camera; look at it from beside the axis (in a lumen surface.view = off_axis, "
    "surface.look_ahead_mm = 5)",
    LEAVES_FRAME: "take a narrower lobe (a larger reflectance.exponent, a smaller alpha) or a wider field of view",
    FAINT: "take less noise (sensor.noise_sigma) or a stronger lobe",
}
"""What to change where most frames show none for that reason."""

Pixel = tuple[int, int]
"""Row and column."""

_UNITS = {"position": "position_mm", "distance": "distance_mm"}
"""Names in files, where they are not those of the fields."""

_TRUE = (
    "light", "bp_px", "position", "normal", "direction_min", "distance", "kd_min", "kd_max", "normal_base",
    "kd_min_base", "kd_max_base", "pool", "radius_px", "cloud", "lit", "hidden", "peak_snr", "isolated", "why_not",
)  # fmt: skip
_CLOUD = ("light", "bp_px", "position", "normal_base", "distance", "kd_min_base", "kd_max_base", "lit")
_VISIBLE = (
    "peak_px", "value", "specular", "peak_snr", "area_px", "centroid_px", "axis_ratio", "whole", "light", "cloud",
    "glints",
)  # fmt: skip
"""What files hold of a highlight, of a cloud's centre and of a visible highlight."""


def _record(highlight: object, names: Sequence[str]) -> dict[str, Json]:
    """Return fields of a highlight as JSON; null stands for an empty text and for a number that is not finite."""
    record: dict[str, Json] = {}
    for name in names:
        value = getattr(highlight, name)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        elif isinstance(value, tuple):
            value = np.asarray(value).tolist()
        elif value == "" or (isinstance(value, float) and not math.isfinite(value)):
            value = None
        record[_UNITS.get(name, name)] = value
    return record


@dataclass(frozen=True, kw_only=True)
class TrueHighlight(HighlightPoint):
    """A highlight point with the verdict on whether it is a true isolated highlight.

    Parameters
    ----------
    peak_snr : float
        Peak above its surroundings, up to where the sensor clips, over the standard deviation of the noise there
        (`noise_at`); inf without noise, 0 where it has no closed isophote.
    why_not : str
        Empty for a true isolated highlight, else the first condition that it fails.
    radius_px : float
        Of the circle that has the highlight's area above half height, from its shape alone (theory.md 7.3), px; NaN
        where it was not computed.
    cloud : int or None
        Number of its cloud, an index in `RenderedView.clouds`; None where its cloud's centre is not in view.
    """

    peak_snr: float
    why_not: str
    radius_px: float = math.nan
    cloud: int | None = None

    __repr__ = short_repr

    @property
    def isolated(self) -> bool:
        """Whether it is a true isolated highlight."""
        return not self.why_not

    def to_json(self) -> dict[str, Json]:
        """Return position, normal and curvature of the fine surface and of the base, and verdict."""
        return _record(self, _TRUE)


def cloud_json(centre: HighlightPoint) -> dict[str, Json]:
    """Describe a highlight point of the base, with its normal and curvatures."""
    return _record(centre, _CLOUD)


@dataclass(frozen=True)
class VisibleHighlight:
    """A spot that can be seen.

    Parameters
    ----------
    peak_px : ndarray, shape (2,)
        Centre of its brightest pixel, px.
    value : float
        Direct light behind the lens at the peak, radiance.
    specular : float
        The part of it that comes off the lobe.
    peak_snr : float
        The specular part, up to where the sensor clips, over the noise at the peak; inf without noise.
    area_px : int
        Pixels above half of the lobe's peak, without those of brighter neighbours.
    centroid_px : ndarray, shape (2,)
        Of these pixels, weighted by the lobe's light, px.
    axis_ratio : float
        Minor over major axis of their second moments.
    whole : bool
        Whether they stay clear of the frame's border and of the view mask.
    light, cloud : int or None
        Index of the light and number of the cloud of its brightest glint, or else of the nearest lit one.
    glints : tuple of int
        Indices of the lit glints in it, the brightest first.
    instrument : int or None
        Index of the instrument on which its peak lies; it is no highlight of the surface then, and has no light, cloud
        or glints.
    """

    peak_px: Array
    value: float
    specular: float
    peak_snr: float
    area_px: int
    centroid_px: Array
    axis_ratio: float
    whole: bool
    light: int | None
    cloud: int | None
    glints: tuple[int, ...]
    instrument: int | None = None

    __repr__ = short_repr

    @property
    def radius_px(self) -> float:
        """Radius of the circle of its area, px."""
        return float(np.sqrt(self.area_px / np.pi))

    def to_json(self) -> dict[str, Json]:
        """Return the fields as JSON; the instrument only where there is one."""
        return _record(self, _VISIBLE if self.instrument is None else (*_VISIBLE, "instrument"))


@dataclass(frozen=True)
class Examined:
    """What a highlight point makes of the noise-free frame, whatever the noise.

    Row and column of the maximum that it makes, the smoothed light there, its height above its surroundings (None where
    it has no closed region of its own), why it is not isolated even if it stands above the noise (empty: it is), and
    its region above half height.
    """

    peak: Pixel
    level: float
    height: float | None
    why_not: str
    component: Component | None = None

    def clipped(self, smoothed: Image, seen: Mask | None) -> "Examined":
        """Return what it makes of light whose channels are clipped, smoothed, in the same region."""
        if self.component is None:
            return self
        level = float(smoothed[self.peak])
        return replace(self, level=level, height=contrast(smoothed, self.component, level, seen))


def examine(
    points: Sequence[HighlightPoint], light: Image, seen: Mask | None = None, single: bool = False
) -> list[Examined]:
    """Examine each highlight point in the noise-free frame.

    `light`, shape (H, W), is the noise-free radiance behind the lens, mean of the channels; `seen` the pixels inside
    the camera's view mask, default all. With `single` an isolated highlight holds one lit highlight point alone: on a
    relief, where glints melt.
    """
    # The maximum that each point makes in the frame as detectors see it, and whose it is.
    smoothed = smooth(light, DEFAULT_SMOOTHING_PX, seen)
    peaks = _peak_pixels(smoothed, points)
    owners = _owners(points, peaks)
    lit = np.array([point.bp_px for point in points if point.lit and single]).reshape(-1, 2).astype(int)
    return [
        _examined(point, smoothed, seen, peak, owners.get(peak) is point, lit)
        for point, peak in zip(points, peaks, strict=True)
    ]


def verdicts(
    points: Sequence[HighlightPoint], examined: Sequence[Examined], sigmas: Array, clip: float = math.inf
) -> list[TrueHighlight]:
    """Judge highlight points that were examined.

    `sigmas`, shape (N,), is the noise at each one's peak, radiance, 0 without noise; `clip` the radiance at which the
    sensor's values end.
    """
    highlights = []
    for point, each, sigma in zip(points, examined, sigmas.tolist(), strict=True):
        # Without a maximum of its own it has no SNR.
        snr = 0.0
        if each.height is not None:
            snr = _snr(min(each.level, clip) - min(each.level - each.height, clip), sigma)
        faint = FAINT if snr < HIGHLIGHT_CONTRAST_SIGMA else ""
        highlights.append(TrueHighlight(**vars(point), peak_snr=snr, why_not=each.why_not or faint))
    return highlights


def _snr(height: float, sigma: float) -> float:
    """Return a height over the noise, 0 without both."""
    return height / sigma if sigma > 0 else math.inf if height > 0 else 0.0


def why_none(highlights: Sequence[TrueHighlight]) -> str:
    """Return why a frame has no isolated highlight: the reason of the one that stands out most."""
    return max(highlights, key=lambda each: each.peak_snr).why_not if highlights else NO_HIGHLIGHT


def lobe_region(point: HighlightPoint, specular: Image, at_point: float) -> tuple[float, Component | None]:
    """Return the peak that a highlight point makes in the lobe's light, and the connected pixels above half of it.

    The peak is the brightest pixel uphill from the point, or the light `at_point` (`Session.lobe_at`) where that is
    more: a highlight smaller than a pixel has none that reaches half of it, and no region. `specular` is the lobe's
    noise-free light before the lens, shape (H, W).
    """
    [(row, column)] = _peak_pixels(specular, [point])
    brightest = float(specular[row, column])
    peak = max(at_point, brightest)
    level = HIGHLIGHT_ISOVALUE * peak
    return peak, component_above(specular, row, column, level) if brightest >= level > 0 else None


def _owners(points: Sequence[HighlightPoint], peaks: list[Pixel]) -> dict[Pixel, HighlightPoint]:
    """Assign each maximum of the smoothed frame to the nearest lit BP: smoothing may merge several highlights."""
    gaps = np.reshape([point.bp_px for point in points], (-1, 2)) - np.reshape(peaks, (-1, 2))[:, ::-1] - PIXEL_CENTRE
    away = np.hypot(*gaps.T).tolist()
    owners: dict[Pixel, int] = {}
    for i, (point, peak) in enumerate(zip(points, peaks, strict=True)):
        if point.lit and away[i] < away[owners.setdefault(peak, i)]:
            owners[peak] = i
    return {peak: points[i] for peak, i in owners.items()}


def _examined(
    point: HighlightPoint, smoothed: Image, seen: Mask | None, peak: Pixel, owns_peak: bool, lit: IntArray
) -> Examined:
    """Examine a highlight point, whose maximum is at a peak, by all conditions but that of noise.

    `lit` are columns and rows, shape (N, 2), of the points of which only itself may lie in its half-height region.
    """
    level = float(smoothed[peak])
    if not point.lit:
        return Examined(peak, level, None, "hidden by an instrument" if point.hidden else "in shadow")
    component = half_height_component(smoothed, *peak, seen) if owns_peak else None
    # Uphill may lead far: to another highlight, or to where the base is brightest.
    if component is None or not component.holds(point.bp_px[None]).all():
        return Examined(peak, level, None, "part of a brighter one")
    # Shape, frame, noise: in the order of theory.md section 6.
    why_not = ""
    if np.count_nonzero(component.holds(lit)) > 1:
        why_not = SEVERAL
    elif point.min_gain <= HIGHLIGHT_MIN_GAIN:
        why_not = STREAK
    elif not component.closed:
        why_not = LEAVES_FRAME
    return Examined(peak, level, contrast(smoothed, component, level, seen), why_not, component)


def _peak_pixels(smoothed: Image, points: Sequence[HighlightPoint]) -> list[Pixel]:
    """Climb from each true BP to its local maximum."""
    last = np.array(smoothed.shape) - 1
    places = np.minimum(np.array([point.bp_px for point in points]).reshape(-1, 2)[:, ::-1].astype(int), last)
    around = np.stack(np.divmod(np.arange(9), 3), axis=1) - 1
    climbing = np.arange(len(places))
    while len(climbing):
        # At the border the window holds some pixels twice, of which the first counts.
        windows = np.clip(places[climbing, None] + around, 0, last)
        steps = smoothed[windows[..., 0], windows[..., 1]].argmax(axis=1)
        reached = windows[np.arange(len(steps)), steps]
        moved = (reached != places[climbing]).any(axis=1)
        places[climbing] = reached
        climbing = climbing[moved]
    return [(row, column) for row, column in places.tolist()]


@dataclass(frozen=True)
class CloudRegions:
    """Which cloud around the base's highlight points each pixel belongs to.

    It is that to which the base's misfit descends from the pixel: `labels`, shape (L, H, W), are indices of the
    highlight points, by light, -1 where the descent leaves the view or ends at a fold. `misfit`, of the same shape, is
    the sine of the angle to the bisector, NaN outside the surface and the view mask; `lights` are those of the
    highlight points.
    """

    labels: npt.NDArray[np.int32]
    misfit: Image
    lights: tuple[int, ...]

    @classmethod
    def of(cls, session: Session, centres: Sequence[HighlightPoint]) -> "CloudRegions":
        """Follow the misfit of a session's base down to its highlight points, of all lights in view."""
        maps, lights = session.misfits(), tuple(centre.light for centre in centres)
        places = [(centre.light, *centre.bp_px.tolist()) for centre in centres]
        # Asked for again by what scores the frame
        if (last := _LAST.get(maps)) is not None and last[0] == places:
            return last[1]
        inside = slice(maps.margin, -maps.margin)
        w = maps.base[:, :, inside, inside]
        misfit = np.hypot(w[:, 0], w[:, 1])
        labels = np.full(misfit.shape, -1, dtype=np.int32)
        for light in set(lights):
            numbers = np.flatnonzero(np.array(lights) == light)
            # Where descents end, and which centre is near.
            target = _ends(misfit[light])
            bottoms = np.flatnonzero((target == np.arange(target.size)) & np.isfinite(misfit[light].ravel()))
            at = np.stack(np.divmod(bottoms, misfit.shape[2])[::-1], axis=1) + PIXEL_CENTRE
            gap = np.linalg.norm(at[:, None] - np.array([centre.bp_px for centre in centres])[numbers], axis=2)
            nearest = np.full(target.size, -1)
            nearest[bottoms] = np.where(gap.min(axis=1) < REACH_PX, numbers[gap.argmin(axis=1)], -1)
            labels[light] = nearest[target].reshape(labels.shape[1:])
        seen = session.camera.seen
        regions = cls(labels, misfit if seen is None else np.where(seen, misfit, np.nan), lights)
        _LAST[maps] = places, regions
        return regions

    def assign(self, lights: IntArray, points_px: Array) -> list[int | None]:
        """Return the cloud of each image point, shape (N, 2), px, that a light, shape (N,), makes."""
        height, width = self.labels.shape[1:]
        columns, rows = np.minimum(points_px.astype(int), [width - 1, height - 1]).T
        return [None if number < 0 else number for number in self.labels[lights, rows, columns].tolist()]

    def edges(self) -> list[float]:
        """Return the least misfit at the edge of each cloud's region.

        A region ends at the frame's border, at the view mask, where the surface ends, and next to another cloud. A
        glint lies where the base's misfit is the relief's slope, so a cloud is as good as wholly in view where the
        misfit at the edge is several slopes.
        """
        regions = np.where(np.isfinite(self.misfit), self.labels, -1)
        around = np.pad(regions, ((0, 0), (1, 1), (1, 1)), constant_values=-1)
        beside = (around[:, :-2, 1:-1], around[:, 2:, 1:-1], around[:, 1:-1, :-2], around[:, 1:-1, 2:])
        edge = np.logical_or.reduce([regions != other for other in beside])
        least = [
            float(self.misfit[light][edge[light] & (regions[light] == number)].min(initial=np.inf))
            for number, light in enumerate(self.lights)
        ]
        return [each if math.isfinite(each) else 0.0 for each in least]


_LAST: WeakKeyDictionary[MisfitMaps, tuple[list[tuple[float, ...]], CloudRegions]] = WeakKeyDictionary()
"""The last regions of misfits, as long as these are held, with the highlight points that they are of."""


def _ends(size: Image) -> IntArray:
    """Return the pixel, by its number row by row, at which the steepest descent from each ends, shape (H * W,)."""
    height, width = size.shape
    padded = np.pad(np.where(np.isfinite(size), size, np.inf), 1, constant_values=np.inf)
    # Each pixel points at the lowest of itself and its neighbours.
    lowest, target = padded[1:-1, 1:-1].copy(), np.arange(height * width).reshape(height, width)
    index = np.pad(target, 1)
    for down in range(3):
        for right in range(3):
            value = padded[down : down + height, right : right + width]
            np.copyto(target, index[down : down + height, right : right + width], where=value < lowest)
            np.minimum(lowest, value, out=lowest)
    # Follow the pointers, twice as far each time.
    flat = target.ravel()
    while not np.array_equal(farther := flat[flat], flat):
        flat = farther
    return flat


@dataclass(frozen=True)
class VisibleSpots:
    """Maxima of a frame, the brightest first, and the pixels of each.

    `rows` and `columns`, shape (N,), are those of the peaks; `regions`, shape (H, W), the number of the maximum whose
    pixel each is, from 1; 0 where none.
    """

    rows: IntArray
    columns: IntArray
    regions: IntArray


def find_spots(light: Image, specular: Image, seen: Mask | None = None) -> VisibleSpots:
    """Find the maxima of a noise-free frame that are highlights.

    `light` is the radiance behind the lens, `specular` the part that comes directly off the lobe, both of shape (H, W),
    `seen` the pixels inside the view mask, default all.
    """
    light = np.where(np.isfinite(light), light, 0.0).astype(np.float64)
    if seen is not None:
        # The lens spreads light over the border of the view.
        light, specular = np.where(seen, light, 0.0), np.where(seen, specular, np.float32(0))
    none = np.empty(0, dtype=np.int64)
    empty = VisibleSpots(none, none, np.zeros(light.shape, dtype=np.int64))
    if light.max() <= 0:
        return empty
    # Maxima that shine, the brightest first; in logarithms the ratio of saddle and peak is a height.
    log = np.log(np.maximum(light, DARK * light.max()))
    if log.min() >= log.max() + np.log(SADDLE):
        return empty
    shines = (specular >= LEAST_SPECULAR * light) & (light > DARK * light.max())
    tops = np.flatnonzero(shines & (log >= cv2.dilate(log, np.ones((3, 3), np.uint8))))
    tops = tops[np.argsort(-light.ravel()[tops], kind="stable")]
    peaks = np.array([top for top in tops if _stands_out(light, log, *divmod(int(top), light.shape[1]))], dtype=int)
    if not len(peaks):
        return empty
    rows, columns = np.unravel_index(peaks, light.shape)
    # Pixels: above half of the lobe's peak, shared out by watershed, connected to the peak.
    pieces = _pieces(specular, rows, columns)
    # A component keeps its number only if it holds its own peak.
    held = np.zeros(pieces.max() + 1, dtype=np.int64)
    held[pieces[rows, columns]] = np.arange(1, len(peaks) + 1)
    held[0] = 0
    return VisibleSpots(np.asarray(rows), np.asarray(columns), held[pieces])


def _pieces(specular: Image, rows: IntArray, columns: IntArray) -> npt.NDArray[np.int32]:
    """Return the number of the connected piece of one peak's pixels that each pixel is in, shape (H, W); 0: in none."""
    half = specular[rows, columns] / 2
    parts = connected(specular >= half.min())
    own, numbers = parts[rows, columns], np.arange(1, len(rows) + 1)
    alone = len(np.unique(own)) == len(own)
    if alone:
        owner_of = np.zeros(parts.max() + 1, dtype=np.int64)
        owner_of[own] = numbers
        owners = owner_of[parts]
    else:
        # Here, where it is needed: slow to load.
        from skimage.measure import label
        from skimage.segmentation import watershed

        markers = np.zeros(parts.shape, dtype=np.int32)
        markers[rows, columns] = numbers
        owners = watershed(-specular, markers, mask=parts > 0)
    owners[specular < np.concatenate([[np.inf], half])[owners]] = 0
    return connected(owners > 0) if alone else np.asarray(label(owners, background=0, connectivity=1), dtype=np.int32)


def _stands_out(light: Image, log: Image, row: int, column: int) -> bool:
    """Return whether a pixel's saddle to any brighter one, and to earlier ones as bright, is below `SADDLE`."""
    half = 8
    while True:
        # The window grows until what is above the saddle no longer touches its sides inside the frame.
        up, left = min(half, row), min(half, column)
        window = np.s_[row - up : row + half + 1, column - left : column + half + 1]
        labels = connected(log[window] >= log[row, column] + np.log(SADDLE), diagonally=True)
        own = labels == labels[up, left]
        if np.argmax(np.where(own, light[window], -1)) != up * own.shape[1] + left:
            return False
        bottom, right = (size - 1 - half for size in light.shape)
        sides = (own[0], row > half), (own[-1], row < bottom), (own[:, 0], column > half), (own[:, -1], column < right)
        if not any(is_inside and side.any() for side, is_inside in sides):
            return True
        half *= 2


_BESIDE = ((0, 0), (0, -1), (-1, 0), (1, 0), (0, 1))
"""A pixel and its neighbours along the axes, row and column, in the order in which their spots take a glint."""


def glints_of(spots: VisibleSpots, glints: list[TrueHighlight]) -> list[tuple[int, ...]]:
    """Return which lit glints, by index, each spot holds, or has next to its pixels."""
    held: list[list[int]] = [[] for _ in spots.rows]
    if not len(spots.rows):
        return []
    # A glint lies up to a pixel beside the light that it makes.
    around = np.pad(spots.regions, 1)
    height, width = spots.regions.shape
    for number, glint in enumerate(glints):
        column, row = min(int(glint.bp_px[0]), width - 1) + 1, min(int(glint.bp_px[1]), height - 1) + 1
        near = (around[row + down, column + right] for down, right in _BESIDE)
        if glint.lit and (region := next(filter(None, near), 0)):
            held[region - 1].append(number)
    return [tuple(numbers) for numbers in held]


def describe(
    spots: VisibleSpots, light: Image, specular: Image, sigma: Array, glints: list[TrueHighlight],
    seen: Mask | None = None, instruments: npt.NDArray[np.uint8] | None = None, clip: float = np.inf,
) -> list[VisibleHighlight]:  # fmt: skip
    """Describe the spots of a frame, the brightest first.

    `light`, `specular` and `seen` are those of `find_spots`, the first two with their channels, if any, `sigma`, shape
    (N,), is the noise at each peak, radiance. Of the `glints`, all of the frame, the brightest that a spot holds gives
    its light and cloud, or else the nearest lit one. `instruments`, shape (H, W), is 1 + the index of the instrument
    that is seen, 0 where none is; `clip` the radiance at which the values of each of the sensor's channels end.
    """
    channels, light = (light, specular), mean_channel(light)
    specular = mean_channel(specular)
    lit = [number for number, glint in enumerate(glints) if glint.lit]
    at = np.array([glints[number].bp_px for number in lit]).reshape(-1, 2)
    # the pixels of each spot, row by row
    flat = np.flatnonzero(spots.regions)
    number_of = spots.regions.ravel()[flat]
    ends = np.cumsum(np.bincount(number_of, minlength=len(spots.rows) + 1)[1:])
    pixels = np.split(flat[np.argsort(number_of, kind="stable")], ends[:-1])
    described = []
    for number, held in enumerate(glints_of(spots, glints)):
        row, column = int(spots.rows[number]), int(spots.columns[number])
        peak = np.array([column, row]) + PIXEL_CENTRE
        owner = 0 if instruments is None else int(instruments[row, column])
        held = () if owner else held
        nearest = held[0] if held else None
        if not (held or owner) and lit:
            nearest = lit[int(np.linalg.norm(at - peak, axis=1).argmin())]
        value, lobe = float(light[row, column]), float(specular[row, column])
        every, own = (np.asarray(part[row, column], dtype=float) for part in channels)
        shown = lobe
        if every.max() > clip:
            shown = float(np.mean(np.minimum(every, clip) - np.minimum(every - own, clip)))
        centroid, axis_ratio, whole = _shape(*np.divmod(pixels[number], light.shape[1]), specular, seen)
        described.append(
            VisibleHighlight(
                peak_px=peak,
                value=value,
                specular=lobe,
                peak_snr=_snr(shown, sigma[number]),
                area_px=len(pixels[number]),
                centroid_px=centroid,
                axis_ratio=axis_ratio,
                whole=whole,
                light=None if nearest is None else glints[nearest].light,
                cloud=None if nearest is None else glints[nearest].cloud,
                glints=held,
                instrument=owner - 1 if owner else None,
            )
        )
    return described


def _shape(rows: IntArray, columns: IntArray, specular: Image, seen: Mask | None) -> tuple[Array, float, bool]:
    """Return centroid, axis ratio and wholeness (see `VisibleHighlight`) of a spot's pixels, by the lobe's light."""
    weight = specular[rows, columns].astype(np.float64)
    points = np.stack([columns, rows], axis=1) + PIXEL_CENTRE
    centroid = weight @ points / weight.sum()
    gap = points - centroid
    # A pixel has a moment of its own.
    moments = np.einsum("n,ni,nj->ij", weight, gap, gap) / weight.sum() + np.eye(2) / 12
    small, large = np.linalg.eigvalsh(moments)
    height, width = specular.shape
    whole = rows.min() > 0 and columns.min() > 0 and rows.max() < height - 1 and columns.max() < width - 1
    if whole and seen is not None:
        whole = all(seen[rows + down, columns + right].all() for down in (-1, 1) for right in (-1, 1))
    return centroid, float(np.sqrt(small / large)), bool(whole)
