"""What `cloud` reads of a frame: its bright spots, and the diffuse light between them.

Light and camera at one place: a base of even albedo at the distance r sends back L = cos(w) / r^2, where the misfit w
is the turn of its normal from the reversed sightline. Across a sightline w = grad ln r, so that

    grad ln L = -(2 + J) w,    J = grad w = I + dS,    Hessian of ln L = -(2 J + J^2) where w = 0.

A quadric of ln L around a cloud gives J, and w at its centre. At a highlight point of the base w = 0. Folds that
come near to facing the camera make clouds too; there w is not 0. To first order a light beside the camera, at L across
the sightline, turns all by L / d: w - L / d takes the place of w.

Between them stand the bright spots of a frame: maxima that a saddle parts from any brighter one, each with its
centroid. On a relief these are what can be seen of the glints (theory.md 7.1b); `cloud` groups them.
"""

from dataclasses import dataclass, field
from functools import cached_property, reduce

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.calibration.frame import median
from simtest.conventions import HIGHLIGHT_ISOVALUE, PIXEL_CENTRE
from simtest.geometry import Array, Image, Mask, smooth
from simtest.geometry.ascent import Ascent
from simtest.geometry.patch import rows_and_columns, share_of_noise
from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import AnyArray, Index

SMOOTHING_PX = 0.7
"""Gaussian smoothing before maxima are looked for: that of a lens, so that one spot of noise is no maximum."""

SADDLE = 0.8
"""Two maxima are two spots if the saddle between them is below this share of the lower one."""

STEP, LEVELS = 0.9, 40
"""Each threshold over the last, and how many: the faintest spot has 1.5 % of the brightest one's light."""

NOISE_FACTOR = 10.0
"""A spot's peak stands so many standard deviations of the noise above its surroundings."""

FAINTEST = 0.25
"""A spot's peak over that of the bright spots. Where the misfit has a minimum above 0 there is a fainter spot, which is
no glint and lies far out more often."""

LEAST_CONTRAST = 0.5
"""A spot's peak over the light around it: texture and shading of the tissue stay below."""

PART_CONTRAST = 0.3
"""Light this much over that around is no diffuse light."""

BRIGHT_QUANTILE = 0.8
"""The bright spots are those around this quantile of all peaks above the noise."""

LEAST_PX = 3
"""Pixels above half of a spot's own peak."""

BACKGROUND_SCALE = 8
"""The background is the median of a picture that is so many times smaller, over 5 x 5 of its pixels."""


@dataclass(frozen=True)
class Spots:
    """The bright spots of a frame, the brightest first."""

    points_px: Array  # (N, 2): centroid of each spot's pixels, px
    areas_px: Array  # (N,): number of pixels above half of its peak, or above the saddle where that is higher
    peaks: Array  # (N,): light at the peak above the background, frame units

    def of(self, kept: Mask) -> "Spots":
        """Return some of the spots."""
        return Spots(self.points_px[kept], self.areas_px[kept], self.peaks[kept])


def find_spots(frame: Frame) -> Spots:
    """Find the bright spots of a frame.

    The light is the frame's specular light where a detector split it off; else, of a coloured frame, that of the
    weakest channel: what a wet surface mirrors is white, and tissue is not.
    """
    light, noise = _light(frame)
    around, brightest_near = _background_of(frame, light)
    above = light - around
    if frame.light is not None:
        # Where a detector split the light there is none around: a spot is bright beside what it took off.
        brightest_near = np.maximum(brightest_near, _background(_tissue(frame))[1])
    if frame.seen is not None:
        above = np.where(frame.seen, above, np.float32(0))
    least = NOISE_FACTOR * noise
    brightest = float(above.max(initial=0.0))
    if not brightest > max(least, 0.0):
        return Spots(np.empty((0, 2)), np.empty(0), np.empty(0))
    # What tissue, not its wet surface, sends back is no spot, however bright.
    above = np.where(above >= HIGHLIGHT_ISOVALUE * LEAST_CONTRAST * brightest_near, above, np.float32(0))
    spots = _maxima(above, brightest_near, brightest, max(least, brightest * STEP**LEVELS))
    if not len(spots.peaks):
        return spots
    last = len(spots.peaks) - 1
    # NumPy's quantile loads masked arrays, which nothing else needs; the peaks are sorted already.
    bright = np.interp((1 - BRIGHT_QUANTILE) * last, np.arange(last + 1), spots.peaks)
    kept = spots.peaks >= FAINTEST * bright
    return spots.of(kept)


