"""Highlight points: where the normal bisects the directions to a light and to the camera, sub-pixel.

The misfit w between normal and bisector is a two-vector field over the image, and Newton steps find its zeros. Without
relief they start from the pixels whose own step is short (theory.md sections 3 and 6), for all lights together: one
launch shows where to look, and each step solves the exact points of all seeds at once.

On a surface with relief the zeros are glints (theory.md 7.1), hundreds a frame, and small. The misfit of the rendered
frame, a value a pixel, shows where a zero is near; exact Newton steps with the closed derivative of the fine normal
finish. The search is not exhaustive (docs/reference/limits.md says how many it misses).

Where the points lie does not depend on the light that reaches the camera, and the search is a large part of a frame:
a session searches once while surface, camera and rig stay, and frames give the points their radiance.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from simtest.rendering.frames import HighlightPoint, Radiance
from simtest.rendering.misfits import MisfitGrid, crossed, exact_misfit, turned_pixels
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.surfaces import AnatomySurface

if TYPE_CHECKING:
    from simtest.geometry.camera import Camera
    from simtest.rendering.session import Session


MIN_GAIN = 0.05
"""Where abs(1 + d k) is smaller the highlight is a streak, not a point: such seeds are dropped."""

NEWTON_STEPS = 30
CONVERGED_PX = 1e-5
PATIENCE, LEAST_FALL = 5, 0.7
"""A seed whose least misfit has not fallen to this share within so many steps strays, and is given up."""

SAME_PX = 0.5
MAX_STEP_PX = 4.0
MAX_SEEDS = 4000
"""Of each light."""

NEAR_CELLS = 2.0
"""A pixel of the grid is a seed where its own Newton step is shorter than this."""

MERGING, MERGED_PX = (1, 2, 4, 8), 0.05
"""After these steps, seeds of one light that are closer than this have met."""


def find_smooth(session: "Session", radiance: Radiance, stride: int) -> list[HighlightPoint]:
    """Find all lights' highlight points without relief, the brightest first; seeds are `stride` px apart."""
    lights = session.scene.rig.true_mm()
    # Candidates: where the Newton steps of the rendered shape are short.
    seeds, owners = _seeds(session.misfit_grid(stride), session.camera)
    # Refine on the exact surface.
    solutions, owners = _newton(session, seeds, owners, lights)
    # Reject what left the frame and what was found twice.
    inside = session.camera.contains(solutions)
    solutions, owners = solutions[inside], owners[inside]
    kept = _first_of_each(solutions, SAME_PX, owners)
    return brightest_first(describe(session, radiance, solutions[kept], owners[kept], fine=False))


def brightest_first(found: list[HighlightPoint]) -> list[HighlightPoint]:
    """Sort highlight points by the radiance of their pixels."""
    return sorted(found, key=lambda highlight: -highlight.radiance)


def _seeds(grid: MisfitGrid, camera: "Camera") -> tuple[Array, IntArray]:
    """Return pixel positions, shape (N, 2), from which to search, and their lights, shape (N,)."""
    seeds, owners = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    limit = NEAR_CELLS * grid.stride / min(camera.fx, camera.fy)
    # Streaks are no points.
    is_point = grid.gain > MIN_GAIN
    for light, (w, steps) in enumerate(zip(grid.w, grid.steps, strict=True)):
        # Where a short step leads.
        with np.errstate(invalid="ignore", over="ignore"):
            rows, columns = np.nonzero((steps[0] ** 2 + steps[1] ** 2 < limit**2) & is_point)
        turns = steps[:, rows, columns].T.astype(float)
        near = turned_pixels(camera, grid.pixels(rows, columns), turns)
        # The middle of a cell that holds a zero, to which no step may lead where the misfit bends.
        rows, columns = crossed(w)
        held = is_point[rows, columns]
        rows, columns = rows[held], columns[held]
        own = np.concatenate([near, grid.pixels(rows + 0.5, columns + 0.5)])
        own = own[np.isfinite(own).all(axis=1)]
        own = own[_first_of_each(own, SAME_PX)][:MAX_SEEDS]
        seeds.append(own)
        owners.append(np.full(len(own), light))
    return np.concatenate(seeds), np.concatenate(owners)


