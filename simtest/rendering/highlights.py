"""Highlight points: where the normal bisects the directions to a light and to the camera, sub-pixel.

The misfit w between normal and bisector is a two-vector field over the image (theory.md sections 3 and 6). That of the
rendered frame, on a grid, shows where a zero is near; exact Newton steps with the closed derivative of the normal
finish, for all lights together: each step solves the exact points of all seeds at once.

On a surface with relief the zeros are glints (theory.md 7.1), hundreds a frame, and small. The search is not exhaustive
(docs/reference/limits.md says how many it misses).

Where the points lie does not depend on the light that reaches the camera, and the search is a large part of a frame:
a session searches once while surface, camera and rig stay, and frames give the points their radiance.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from simtest.rendering.frames import HighlightPoint, Radiance
from simtest.rendering.misfits import crossed, exact_misfit
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.lights import is_at_camera
from simtest.spec.reflectance import TissueReflectance

if TYPE_CHECKING:
    from simtest.rendering.session import Session


SMOOTH_STRIDE_PX = 2
"""Between the pixels whose misfit is traced where there is no relief."""

MIN_GAIN = 0.05
"""Where abs(1 + d k) of the base is smaller its highlight is a streak, not a point."""

SPARED = 0.25
"""Seeds are dropped below this share of it: they know it by differences, and pixels off the axis span less of an angle
than those on it (a quarter at 60 deg)."""

NEAR_CELLS = 2.0
"""A cell is a seed where its Newton step, along rows and columns, is shorter than this."""

SAME_SEED = 0.5
"""Seeds closer than this many cells are one."""

NEWTON_STEPS = 60
"""Where the misfit's derivative is not exact, as on a mesh with relief, steps fall by a factor of 0.75 alone."""

CONVERGED_PX = 1e-6
PATIENCE, LEAST_FALL = 5, 0.7
"""A seed whose least misfit has not fallen to this share within so many steps strays, and is given up."""

MAX_STEP_PX = {"base": 4.0, "fine": 2.0}
SAME_PX = {"base": 0.5, "fine": 0.02}
"""Solutions closer than this are the same zero, found twice."""

MERGING, MERGED_PX = (1, 2, 4, 8), 0.005
"""After these steps, seeds of one light that are closer than this have met."""

GRID_WAVE = 12.0
"""Steps of the seeds' grid per wave of the finest band; pixels that are wider are divided."""

TILE_PX, VARIES = 4, 0.3
"""Pixels along the side of the tiles that are divided: those in which no component of the misfit is farther from 0 than
this share of its range over the tile and the pixels round it."""

CACHED = 2**16
"""Cells among which seeds are looked for together, so that the processor's cache holds them."""

MAX_DIVISION = 8
LEAST_WAVE_PX = 1.5
"""Pixels are divided by at most this. Relief whose waves are shorter than this many px is not resolved there, and acts
as roughness."""

HALF_WIDTH = math.sqrt(2 * math.log(2))
"""Half-width at half height of a Gaussian over its standard deviation."""

RATIOS, BISECTIONS = np.geomspace(1e-3, 30.0, 200), 40
"""Radii of discs over a lobe's standard deviation: less widens nothing, more is the disc alone."""


def search(session: "Session", base: bool) -> list[HighlightPoint]:
    """Find all lights' highlight points, of the base or of the fine surface, in a dark frame, light by light."""
    fine = session.surface.relief is not None and not base
    points = describe(session, *find_zeros(session, fine), fine)
    return points if fine else [point for point in points if point.min_gain > MIN_GAIN]