def spots_could_be_seen(frame: Frame) -> Mask | None:
    """Return where a bright spot could be seen, shape (H, W): in view, and not on ground that is burnt out."""
    level, response, gain = frame.calibration.saturation_level, frame.calibration.response, frame.corrected.gain
    if level is None:
        return frame.seen
    most = level if response is None else float(response.decode(np.array([level]))[0])
    ground, near = _background(_tissue(frame))
    shows = ground + LEAST_CONTRAST * near <= (most if gain is None else most * gain)
    return np.asarray(shows if frame.seen is None else shows & frame.seen)


def bright_parts(frame: Frame) -> Mask:
    """Return where the light stands above that of the tissue around, shape (H, W): spots, faint ones too."""
    return _above(frame)[1]


def _above(frame: Frame) -> tuple[Image, Mask]:
    """Return the light less that of the tissue around, and where this is no diffuse light, shape (H, W)."""
    light, noise = _light(frame)
    around, _ = _background_of(frame, light)
    above = light - around
    tissue = around if frame.light is None else np.maximum(around, _background(_tissue(frame))[0])
    return above, np.asarray(above > np.maximum(PART_CONTRAST * tissue, NOISE_FACTOR * noise))


def _light(frame: Frame) -> tuple[Image, float]:
    """Return the light in which spots are looked for, smoothed, shape (H, W), and the noise that is left in it."""
    noise = _level(frame) * share_of_noise(SMOOTHING_PX)
    if frame.light is None and frame.encoded.ndim == 3:
        # The noise of the mean is known; the minimum has about that of one channel.
        return _tissue(frame), noise * float(np.sqrt(frame.encoded.shape[2]))
    return smooth(frame.corrected.intensity, SMOOTHING_PX, frame.seen), noise


def _level(frame: Frame) -> float:
    """Return the median noise of a frame."""
    return float(median(np.ravel(frame.noise)))


def _tissue(frame: Frame) -> Image:
    """Return the light of a frame's weakest channel, smoothed, shape (H, W), frame units.

    Between the spots it is the diffuse light, whatever a detector split off.
    """
    gain, values = frame.corrected.gain, frame.channels
    values = values if values.ndim == 2 else reduce(cv2.min, cv2.split(values))
    return smooth(values if gain is None else values * gain, SMOOTHING_PX, frame.seen)


def _background_of(frame: Frame, light: Image) -> tuple[Image, Image]:
    """Return the `_background` of a frame's light.

    A detector's split may leave less than no light in the dark beside an organ. A gap in that is no light either.
    """
    around, near = _background(light)
    return (around, near) if frame.light is None else (np.maximum(around, np.float32(0)), near)