def _newton(session: "Session", seeds: Array, owners: IntArray, lights: Array) -> tuple[Array, IntArray]:
    """Refine seeds of lights by index to zeros of the misfit; return those that converged, px, and their lights."""
    position, light = seeds, owners
    least, since = np.full(len(seeds), np.inf), np.zeros(len(seeds), dtype=np.int64)
    found, of_light = [np.empty((0, 2))], [np.empty(0, dtype=np.int64)]
    for number in range(NEWTON_STEPS):
        if not len(position):
            break
        state = exact_misfit(session, position, lights[light], fine=False, faceted=True)
        step = state.newton_steps()
        length = np.linalg.norm(step, axis=1)
        since += 1
        with np.errstate(invalid="ignore"):
            fell = state.length < LEAST_FALL * least
        least[fell], since[fell] = state.length[fell], 0
        # What left the surface or cannot be solved has no step.
        going = np.isfinite(length) & (since < PATIENCE)
        with np.errstate(invalid="ignore", divide="ignore"):
            position = position + step * np.minimum(1.0, MAX_STEP_PX / np.where(length > 0, length, 1.0))[:, None]
        done = going & (length < CONVERGED_PX)
        found.append(position[done])
        of_light.append(light[done])
        kept = np.flatnonzero(going & ~done)
        if number in MERGING:
            kept = kept[_first_of_each(position[kept], MERGED_PX, light[kept])]
        position, light, least, since = position[kept], light[kept], least[kept], since[kept]
    return np.concatenate(found), np.concatenate(of_light)


def describe(
    session: "Session", radiance: Radiance, solutions: Array, lights: IntArray, fine: bool = True
) -> list[HighlightPoint]:
    """Describe the highlight points at pixels, shape (N, 2), of lights by index, of the `fine` surface or the base."""
    if not len(solutions):
        return []
    points = session.exact_points(solutions, fine)
    lit = np.zeros(len(lights), dtype=bool)
    for light in np.unique(lights):
        lit[lights == light] = session.lit(points.position[lights == light], int(light))
    # Radiance at the pixel that holds the point.
    total = radiance.intensity
    columns = np.clip(solutions[:, 0].astype(int), 0, session.camera.width - 1)
    rows = np.clip(solutions[:, 1].astype(int), 0, session.camera.height - 1)
    return [
        HighlightPoint(
            light=int(lights[i]),
            bp_px=solutions[i],
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
            radiance=float(total[rows[i], columns[i]]),
        )
        for i in np.flatnonzero(points.valid)
    ]


NEAR_PX = 1.5
"""A cell of the seeds' grid whose own Newton step is shorter than so many cells is a seed."""

GRID_WAVE = 12.0
"""Steps of the seeds' grid per wave of the finest band; pixels that are wider are divided."""

TILE_PX, VARIES = 4, 0.3
"""Pixels along the side of the tiles that are divided: those in which no component of the misfit is farther from 0 than
this share of its range over the tile and the pixels round it."""

MAX_DIVISION = 8
LEAST_WAVE_PX = 1.5
"""Pixels are divided by at most this. Relief whose waves are shorter than this many px is not resolved there, and acts
as roughness."""

GLINT_STEPS = 40
PATIENT_STEPS, LEAST_GLINT_FALL = 5, 0.7
"""After so many steps each one must lower the misfit to this share."""

MAX_GLINT_STEP_PX = 2.0
ZERO = 1e-9
"""A glint's fine normal is the bisector to within this, rad."""

SAME_GLINT_PX = 0.02
"""Glints closer than this are the same zero, found twice."""

SAME_SEED_PX = 0.5

HALF_WIDTH = math.sqrt(2 * math.log(2))
"""Half-width at half height of a Gaussian over its standard deviation."""

RATIOS, BISECTIONS = np.geomspace(1e-3, 30.0, 200), 40
"""Radii of discs over a lobe's standard deviation: less widens nothing, more is the disc alone."""


def is_resolved(session: "Session") -> bool:
    """Return whether any part of the frame resolves the relief."""
    return bool((wave_px(session) >= LEAST_WAVE_PX).any())


def find_glints(session: "Session", radiance: Radiance) -> list[HighlightPoint]:
    """Search for all lights' glints where the frame resolves the relief; return them, the brightest first."""
    found = []
    for index in range(len(session.scene.rig.lights)):
        pixels = search_glints(session, index)
        if len(pixels):
            found += describe(session, radiance, pixels, np.full(len(pixels), index))
    return brightest_first(found)


def search_glints(session: "Session", index: int) -> Array:
    """Search for the glints of the light of an index; return their pixels, shape (N, 2)."""
    # Seeds: pixels whose own Newton step is short.
    seeds, light = _glint_seeds(session, index), session.scene.rig.true_mm()[index]
    # Refine on the exact surface; seeds of one zero meet.
    found = _glint_zeros(session, seeds, light)
    return distinct(found[session.camera.contains(found)], SAME_GLINT_PX)


