"""The specular light of a colour picture, and its spots: single highlights, and those that touch and are one cluster.

A glossy surface mirrors the colour of the lamp, which a white-balanced camera shows as grey. That adds the same to all
channels, so the difference of the largest and the smallest channel is that of the tissue alone (dichromatic model,
Shafer 1985). In tissue the ratio of mean and difference is nearly constant around a pixel; times the pixel's difference
it is the tissue's part of the light, whatever the shading. The rest is specular.

Each pixel of it belongs to the summit that steepest ascent leads to. Two summits are one where the saddle between them
is not clearly below the lower one, as in the definition of a visible highlight (theory.md 7.1b). The truth finds these
by another algorithm (simulation.highlights), so that it shares no code with the detector that it judges.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from simtest.calibration import estimate_noise
from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.geometry import Image, Mask, smooth
from simtest.geometry.ascent import Ascent, highest_of_pairs
from simtest.geometry.patch import dilated, rows_and_columns
from simtest.runtime.arrays import Array, Index

BLOCKS = 160
"""The tissue's colour is measured in square blocks, so many along the picture's longer side ..."""

NEIGHBOURHOOD = 25
"""... and is the median of so many by so many of them: wider than highlights, and narrower than organs."""

LEAST_LIGHT = 0.01
"""Below this share of full scale a pixel's colour is not used."""

LEAST_COLOUR = 0.08
"""Least difference of the channels over their mean: the colour of greyer tissue does not differ from a highlight's."""

_LOG_FACTORS = (float(np.log(1 / 3)), float(np.log(1 / LEAST_COLOUR)))
"""Range of the logarithm of the mean over the difference of the channels."""

PLATEAU, GLARE = 0.97, 0.7
"""All channels are clipped above this share of the clipped value, and where a spot's shape is judged above the second:
demosaicing and JPEG round them off."""

CANDIDATE = 0.5
"""Where the specular light is at least this share of the tissue's, the latter is filled in from around the pixel."""

SADDLE = 0.8
"""A summit counts if its saddle to any brighter one is below this share of it (theory.md 7.1b)."""

SADDLE_NOISE = 4.0
"""... and lower by so many standard deviations of the noise."""

RISE = 0.85
"""Clipped light is taken to rise by this power of 1 + the distance from the rim, px: so the shape of a clipped patch
tells the highlights that have melted in it apart."""


@dataclass(frozen=True)
class SplitLight:
    """The two parts of a frame's light, shape (H, W), share of full scale.

    Specular light is mirrored by the surface: about 0 elsewhere, with the noise of the difference, and 0 outside the
    view. The rest is the tissue's. `noise` is the standard deviation of the specular part from pixel to pixel.
    """

    specular: Image
    tissue: Image
    noise: float


@dataclass(frozen=True)
class ColourPicture:
    """A colour frame with its light in two parts.

    Parameters
    ----------
    linear : ndarray of float32, shape (H, W, 3)
        Linear values, share of full scale.
    light : SplitLight
        The two parts.
    clipped, flat, white : ndarray of bool, shape (H, W)
        Where a channel is clipped, where all are, and where all are nearly so.
    seen : ndarray of bool, shape (H, W), or None
        The pixels inside the view; None for all.
    """

    linear: Image
    light: SplitLight
    clipped: Mask
    flat: Mask
    white: Mask
    seen: Mask | None

    @classmethod
    def of(cls, linear: Image, clipped: Mask, seen: Mask | None) -> "ColourPicture":
        """Split a frame's light, and find where all channels are clipped."""
        light, flat, white = split_light(linear, clipped, seen), clipped, clipped
        if clipped.any():
            channels = cv2.split(np.ascontiguousarray(linear))
            least = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
            # the least value that a clipped channel has
            full = float(linear[clipped].max(axis=1).min())
            flat, white = np.asarray(least >= PLATEAU * full), np.asarray(least >= GLARE * full)
        return cls(linear, light, clipped, flat, white, seen)

    @cached_property
    def inside(self) -> Mask:
        """The pixels inside the view."""
        return np.ones(self.clipped.shape, dtype=bool) if self.seen is None else self.seen

    def smoothed(self, part: Image, width_px: float) -> Image:
        """Return a part of the light, smoothed inside the view."""
        return smooth(part, width_px, self.seen)