def lit_by(radiance: Radiance, points: Sequence[HighlightPoint]) -> list[HighlightPoint]:
    """Return highlight points with the direct radiance of their pixels in a frame, the brightest first.

    Bounces are left out: their noise would change the order from seed to seed.
    """
    if not points:
        return []
    height, width = radiance.specular.shape[:2]
    columns, rows = np.array([point.bp_px for point in points]).astype(int).T
    at = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    direct = radiance.specular[at] + radiance.diffuse[at]
    values = (direct if direct.ndim == 1 else direct.mean(axis=1, dtype=np.float32)).tolist()
    shone = [replace(point, radiance=value) for point, value in zip(points, values, strict=True)]
    return sorted(shone, key=lambda point: -point.radiance)


def is_resolved(session: "Session") -> bool:
    """Return whether any part of the frame resolves the relief."""
    return bool((wave_px(session) >= LEAST_WAVE_PX).any())


def wave_px(session: "Session") -> Image:
    """Return how many pixels the relief's finest wave spans at each pixel, shape (H, W); NaN without a surface."""
    assert session.surface.relief is not None
    maps = session.misfits()
    distance = maps.distance[maps.margin : -maps.margin, maps.margin : -maps.margin]
    return session.surface.relief.finest_wave * max(session.camera.fx, session.camera.fy) / distance


def find_zeros(session: "Session", fine: bool) -> tuple[Array, IntArray]:
    """Find the zeros of all lights' misfits; return their pixels, shape (N, 2), and lights by index, shape (N,)."""
    count = len(session.scene.rig.lights)
    if fine:
        seeds = [_fine_seeds(session, light) for light in range(count)]
    else:
        maps = session.misfits(1 if session.surface.relief is not None else SMOOTH_STRIDE_PX)
        least = SPARED * MIN_GAIN * maps.stride / max(session.camera.fx, session.camera.fy)
        thin = _thin_parts(maps.distance)
        seeds = [
            maps.pixels(np.concatenate([grid_seeds(w[:, None], np.zeros((1, 2), dtype=np.int64), least), thin]))
            for w in maps.base
        ]
    zeros, lights = refine(session, np.concatenate(seeds), np.repeat(np.arange(count), list(map(len, seeds))), fine)
    # Whatever the steps taken, the points stand light by light and row by row.
    inside = np.flatnonzero(session.camera.contains(zeros))
    order = inside[np.lexsort((zeros[inside, 0], zeros[inside, 1], lights[inside]))]
    zeros, lights = zeros[order], lights[order]
    kept = first_of_each(zeros, SAME_PX["fine" if fine else "base"], lights)
    return zeros[kept], lights[kept]


def _fine_seeds(session: "Session", light: int) -> Array:
    """Return where a light's glints may be, shape (N, 2), px, in the part of the frame that resolves the relief."""
    waves = wave_px(session)
    resolved = waves >= LEAST_WAVE_PX
    if not resolved.any():
        return np.empty((0, 2))
    # As fine as most of the resolved part of the frame needs; where one cell a pixel will do its own maps serve.
    parts = int(np.clip(np.ceil(GRID_WAVE / np.percentile(waves[resolved][::8], 10)), 1, MAX_DIVISION))
    maps = session.misfits()
    w, first = maps.fine[light][:, None], np.zeros((1, 2), dtype=np.int64)
    if parts > 1:
        tiles = tiles_near_zeros(maps.fine[light])
        if not len(tiles):
            return np.empty((0, 2))
        w, first = session.tile_misfits(light, parts, tiles - maps.margin, TILE_PX), tiles * parts - 1
    seeds = (grid_seeds(w, first) + 0.5) / parts - maps.margin
    columns, rows = np.clip(seeds.astype(int), 0, np.array(waves.shape[::-1]) - 1).T
    return seeds[resolved[rows, columns]]