def _background(light: Image) -> tuple[Image, Image]:
    """Return what a picture, shape (H, W), has around its spots: its local median, and the largest of those near.

    At the limb of an organ the median may be that of the dark beside it.
    """
    height, width = light.shape
    size = (max(width // BACKGROUND_SCALE, 5), max(height // BACKGROUND_SCALE, 5))
    small = cv2.resize(light, size, interpolation=cv2.INTER_NEAREST)
    small = cv2.medianBlur(np.ascontiguousarray(small, dtype=np.float32), 5)
    near = cv2.dilate(small, np.ones((5, 5), np.uint8))
    around, highest = (cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR) for part in (small, near))
    return np.asarray(around, dtype=np.float32), np.asarray(highest, dtype=np.float32)


def _maxima(above: Image, around: Image, brightest: float, least: float) -> Spots:
    """Find the maxima of a picture by thresholds from bright to faint: a part without a spot yet is a new one."""
    levels = [brightest * STEP]
    while levels[-1] * STEP >= least:
        levels.append(levels[-1] * STEP)
    rows, columns = rows_and_columns(above >= levels[-1])
    # Of equal pixels the first is the summit.
    by_height = np.argsort(above[rows, columns][::-1], kind="stable")
    rows, columns = rows[::-1][by_height], columns[::-1][by_height]
    ascent = Ascent.of(rows, columns, above.shape)
    count = len(ascent.tops)
    # The first level that reaches each pixel: at each level summits appear, and pairs of them are joined.
    reached = np.searchsorted(-np.array(levels, dtype=np.float32), -above[rows, columns])
    born: list[list[int]] = [[] for _ in levels]
    for summit in _in_order(ascent, reached, rows, columns).tolist():
        born[reached[ascent.tops[summit]]].append(summit)
    joined: list[list[list[int]]] = [[] for _ in levels]
    for pair, number in zip(ascent.pairs.tolist(), reached[ascent.saddles].tolist(), strict=True):
        joined[number].append(pair)
    part, summits, found = list(range(count)), [[summit] for summit in range(count)], list[_Spot]()
    for number, level in enumerate(levels):
        _join(joined[number], part, summits)
        held: dict[int, list[_Spot]] = {}
        for spot in found:
            held.setdefault(part[spot.summit], []).append(spot)
        for summit in born[number]:
            if part[summit] not in held:
                top = ascent.tops[summits[part[summit]]].max()
                found.append(_Spot(float(above[rows[top], columns[top]]), top, summit))
                held[part[summit]] = found[-1:]
        for label, own in held.items():
            # Fainter maxima that no saddle parts from the brightest one are none.
            for spot in own[1:]:
                spot.absorbed = SADDLE * spot.peak < level
            apart = [spot for spot in own if not spot.absorbed]
            for spot in apart:
                spot.merged |= len(apart) > 1
            # Alone in its part, and not below half of its peak: these are its pixels, so far.
            if not (spot := apart[0]).merged and (not spot.size or level >= HIGHLIGHT_ISOVALUE * spot.peak):
                # The list grows: only its start is the part of now.
                spot.part, spot.size, spot.level = summits[label], len(summits[label]), number
        found = [spot for spot in found if not spot.absorbed]
    # Number of each summit's pixels down to each level, and sums of their columns and rows.
    size = count, len(levels)
    cell = ascent.basins * len(levels) + reached
    sums = [np.bincount(cell, each, count * len(levels)).reshape(size).cumsum(1) for each in (None, columns, rows)]
    of = [[float(each[spot.part[: spot.size], spot.level].sum()) for each in sums] for spot in found]
    bright = [spot.peak >= LEAST_CONTRAST * around[rows[spot.top], columns[spot.top]] for spot in found]
    kept = [i for i, spot in enumerate(found) if of[i][0] >= LEAST_PX and bright[i]]
    kept.sort(key=lambda i: -found[i].peak)
    areas, *middles = np.array([of[i] for i in kept]).reshape(-1, 3).T
    points = np.stack(middles, axis=1) / areas[:, None] + PIXEL_CENTRE
    return Spots(points, areas, np.array([found[i].peak for i in kept]))


def _join(pairs: list[list[int]], part: list[int], summits: list[list[int]]) -> None:
    """Join the parts of pairs of summits: each summit's part, and each part's summits."""
    for one, other in pairs:
        small, large = sorted((part[one], part[other]), key=lambda each: len(summits[each]))
        if small != large:
            summits[large] += summits[small]
            for summit in summits[small]:
                part[summit] = large


def _in_order(ascent: Ascent, reached: Index, rows: Index, columns: Index) -> Index:
    """Return the summits in the order of the first square of 2 x 2 pixels that is reached with each."""
    with_top = reached == reached[ascent.tops][ascent.basins]
    square = (rows // 2 * (columns.max(initial=0) + 1) + columns // 2)[with_top]
    first = np.full(len(ascent.tops), square.max(initial=0))
    np.minimum.at(first, ascent.basins[with_top], square)
    return np.argsort(first, kind="stable")


@dataclass
class _Spot:
    """A spot that is being found: its peak, that one's pixel and summit, and its part of the picture so far.

    That are the first `size` summits of `part`, down to a level. `merged` once its part holds another one, `absorbed`
    where no saddle parts it from a brighter one.
    """

    peak: float
    top: int
    summit: int
    part: list[int] = field(default_factory=list)
    size: int = 0
    level: int = 0
    merged: bool = False
    absorbed: bool = False


STRIDE = 2
"""Of the pixels whose light is fitted, px."""

SPOT_MARGIN_PX = 4
"""So near to a spot nothing is fitted, px."""

REACH, LEAST_EXTENT = 2.0, np.radians(3.0)
"""The light is fitted within so many extents of a cloud; the least extent, rad, is added as a variance."""

LEAST_PIXELS, LEAST_SHARE = 60, 0.12
"""Fewer pixels between the spots, or a smaller share of all, tell nothing."""

MOST_MISSING = 0.05
"""Of these pixels a channel that is fitted is clipped at no more, and another one that tells the hue lacks no more."""

LEAST_LIGHT = 5.0
"""Light below so many standard deviations of the noise is dark."""

LEAST_LIT, GLITTERING = 0.1, 0.2
"""A frame shows diffuse light where this share of its pixels is lit between the spots, or the second anywhere: steep
relief strews its spots so densely that nothing is left between them."""

STEPS, OUTLYING = 6, 2.0
"""Steps of the robust fit; residuals of more standard deviations count less."""

FRONT = 0.3
"""Least cosine between a sightline that is fitted and the cloud's."""

MOST_GAIN = 20.0
"""A larger gain 1 + d k of the base is not told from this one."""

SECTORS = 8
"""The fit is repeated without each of so many sectors: the jackknife's covariance."""


@dataclass(frozen=True)
class Shading:
    """What the diffuse light tells of the base at a sightline, in ``basis_across(sightline)``."""

    # (2,): grad ln L = -(2 + J) w, w the turn of the base's normal from the direction to the light, per rad.
    gradient: Array
    covariance: Array  # (2, 2): of `gradient`, by the jackknife over sectors
    gains: Array  # (2, 2): I + dS of the base. A gain g below -1 makes the same light as -2 - g, which is given for it.


@dataclass(frozen=True)
class DiffuseLight:
    """The light of a frame between its spots."""

    frame: Frame  # falloffs that its calibration knows are undone

    @cached_property
    def _lit(self) -> tuple[AnyArray, Mask]:
        """Return the channels, shape (h, w, C), and where they are lit in view, spots and all."""
        frame, cut = self.frame, (slice(None, None, STRIDE), slice(None, None, STRIDE))
        light, gain = frame.channels if frame.encoded.ndim == 3 else frame.channels[..., None], frame.corrected.gain
        values = light[cut] if gain is None else light[cut] * gain[cut][..., None]
        # The noise is that of the channels' mean.
        lit = values > LEAST_LIGHT * _level(frame) * np.sqrt(light.shape[2])
        return values, np.asarray(lit if frame.seen is None else lit & frame.seen[cut][..., None])

    @cached_property
    def _logs(self) -> tuple[Array, Mask, Mask]:
        """Return logs of the channels, shape (h, w, C), where they are lit between the spots, and not clipped there."""
        frame, cut = self.frame, (slice(None, None, STRIDE), slice(None, None, STRIDE))
        values, lit = self._lit
        margin = np.ones((2 * SPOT_MARGIN_PX + 1, 2 * SPOT_MARGIN_PX + 1), np.uint8)
        lit = lit & ~(cv2.dilate(bright_parts(frame).astype(np.uint8), margin)[cut] > 0)[..., None]
        encoded = frame.encoded if frame.encoded.ndim == 3 else frame.encoded[..., None]
        level = frame.calibration.saturation_level
        unclipped = lit if level is None else lit & (encoded[cut] < level)
        return np.log(np.maximum(values, 1e-9), dtype=np.float64), lit, unclipped

    @cached_property
    def _sightlines(self) -> Array:
        height, width = self._logs[0].shape[:2]
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) * STRIDE + PIXEL_CENTRE
        return np.nan_to_num(self.frame.camera.unproject(pixels))

    @cached_property
    def shows(self) -> bool:
        """Whether the frame shows diffuse light: its base is tissue, not dark."""
        between, anywhere = (lit.any(axis=2).mean() for lit in (self._logs[1], self._lit[1]))
        return bool(between > LEAST_LIT or anywhere > GLITTERING)

    def around(self, sightline: Array, covariance: Array) -> Shading | None:
        """Fit a quadric to the logarithm of the light around a sightline.

        `sightline`, (3,): unit; `covariance`, (2, 2): of the cloud in the plane across the sightline at unit distance,
        in its basis, rad^2. Returns none where too little is seen between the spots.
        """
        cosine = self._sightlines @ sightline
        points = self._sightlines @ basis_across(sightline).T / np.where(cosine > FRONT, cosine, np.nan)[:, None]
        reach = covariance + LEAST_EXTENT**2 * np.eye(2)
        radius2 = np.nan_to_num(np.einsum("ni,ij,nj->n", points, np.linalg.inv(reach), points), nan=np.inf)
        inside = np.flatnonzero(radius2 < REACH**2)
        logs, *masks = self._logs
        logs = logs.reshape(-1, logs.shape[2])[inside]
        lit, sound = (mask.reshape(-1, mask.shape[2])[inside] for mask in masks)
        enough = np.flatnonzero(sound.sum(axis=0) >= max(LEAST_PIXELS, LEAST_SHARE * len(inside)))
        if not len(enough):
            return None
        # The brightest channel, red, is the one that blood changes least; but what clipping leaves of it is flat.
        clipped = 1 - sound.sum(axis=0)[enough] / lit.sum(axis=0)[enough]
        whole = enough[clipped <= max(MOST_MISSING, float(clipped.min()))]
        main = whole[np.argmax([median(logs[sound[:, c], c]) for c in whole])]
        others = [c for c in enough if c != main and sound[sound[:, main], c].mean() > 1 - MOST_MISSING]
        kept = sound[:, [main, *others]].all(axis=1)
        # Albedo changes the ratios of the channels, shading does not.
        hues = logs[kept][:, others] - logs[kept, main][:, None]
        points, radius2 = points[inside][kept], radius2[inside][kept]
        return _fitted(points, radius2, logs[kept, main], hues)


def _fitted(points: Array, radius2: Array, values: Array, hues: Array) -> Shading:
    """Fit a quadric and the hues' share to logs of light, shape (N,), at points, shape (N, 2)."""
    scale = float(np.sqrt((points**2).mean()))
    x, y = points.T / scale
    terms = [np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2]
    A = np.column_stack([*terms, hues - hues.mean(axis=0), values])
    near = np.exp(-radius2 / 4)
    weights = near
    for _ in range(STEPS):
        solution = _solved(_products(A, weights))
        gaps = values - A[:, :-1] @ solution
        spread = 1.48 * float(median(np.abs(gaps))) + 1e-9
        weights = near / (1 + (gaps / (OUTLYING * spread)) ** 2)
    sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    own = np.stack([_products(A[sector == i], weights[sector == i]) for i in range(SECTORS)])
    without = [_solved(products) for products in own.sum(axis=0) - own]
    moves = (np.array(without) - solution)[:, 1:3] / scale
    return Shading(solution[1:3] / scale, moves.T @ moves * (SECTORS - 1) / SECTORS, _gains(solution[3:6] / scale**2))


def _products(A: Array, weights: Array) -> Array:
    """Return the weighted products of columns, shape (K, K), the last of which is fitted by the others."""
    return np.asarray((A * weights[:, None]).T @ A)


def _solved(products: Array) -> Array:
    return np.asarray(np.linalg.lstsq(products[:-1, :-1], products[:-1, -1], rcond=None)[0])


def _gains(hessian: Array) -> Array:
    """Return I + dS from the second derivatives of the light's log: xx, xy, yy."""
    xx, xy, yy = hessian
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    # Of the two roots of J^2 + 2 J + H = 0 the one that is not below -1.
    J = np.sqrt(np.clip(1 - values, 0.0, (1 + MOST_GAIN) ** 2)) - 1
    return np.asarray(vectors @ np.diag(J) @ vectors.T)