def split_light(linear: Image, clipped: Mask, seen: Mask | None = None) -> SplitLight:
    """Split a frame of linear values, shape (H, W, 3), shares of full scale.

    `clipped`, shape (H, W), is where a channel is clipped, `seen` the pixels inside the view, default all.
    """
    channels = cv2.split(np.ascontiguousarray(linear))
    least = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
    most = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
    intensity = (channels[0] + channels[1] + channels[2]) / np.float32(3)
    inside = np.ones(least.shape, dtype=bool) if seen is None else seen
    sound = inside & ~dilated(clipped)
    # tissue by its colour: mean over difference from around, times the pixel's difference
    difference = most - least
    factor, floor = _tissue_colour(intensity, difference, least, sound)
    # The difference is smoothed: its noise would be the tissue's, which has no fine detail that matters.
    tissue = np.minimum(factor * cv2.GaussianBlur(difference, (0, 0), 1.0), intensity)
    tissue = fill(tissue, sound)
    # under highlights: filled in from clean pixels
    specular = intensity - tissue
    candidate = specular >= CANDIDATE * tissue
    clean = sound & ~dilated(candidate, 2)
    tissue = np.where(candidate | ~sound, fill(tissue, clean), tissue)
    # The least channel less the tissue's part of it bounds the specular light too, and is the better measure where the
    # largest channel is clipped.
    specular = np.minimum(intensity - tissue, least - floor * tissue)
    specular[~inside] = 0
    return SplitLight(specular, intensity - specular, estimate_noise(specular, seen))


def _tissue_colour(intensity: Image, difference: Image, least: Image, sound: Mask) -> tuple[Image, Image]:
    """Return at each pixel the mean of the tissue's channels over their difference, and the least over the mean."""
    height, width = intensity.shape
    block = max(height, width) / BLOCKS
    size = (max(round(width / block), 1), max(round(height / block), 1))
    # means over each block's bright, sound pixels
    weight = (sound & (intensity > LEAST_LIGHT)).astype(np.float32)
    sums = [cv2.resize(v * weight, size, interpolation=cv2.INTER_AREA) for v in (intensity, difference, least, weight)]
    mean, gap, low, share = sums
    known = (share > 0.25) & (mean > 0)
    factor = np.where(known, mean / np.maximum(gap, LEAST_COLOUR * np.maximum(mean, 1e-9)), 0)
    floor = np.where(known, low / np.maximum(mean, 1e-9), 0)
    # medians over the neighbourhood, and back to the frame's size
    maps = []
    for values, low_end, high_end in ((np.log(np.maximum(factor, 1 / 3)), *_LOG_FACTORS), (floor, 0.0, 1.0)):
        around = _median(fill(values.astype(np.float32), known), low_end, high_end)
        maps.append(cv2.resize(around, (width, height), interpolation=cv2.INTER_LINEAR))
    return np.exp(maps[0]), maps[1]