def wave_px(session: "Session") -> Image:
    """Return how many pixels the relief's finest wave spans at each pixel, shape (H, W); NaN without a surface."""
    assert session.surface.relief is not None
    maps = session.misfits()
    distance = maps.distance[maps.margin : -maps.margin, maps.margin : -maps.margin]
    return session.surface.relief.finest_wave * max(session.camera.fx, session.camera.fy) / distance


def _glint_seeds(session: "Session", index: int) -> Array:
    """Return where short Newton steps of the grid lead, shape (N, 2), px, where the frame resolves the relief."""
    waves = wave_px(session)
    resolved = waves >= LEAST_WAVE_PX
    if not resolved.any():
        return np.empty((0, 2))
    # As fine as most of the resolved part of the frame needs; where one cell a pixel will do its own maps serve.
    parts = int(np.clip(np.ceil(GRID_WAVE / np.percentile(waves[resolved][::8], 10)), 1, MAX_DIVISION))
    maps = session.misfits()
    w, margin = maps.fine[index][:, None], maps.margin
    first = np.zeros((1, 2), dtype=np.int64)
    if parts > 1:
        tiles = tiles_near_zeros(maps.fine[index])
        if not len(tiles):
            return np.empty((0, 2))
        w, first = session.tile_misfits(index, parts, tiles - margin, TILE_PX), tiles * parts - 1
    seeds = _grid_seeds(w, first, margin * parts, parts)
    height, width = waves.shape
    rows, columns = (np.clip(seeds[:, axis].astype(int), 0, size - 1) for axis, size in ((1, height), (0, width)))
    return seeds[resolved[rows, columns]]