def tiles_near_zeros(w: Image) -> IntArray:
    """Return first columns and rows, (T, 2), of tiles where no component of `w` is farther from 0 than it varies."""
    # From one pixel before each tile to one after it.
    window = np.ones((TILE_PX + 2, TILE_PX + 2), np.uint8)

    def over_tiles(filtered: Callable[..., Image], missing: float) -> Image:
        known = np.where(np.isnan(w), np.float32(missing), w)
        return np.stack(
            [
                filtered(part, window, anchor=(1, 1), borderType=cv2.BORDER_REPLICATE)[::TILE_PX, ::TILE_PX]
                for part in known
            ]
        )

    low, high = over_tiles(cv2.erode, np.inf), over_tiles(cv2.dilate, -np.inf)
    slack = VARIES * (high - low)
    rows, columns = np.nonzero(((low <= slack) & (high >= -slack)).all(axis=0))
    return np.stack([columns, rows], axis=1) * TILE_PX


def grid_seeds(w: Image, first: IntArray, least_slope: float = 0.0) -> Array:
    """Return where a misfit's zeros may be, shape (N, 2), column and row in a map that is known in grids.

    The misfit is of shape (2, T, h, w); `first` are columns and rows, shape (T, 2), of the grids' first cells. Seeds
    are dropped where the misfit's slope along some direction is less than `least_slope` per cell.
    """
    blocks = range(0, len(first), max(1, CACHED // math.prod(w.shape[2:])))
    parts = [_candidates(w[:, at : at + blocks.step], first[at : at + blocks.step], least_slope) for at in blocks]
    seeds, is_stepped = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    # Row by row, whatever the grids; cells that hold a zero come before those near one.
    order = np.lexsort((*seeds.T, is_stepped))
    return seeds[order][first_of_each(seeds[order], SAME_SEED)]


def _candidates(w: Image, first: IntArray, least_slope: float) -> tuple[Array, Mask]:
    """Return the seeds of some grids, in any order and as often as they are found, and which are stepped to."""
    # Newton steps from central differences.
    inner = w[..., 1:-1, 1:-1]
    along_x = (w[..., 1:-1, 2:] - w[..., 1:-1, :-2]) / 2
    along_y = (w[..., 2:, 1:-1] - w[..., :-2, 1:-1]) / 2
    determinant = along_x[0] * along_y[1] - along_x[1] * along_y[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        step_x = (along_y[0] * inner[1] - along_y[1] * inner[0]) / determinant
        step_y = (along_x[1] * inner[0] - along_x[0] * inner[1]) / determinant
        short = np.nonzero((np.abs(step_x) < NEAR_CELLS) & (np.abs(step_y) < NEAR_CELLS))
    stepped = _places(short, first) + 1 + np.stack([step_x[short], step_y[short]], axis=1)
    # Cells in which the interpolated misfit has its zero, where differences over two pixels are too coarse.
    crossing, corners = crossed(w)
    seeds = np.concatenate([_places(crossing, first) + 0.5, stepped])
    is_stepped = np.arange(len(seeds)) >= len(crossing[0])
    if least_slope > 0:
        a, b, c, d = corners
        x = np.concatenate([(b - a + d - c) / 2, np.stack([part[short] for part in along_x])], axis=1)
        y = np.concatenate([(c - a + d - b) / 2, np.stack([part[short] for part in along_y])], axis=1)
        # The smaller singular value, without cancellation.
        area, squares = np.abs(x[0] * y[1] - x[1] * y[0]), np.sum(x**2 + y**2, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            steep = area * np.sqrt(2 / (squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0)))) > least_slope
        seeds, is_stepped = seeds[steep], is_stepped[steep]
    return seeds, is_stepped


def _thin_parts(distance: Image) -> IntArray:
    """Return columns and rows, shape (N, 2), of the cells of a surface that is too small there for differences."""
    seen = np.isfinite(distance).astype(np.uint8)
    rows, columns = np.nonzero(seen > cv2.morphologyEx(seen, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)))
    return np.stack([columns, rows], axis=1)


def _places(cells: tuple[IntArray, ...], first: IntArray) -> IntArray:
    """Return columns and rows in one map, shape (N, 2), of cells by grid, row and column."""
    grid, row, column = cells
    return np.stack([column, row], axis=1) + first[grid]


def refine(session: "Session", seeds: Array, lights: IntArray, fine: bool) -> tuple[Array, IntArray]:
    """Refine seeds of lights by index to zeros of the exact misfit; return those that converged, and their lights."""
    positions, longest = session.scene.rig.true_mm(), MAX_STEP_PX["fine" if fine else "base"]
    place, light = seeds, lights
    least, since = np.full(len(seeds), np.inf), np.zeros(len(seeds), dtype=np.int64)
    zeros, of_light = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    for number in range(NEWTON_STEPS):
        if not len(place):
            break
        state = exact_misfit(session, place, positions[light], fine, faceted=not fine)
        step = state.newton_steps()
        length = np.linalg.norm(step, axis=1)
        since += 1
        with np.errstate(invalid="ignore", divide="ignore"):
            fell = state.length < LEAST_FALL * least
            place = place + step * np.minimum(1.0, longest / np.where(length > 0, length, 1.0))[:, None]
        least[fell], since[fell] = state.length[fell], 0
        # What left the surface or cannot be solved has no step.
        going = np.isfinite(length) & (since < PATIENCE)
        done = going & (length < CONVERGED_PX)
        zeros.append(place[done])
        of_light.append(light[done])
        kept = np.flatnonzero(going & ~done)
        if number in MERGING:
            kept = kept[first_of_each(place[kept], MERGED_PX, light[kept])]
        place, light, least, since = place[kept], light[kept], least[kept], since[kept]
    return np.concatenate(zeros), np.concatenate(of_light)


FEW = 100
"""Pairs of no more points are tried one by one: a tree of them takes 0.15 s to load."""


def first_of_each(points: Array, apart: float, owners: IntArray | None = None) -> Mask:
    """Return which points, shape (N, 2), have no earlier one that stays, of the same owner, within a distance."""
    kept = [True] * len(points)
    if len(points) < 2:
        return np.array(kept, dtype=bool)
    # Owners are a coordinate along which they are farther apart.
    owned = points if owners is None else np.column_stack([points, 2 * apart * owners])
    if len(points) <= FEW:
        pairs = np.column_stack(np.triu_indices(len(points), 1))
        pairs = pairs[((owned[pairs[:, 0]] - owned[pairs[:, 1]]) ** 2).sum(axis=1) <= apart**2]
    else:
        from scipy.spatial import cKDTree

        pairs = np.sort(cKDTree(owned).query_pairs(apart, output_type="ndarray"), axis=1)
    for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if kept[i]:
            kept[j] = False
    return np.array(kept)


def describe(session: "Session", pixels: Array, lights: IntArray, fine: bool) -> list[HighlightPoint]:
    """Describe the highlight points at pixels, shape (N, 2), of lights by index, of the fine surface or the base."""
    if not len(pixels):
        return []
    points = session.exact_points(pixels, fine)
    lit = _is_lit(session, points.position, lights)
    return [
        HighlightPoint(
            light=int(lights[i]),
            bp_px=pixels[i],
            position=points.position[i],
            normal=points.normal[i],
            direction_min=points.direction_min[i],
            distance=float(points.distance[i]),
            kd_min=float(points.distance[i] * points.k_min[i]),
            kd_max=float(points.distance[i] * points.k_max[i]),
            normal_base=points.normal_base[i],
            kd_min_base=float(points.distance[i] * points.k_min_base[i]),
            kd_max_base=float(points.distance[i] * points.k_max_base[i]),
            pool=bool(points.pool[i]),
            lit=bool(lit[i]),
            radiance=0.0,
        )
        for i in np.flatnonzero(points.valid)
    ]


def _is_lit(session: "Session", positions: Array, lights: IntArray) -> Mask:
    """Return which points, shape (N, 3), camera frame, mm, their lights emit towards and reach unblocked."""
    rig, pose = session.scene.rig, session.surface.model_from_camera
    sources = rig.true_mm()
    towards = positions - sources[lights]
    distance = np.linalg.norm(towards, axis=1)
    directions = towards / distance[:, None]
    lit = np.zeros(len(lights), dtype=bool)
    for light in np.unique(lights):
        lit[lights == light] = rig.lights[light].factor(directions[lights == light]) > 0
    # Shadow rays from the lights; one at the camera reaches all that is seen.
    aside = np.flatnonzero(~np.array([is_at_camera(source) for source in sources])[lights])
    hits = session.exact_hits(session.to_model(sources[lights[aside]]), directions[aside] @ pose[:3, :3].T)
    # A blocker stands clearly in front of the point; the point's own triangle does not count.
    lit[aside] &= hits.distance > distance[aside] * (1 - 1e-3)
    return lit


def radii_px(session: "Session", highlights: Sequence[HighlightPoint]) -> Array:
    """Compute the radii, shape (N,), px, at which highlights fall to half height, from their shape alone (theory 7.3).

    The half-angle grows from the BP by the misfit's derivative J: a lobe of half-width w, rad, at half height covers
    pi w^2 / abs(det J) px^2; the radius is that of the circle of this area. The width is that of the place, wet or dry.
    Relief that is not resolved widens the lobe by its slopes, and a source by its size (theory 7.6), as if the lobe
    were Gaussian.
    """
    radii = np.full(len(highlights), np.nan)
    relief, rig, resolved = session.scene.surface.relief, session.scene.rig, not session.is_unresolved
    reflectance, fine = session.scene.reflectance, session.surface.relief
    own = [reflectance.half_width] * len(highlights)
    if isinstance(reflectance, TissueReflectance) and reflectance.film.patches is not None and highlights:
        assert fine is not None
        wet = fine.wet(session.to_model(np.array([highlight.position for highlight in highlights])))
        own = [reflectance.film.half_width(share) for share in wet.tolist()]
    if relief is not None and not resolved:
        own = [math.hypot(width, HALF_WIDTH * math.radians(relief.slope_deg)) for width in own]
    for index, (light, place) in enumerate(zip(rig.lights, rig.true_mm(), strict=True)):
        of_light = [i for i, highlight in enumerate(highlights) if highlight.light == index]
        if of_light:
            state = exact_misfit(session, np.array([highlights[i].bp_px for i in of_light]), place, fine=resolved)
            widths = np.array(own)[of_light]
            if light.source is not None:
                # The disc of the source's area, as the highlight points see it; the half-angle turns half as far.
                away = np.array([highlights[i].position for i in of_light]) - place
                reach = np.linalg.norm(away, axis=1)
                seen = light.source.area_mm2 / np.pi * np.abs(away @ light.axis) / reach
                widths = widened(widths, np.sqrt(seen) / (2 * reach))
            with np.errstate(divide="ignore"):
                radii[of_light] = widths / np.sqrt(np.abs(np.linalg.det(state.jacobian)))
    return radii


def widened(half_width: Array | float, disc: Array) -> Array:
    """Return the half-widths at half height of Gaussian lobes of some, convolved with discs of radii of shape (N,)."""
    sigma = half_width / HALF_WIDTH
    return np.asarray(np.where(disc > RATIOS[-1] * sigma, disc, sigma * np.interp(disc / sigma, RATIOS, _widths())))


@cache
def _widths() -> Array:
    """Return the half-widths of a lobe of deviation 1, convolved with discs of radii `RATIOS`."""
    from scipy.special import chndtr

    # At a distance r from its centre a disc of radius a holds the share P(a^2; 2, r^2) of a normal distribution.
    low, high = np.zeros_like(RATIOS), RATIOS + HALF_WIDTH
    half = chndtr(RATIOS**2, 2, 0.0) / 2
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        inside = chndtr(RATIOS**2, 2, middle**2) > half
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return low