def _median(values: Image, low: float, high: float) -> Image:
    """Return the median of each neighbourhood, in 255 steps between two ends, as fine as tissue's colour is even."""
    steps = np.rint((np.clip(values, low, high) - low) * (255 / (high - low))).astype(np.uint8)
    edge = NEIGHBOURHOOD // 2
    padded = cv2.copyMakeBorder(steps, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    around = cv2.medianBlur(padded, NEIGHBOURHOOD)[edge:-edge, edge:-edge]
    return (low + around.astype(np.float32) * ((high - low) / 255)).astype(np.float32)


def fill(values: Image, known: Mask) -> Image:
    """Fill unknown values, shape (H, W), smoothly from known ones, by averages over ever coarser pixels.

    Known values are unchanged; where none is known the result is 0.
    """
    weight = known.astype(np.float32)
    # down: sums of known values over ever coarser pixels
    levels = [(values * weight, weight)]
    while max(levels[-1][0].shape) > 1:
        rows, columns = levels[-1][0].shape
        size = ((columns + 1) // 2, (rows + 1) // 2)
        levels.append(tuple(cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in levels[-1]))
    # up: what a pixel lacks comes from the coarser level
    filled = levels[-1][0] / np.maximum(levels[-1][1], np.float32(1e-12))
    for part, share in levels[-2::-1]:
        rows, columns = part.shape
        coarse = cv2.resize(filled, (columns, rows), interpolation=cv2.INTER_LINEAR)
        filled = part + (1 - share) * coarse
    return np.asarray(filled, dtype=np.float32)


@dataclass(frozen=True)
class Basins:
    """The summits of a frame, the brightest first: their pixels, and the number of each pixel's summit.

    `labels`, shape (H, W), count from 1 and are 0 outside the mask. `pairs`, shape (K, 2), are the summits, from 0,
    whose basins touch, the brighter first, each pair once; `saddles`, shape (K, 2), row and column of the lowest pixel
    of the highest way from one to the other directly.
    """

    rows: Index
    columns: Index
    labels: Index
    pairs: Index
    saddles: Index


def find_basins(values: Image, mask: Mask, base: Image, keep: float, noise: float) -> Basins:
    """Find the summits of values, shape (H, W), among the pixels of a mask.

    A summit stays where its saddle to a brighter one is below the share `keep` of it, both with the `base` below them,
    shape (H, W), and lower than it by more than `noise`.
    """
    # Pixels are numbered by height, and equal ones in their order, so that a plateau has a way up too.
    rows, columns = rows_and_columns(mask)
    by_height = np.argsort(values[rows, columns], kind="stable")
    rows, columns = rows[by_height], columns[by_height]
    ascent = Ascent.of(rows, columns, mask.shape)
    tops, pairs, saddle = ascent.tops, ascent.pairs, ascent.saddles
    height = values[rows, columns].astype(np.float64)
    owner = _merged(tops, pairs, saddle, height, height + base[rows, columns], keep, noise)
    # summits that stay, the brightest first
    kept = np.flatnonzero(np.bincount(owner))
    kept = kept[np.argsort(-tops[kept])]
    rank = np.full(len(tops), -1)
    rank[kept] = np.arange(len(kept))
    kept_number = rank[owner]
    labels = np.zeros(values.shape, dtype=np.int64)
    labels[rows, columns] = kept_number[ascent.basins] + 1
    pairs, saddle = highest_of_pairs(kept_number[pairs[:, 0]], kept_number[pairs[:, 1]], saddle, len(kept))
    return Basins(rows[tops[kept]], columns[tops[kept]], labels, pairs, np.stack([rows[saddle], columns[saddle]], 1))


def _merged(tops: Index, pairs: Index, saddle: Index, height: Array, total: Array, keep: float, noise: float) -> Index:
    """Return for each summit the one that it belongs to, flooding from the highest saddle down.

    Summits and saddles are pixels, numbered by height; `total` is the height with its base.
    """
    owner, flooded = list(range(len(tops))), list(range(len(tops)))
    for k in np.argsort(-height[saddle], kind="stable").tolist():
        a, b = int(pairs[k, 0]), int(pairs[k, 1])
        top_a, top_b = _root(flooded, a), _root(flooded, b)
        if top_a == top_b:
            continue
        if tops[top_a] < tops[top_b]:
            a, b, top_a, top_b = b, a, top_b, top_a
        top, between = tops[top_b], saddle[k]
        if total[between] >= keep * total[top] or height[top] - height[between] <= noise:
            owner[_root(owner, top_b)] = _root(owner, a)
        flooded[top_b] = top_a
    return np.array([_root(owner, i) for i in range(len(owner))], dtype=np.int64)


def _root(of: list[int], i: int) -> int:
    """Return what a number belongs to in the end, and shorten the way there."""
    while of[i] != i:
        of[i] = of[of[i]]
        i = of[i]
    return i


@dataclass(frozen=True)
class SpecularSpot:
    """Connected pixels of one highlight, or of several that touch.

    `peaks`, shape (N, 2), are column and row of each highlight's brightest pixel, the brightest first, and `value` the
    specular light of that; `mask` its pixels above half height, whose first is at `corner`, (column, row). One that
    `touches` is the shoulder of a brighter one: its isophote at half height runs into that. Of a `melted` one several
    peaks are told apart by the outline of clipped light alone.
    """

    peaks: Index
    value: float
    corner: tuple[int, int]
    mask: Mask
    touches: bool
    melted: bool

    @property
    def area_px(self) -> int:
        """Number of its pixels."""
        return int(np.count_nonzero(self.mask))

    @property
    def crop(self) -> tuple[slice, slice]:
        """Rows and columns of the mask in the frame."""
        x, y = self.corner
        height, width = self.mask.shape
        return slice(y, y + height), slice(x, x + width)


def find_spots(
    specular: Image, tissue: Image, mask: Mask, least: Image, noise: float, flat: Mask
) -> list[SpecularSpot]:
    """Find the spots among the pixels of a mask, the brightest first.

    Basins that the isophote at half height joins are one cluster. `specular` and `tissue` are the two parts of the
    light, smoothed, `noise` the standard deviation of the first; a highlight's peak has at least `least` specular
    light. Where all channels are clipped, `flat`, light is taken to rise. All arrays have the shape (H, W).
    """
    rise: Image | float = 1.0
    if flat.any():
        rise = (1 + cv2.distanceTransform(flat.astype(np.uint8), cv2.DIST_L2, 5)) ** RISE
    basins = find_basins(specular * rise, mask, tissue * rise, SADDLE, SADDLE_NOISE * noise)
    # groups of summits
    peak = specular[basins.rows, basins.columns].astype(np.float64)
    saddle = specular[basins.saddles[:, 0], basins.saddles[:, 1]].astype(np.float64)
    groups, touching = _groups(peak, basins.pairs, saddle)
    number, level = np.full(len(peak), -1), HIGHLIGHT_ISOVALUE * peak
    for i, group in enumerate(groups):
        number[group] = i
        level[group] = level[group[0]]
    melted = _melted(basins, specular + tissue, number, len(groups))
    # the pixels of each, sorted by group
    rows, columns = rows_and_columns(basins.labels != 0)
    summit = basins.labels[rows, columns] - 1
    high = specular[rows, columns] >= level[summit]
    rows, columns, owner = rows[high], columns[high], number[summit[high]]
    order = np.argsort(owner, kind="stable")
    rows, columns = rows[order], columns[order]
    starts = np.searchsorted(owner[order], np.arange(len(groups) + 1))
    spots = []
    for i, group in enumerate(groups):
        at_peak = basins.rows[group[0]], basins.columns[group[0]]
        if specular[at_peak] < least[at_peak]:
            continue
        y, x = rows[starts[i] : starts[i + 1]], columns[starts[i] : starts[i + 1]]
        top, left = int(y.min()), int(x.min())
        inside = np.zeros((int(y.max()) - top + 1, int(x.max()) - left + 1), dtype=bool)
        inside[y - top, x - left] = True
        peaks = np.stack([basins.columns[group], basins.rows[group]], axis=1)
        several = melted[i] and len(group) > 1
        spots.append(SpecularSpot(peaks, float(specular[at_peak]), (left, top), inside, touching[i], several))
    return spots


def _groups(peak: Array, pairs: Index, saddle: Array) -> tuple[list[list[int]], list[bool]]:
    """Group summits, the brightest first, with those that its half-height isophote holds.

    Also return which groups are shoulders: their isophotes at half height run into a brighter group.
    """
    near: list[list[tuple[int, float]]] = [[] for _ in peak]
    for (a, b), height in zip(pairs.tolist(), saddle.tolist(), strict=True):
        near[a].append((b, height))
        near[b].append((a, height))
    taken = np.zeros(len(peak), dtype=bool)
    groups: list[list[int]] = []
    touching: list[bool] = []
    for first in range(len(peak)):
        if taken[first]:
            continue
        level = HIGHLIGHT_ISOVALUE * float(peak[first])
        group, touches = [first], False
        taken[first] = True
        for member in group:
            for other, height in near[member]:
                if height < level or other in group:
                    continue
                if taken[other]:
                    touches = True
                else:
                    taken[other] = True
                    group.append(other)
        groups.append(sorted(group))
        touching.append(touches)
    return groups, touching


def _melted(basins: Basins, total: Image, number: Index, count: int) -> list[bool]:
    """Return for each group whether no saddle between its summits lies clearly below them in the light as it is."""
    inside = number[basins.pairs[:, 0]] == number[basins.pairs[:, 1]]
    pairs, saddles = basins.pairs[inside], basins.saddles[inside]
    summit = total[basins.rows, basins.columns]
    share = total[saddles[:, 0], saddles[:, 1]] / np.minimum(summit[pairs[:, 0]], summit[pairs[:, 1]])
    best = np.zeros(len(summit))
    for side in (0, 1):
        np.maximum.at(best, pairs[:, side], share)
    apart = np.bincount(number[best < SADDLE], minlength=count)
    return [bool(each == 0) for each in apart]