def tiles_near_zeros(w: Image) -> IntArray:
    """Return first columns and rows, (T, 2), of tiles where no component of `w` is farther from 0 than it varies."""
    low, high = w, w
    for axis in (1, 2):
        # From one pixel before each tile to one after it.
        count = -(-w.shape[axis] // TILE_PX)
        wide = [(0, 0), (0, 0), (0, 0)]
        wide[axis] = (1, count * TILE_PX + 1 - w.shape[axis])
        low, high = np.pad(low, wide, mode="edge"), np.pad(high, wide, mode="edge")
        windows = [np.arange(count) * TILE_PX + offset for offset in range(TILE_PX + 2)]
        low = np.fmin.reduce([np.take(low, own, axis=axis) for own in windows])
        high = np.fmax.reduce([np.take(high, own, axis=axis) for own in windows])
    slack = VARIES * (high - low)
    rows, columns = np.nonzero(((low <= slack) & (high >= -slack)).all(axis=0))
    return np.stack([columns, rows], axis=1) * TILE_PX


def _grid_seeds(w: Image, first: IntArray, margin: int, parts: int) -> Array:
    """Return the seeds, shape (N, 2), px, of grids of a misfit of pixels divided into `parts`.

    The misfit is of shape (2, T, h, w). `first` are columns and rows, shape (T, 2), of the grids' first cells in a map
    that begins `margin` cells before the frame.
    """
    # Newton steps from central differences.
    inner = w[..., 1:-1, 1:-1]
    along_x = (w[..., 1:-1, 2:] - w[..., 1:-1, :-2]) / 2
    along_y = (w[..., 2:, 1:-1] - w[..., :-2, 1:-1]) / 2
    determinant = along_x[0] * along_y[1] - along_x[1] * along_y[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        step_x = (along_y[0] * inner[1] - along_y[1] * inner[0]) / determinant
        step_y = (along_x[1] * inner[0] - along_x[0] * inner[1]) / determinant
        short = (np.abs(step_x) < NEAR_PX) & (np.abs(step_y) < NEAR_PX)
    cells, order = _in_rows(np.nonzero(short), first)
    stepped = cells + 1.5 + np.stack([step_x[short], step_y[short]], axis=1)[order]
    # Cells in which the interpolated misfit has its zero, where differences over two pixels are too coarse.
    crossing, _ = _in_rows(crossed(w), first)
    seeds = (np.concatenate([crossing + 1.0, stepped]) - margin) / parts
    return distinct(seeds, SAME_SEED_PX / parts)


def _in_rows(cells: tuple[IntArray, ...], first: IntArray) -> tuple[IntArray, IntArray]:
    """Return columns and rows in one map of cells by grid, row and column, row by row whatever the grids; the order."""
    grid, row, column = cells
    whole = np.stack([column, row], axis=1) + first[grid]
    order = np.lexsort((whole[:, 0], whole[:, 1]))
    return whole[order], order


def _glint_zeros(session: "Session", seeds: Array, light: Array) -> Array:
    """Refine seeds to zeros of the misfit; return those that converged, shape (M, 2), px."""
    position, finished = seeds, []
    before = np.full(len(seeds), np.inf)
    for number in range(GLINT_STEPS):
        if not len(position):
            break
        state = exact_misfit(session, position, light)
        done = state.length < ZERO
        finished.append(position[done])
        # Near a zero the misfit falls with the square; a seed that still strays has none.
        falling = (state.length < LEAST_GLINT_FALL * before) if number >= PATIENT_STEPS else np.isfinite(state.length)
        with np.errstate(invalid="ignore"):
            determinant = np.abs(np.linalg.det(state.jacobian))
            going = ~done & falling & np.isfinite(state.length) & (determinant > 1e-18)
        step = -np.linalg.solve(state.jacobian[going], state.w[going, :, None])[..., 0]
        step *= np.minimum(1.0, MAX_GLINT_STEP_PX / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        position, before = position[going] + step, state.length[going]
        # Seeds of one zero have met after a few steps.
        if number in (2, 4):
            kept = _first_of_each(position, SAME_GLINT_PX / 4)
            position, before = position[kept], before[kept]
    return np.concatenate(finished) if finished else np.empty((0, 2))


def radii_px(session: "Session", highlights: Sequence[HighlightPoint], half_width: float) -> Array:
    """Compute the radii, shape (N,), px, at which highlights fall to half height, from their shape alone (theory 7.3).

    The half-angle grows from the BP by the misfit's derivative J: a lobe of half-width `half_width`, rad, at half
    height covers pi half_width^2 / abs(det J) px^2; the radius is that of the circle of this area. Relief that is not
    resolved widens the lobe by its slopes, and a source by its size (theory 7.6), as if the lobe were Gaussian.
    """
    radii = np.full(len(highlights), np.nan)
    relief, rig, resolved = session.scene.surface.relief, session.scene.rig, not session.is_unresolved
    if relief is not None and not resolved:
        half_width = math.hypot(half_width, HALF_WIDTH * math.radians(relief.slope_deg))
    for index, (light, place) in enumerate(zip(rig.lights, rig.true_mm(), strict=True)):
        own = [i for i, highlight in enumerate(highlights) if highlight.light == index]
        if own:
            state = exact_misfit(session, np.array([highlights[i].bp_px for i in own]), place, fine=resolved)
            widths = np.full(len(own), half_width)
            if light.source is not None:
                # The disc of the source's area, as the highlight points see it; the half-angle turns half as far.
                away = np.array([highlights[i].position for i in own]) - place
                reach = np.linalg.norm(away, axis=1)
                seen = light.source.area_mm2 / np.pi * np.abs(away @ light.axis) / reach
                widths = widened(half_width, np.sqrt(seen) / (2 * reach))
            with np.errstate(divide="ignore"):
                radii[own] = widths / np.sqrt(np.abs(np.linalg.det(state.jacobian)))
    return radii


def widened(half_width: float, disc: Array) -> Array:
    """Return the half-widths at half height of a Gaussian lobe of one, convolved with discs of radii of shape (N,)."""
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


def distinct(points: Array, apart: float) -> Array:
    """Keep one of the finite points, shape (N, 2), that lie within `apart` of each other."""
    points = points[np.isfinite(points).all(axis=1)]
    return points[_first_of_each(points, apart)]


def _first_of_each(points: Array, apart: float, owners: IntArray | None = None) -> Mask:
    """Return which points, shape (N, 2), have no earlier one that stays, of the same owner, within a distance."""
    kept = np.ones(len(points), dtype=bool)
    if len(points) < 2:
        return kept
    from scipy.spatial import cKDTree

    pairs = np.sort(cKDTree(points).query_pairs(apart, output_type="ndarray"), axis=1)
    if owners is not None:
        pairs = pairs[owners[pairs[:, 0]] == owners[pairs[:, 1]]]
    for i, j in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if kept[i]:
            kept[j] = False
    return kept


FINE_STRIDE_PX = 2
"""Seeds' grid for anatomies, whose highlights are small and many."""

COARSE_STRIDE_PX = 4
"""Seeds' grid for analytic surfaces."""


def search(session: "Session", base: bool) -> list[HighlightPoint]:
    """Find all lights' highlight points, of the base or of the fine surface, in a dark frame, as they come."""
    camera = session.camera
    dark = np.zeros((camera.height, camera.width), dtype=np.float32)
    radiance = Radiance(dark, dark, dark)
    if session.surface.relief is not None and not base:
        return find_glints(session, radiance)
    stride = FINE_STRIDE_PX if isinstance(session.scene.surface, AnatomySurface) else COARSE_STRIDE_PX
    return find_smooth(session, radiance, stride=stride)


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
    shone = (replace(point, radiance=value) for point, value in zip(points, values, strict=True))
    return brightest_first(list(shone))
