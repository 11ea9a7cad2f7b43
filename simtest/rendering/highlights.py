"""Highlight points: where the normal bisects the directions to a light and to the camera, sub-pixel.

The misfit w between normal and bisector is a two-vector field over the image. Newton steps find its zeros, starting
from the pixels whose own step is short (theory.md sections 3 and 6). All lights are searched for together: one launch
shows where to look, and each step solves the exact points of all seeds at once.
"""

from typing import TYPE_CHECKING

import numpy as np

from simtest.rendering.exact_misfit import exact_misfit
from simtest.rendering.frames import HighlightPoint, Radiance
from simtest.rendering.misfit_grid import MisfitGrid, crossed, turned_pixels
from simtest.runtime.arrays import Array, IntArray, Mask

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


def find(session: "Session", radiance: Radiance, stride: int) -> list[HighlightPoint]:
    """Find the highlight points of all lights in view, without any relief, the brightest first.

    `radiance` is that of the same frame; the seeds' grid has a spacing of `stride` px.
    """
    lights = session.scene.rig.true_mm()
    # Candidates: where the Newton steps of the rendered shape are short.
    seeds, owners = _seeds(session.misfit_grid(stride), session.camera)
    # Refine on the exact surface.
    solutions, owners = _newton(session, seeds, owners, lights)
    # Reject what left the frame and what was found twice.
    inside = session.camera.contains(solutions)
    solutions, owners = solutions[inside], owners[inside]
    kept = _first_of_each(solutions, owners, SAME_PX)
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
        own = own[_first_of_each(own, np.zeros(len(own), dtype=np.int64), SAME_PX)][:MAX_SEEDS]
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
            kept = kept[_first_of_each(position[kept], light[kept], MERGED_PX)]
        position, light, least, since = position[kept], light[kept], least[kept], since[kept]
    return np.concatenate(found), np.concatenate(of_light)


def _first_of_each(points: Array, owners: IntArray, apart: float) -> Mask:
    """Return which points, shape (N, 2), have no earlier one that stays of the same owner within a distance."""
    kept = np.zeros(len(points), dtype=bool)
    # Hash points into cells, so that only neighbours are compared.
    cells: dict[tuple[int, int, int], list[tuple[float, float]]] = {}
    for i, ((x, y), owner) in enumerate(zip(points.tolist(), owners.tolist(), strict=True)):
        column, row = int(x // apart), int(y // apart)
        around = [p for a in (-1, 0, 1) for b in (-1, 0, 1) for p in cells.get((owner, column + a, row + b), ())]
        if all((x - p) ** 2 + (y - q) ** 2 > apart**2 for p, q in around):
            cells.setdefault((owner, column, row), []).append((x, y))
            kept[i] = True
    return kept


def describe(
    session: "Session", radiance: Radiance, solutions: Array, lights: IntArray, fine: bool = True
) -> list[HighlightPoint]:
    """Describe the highlight points at pixels, shape (N, 2), of lights by their index, with the frame's radiance.

    Normals and curvatures are those of the `fine` surface, or else of its base.
    """
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
