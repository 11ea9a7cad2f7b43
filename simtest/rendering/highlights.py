"""Highlight points: where the normal bisects the directions to a light and to the camera, sub-pixel.

The misfit w between normal and bisector is a two-vector field over the image. Newton steps find its zeros, starting
from the pixels whose own step lands next to them (theory.md sections 3 and 6).
"""

from dataclasses import fields
from typing import Any, Protocol

import cv2
import numpy as np

from simtest.geometry.camera import Camera
from simtest.geometry.vectors import tangent_basis
from simtest.rendering.frames import HighlightPoint, Radiance
from simtest.runtime.arrays import Array
from simtest.spec.scene import Scene
from simtest.surfaces.model import SurfacePoints

MIN_GAIN = 0.05
"""Where abs(1 + d k) is smaller the highlight is a streak, not a point: such seeds are dropped."""

NEWTON_STEPS = 30
DIFFERENCE_PX = 0.05
CONVERGED_PX = 1e-3
SAME_PX = 0.5
MAX_STEP_PX = 4.0
MAX_SEEDS = 4000

NEAR_CELLS = 2.0
"""A seed's own Newton step is shorter than this."""

ROUGH_CELLS, STEEP = 8.0, 0.15
"""Exact points are solved where the misfit of the rendered shape makes the step shorter than this, or changes by more
within a cell, as at an occluding edge: there any step may be short."""


class Caster(Protocol):
    """The part of a rendering session that the search needs."""

    scene: Scene
    camera: Camera

    def cast(self, points_px: Array) -> tuple[SurfacePoints, Array, Array]:
        """Return the exact points on the rays of pixels (see `Session.cast`)."""

    def cast_rendered(self, points_px: Array) -> tuple[Array, Array]:
        """Return points and normals of the rendered shape on the rays of pixels (see `Session.cast_rendered`)."""

    def lit(self, positions: Array, light: int) -> Any:
        """Return which points a light reaches (see `Session.lit`)."""


def misfit(position: Array, normal: Array, light: Array) -> Array:
    """Compute the normal minus the bisector of the directions to light and camera, across the sightline.

    Parameters
    ----------
    position, normal : ndarray, shape (N, 3)
        Points of a surface, mm, and its unit normals there, camera frame.
    light : ndarray, shape (3,)
        Camera frame, mm.

    Returns
    -------
    ndarray, shape (N, 2)
        Zero exactly where the normal is the bisector; NaN where there is no surface.
    """
    to_camera = -position / np.linalg.norm(position, axis=1, keepdims=True)
    to_light = light - position
    to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
    bisector = to_camera + to_light
    bisector /= np.linalg.norm(bisector, axis=1, keepdims=True)
    first, second = tangent_basis(to_camera)
    gap = normal - bisector
    return np.stack([np.sum(first * gap, axis=1), np.sum(second * gap, axis=1)], axis=1)


def find(session: Caster, radiance: Radiance, stride: int) -> list[HighlightPoint]:
    """Find the highlight points of all lights in view, the brightest first.

    `radiance` is that of the same frame; the seeds' grid has a spacing of `stride` px.
    """
    camera = session.camera
    lights = session.scene.rig.true_mm()
    pixels, points = _seed_grid(session, stride, lights)
    found = []
    for index, light in enumerate(lights):
        # Candidates: pixels of the grid whose own Newton step is short.
        seeds = _seeds(pixels, points, light, stride)
        # Refine on the exact surface.
        solutions = _newton(session, seeds, light)
        # Reject what left the frame and what was found twice.
        solutions = _distinct(solutions[camera.contains(solutions)])
        if len(solutions):
            found += describe(session, radiance, solutions, index)
    return brightest_first(found)


def brightest_first(found: list[HighlightPoint]) -> list[HighlightPoint]:
    """Sort highlight points by the radiance of their pixels."""
    return sorted(found, key=lambda highlight: -highlight.radiance)


def _seed_grid(session: Caster, stride: int, lights: Array) -> tuple[Array, SurfacePoints]:
    """Return pixel centres on a grid, shape (h, w, 2), with their exact points, flattened, where there may be seeds.

    Elsewhere the points are NaN: an exact point costs tens of times one of the rendered shape, and seeds are few.
    """
    camera = session.camera
    pixels = camera.pixel_centres()[stride // 2 :: stride, stride // 2 :: stride]
    height, width = pixels.shape[:2]
    centres = pixels.reshape(-1, 2)
    asked = np.ones((height, width), dtype=bool)
    if min(height, width) >= 3:
        position, normal = session.cast_rendered(centres)
        asked[:] = False
        for light in lights:
            asked |= _may_be_near(misfit(position, normal, light).reshape(height, width, 2))
    chosen = asked.ravel()
    found = session.cast(centres[chosen])[0]
    return pixels, SurfacePoints(**{f.name: _spread(getattr(found, f.name), chosen) for f in fields(found)})


def _spread(values: Any, chosen: Any) -> Any:
    """Spread rows over the chosen indices of a longer table; the others are NaN, or False."""
    table = np.full((len(chosen), *values.shape[1:]), False if values.dtype == bool else np.nan, dtype=values.dtype)
    table[chosen] = values
    return table


def _may_be_near(w: Array) -> Any:
    """Return on which pixels of a grid, shape (h, w), the seeds depend on exact points."""
    along_x, along_y, step_x, step_y = _newton_steps(w)
    with np.errstate(invalid="ignore"):
        short = np.hypot(step_x, step_y) < ROUGH_CELLS
        smooth = (np.abs(along_x) < STEEP).all(axis=-1) & (np.abs(along_y) < STEEP).all(axis=-1)
    on_surface = np.isfinite(w).all(axis=-1)
    # Pixels around: the triangles' misfit may be off by up to a cell, and a step reads its neighbours.
    around = np.ones((5, 5), np.uint8)
    return cv2.dilate((on_surface & (short | ~smooth)).astype(np.uint8), around) > 0


def _newton_steps(w: Array) -> tuple[Array, Array, Array, Array]:
    """Return the misfit's change per cell along x and y, (h, w, 2) each, and the steps to its zero, cells, (h, w)."""
    along_y, along_x = np.asarray(np.gradient(w, axis=0)), np.asarray(np.gradient(w, axis=1))
    determinant = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        step_x = (along_y[..., 1] * w[..., 0] - along_y[..., 0] * w[..., 1]) / determinant
        step_y = (along_x[..., 0] * w[..., 1] - along_x[..., 1] * w[..., 0]) / determinant
    return along_x, along_y, step_x, step_y


def _seeds(pixels: Array, points: SurfacePoints, light: Array, stride: int) -> Array:
    """Return where the Newton steps of grid points lead, shape (N, 2), px, for steps shorter than two cells."""
    height, width = pixels.shape[:2]
    if min(height, width) < 3:
        return np.empty((0, 2))
    _, _, step_x, step_y = _newton_steps(misfit(points.position, points.normal, light).reshape(height, width, 2))
    with np.errstate(invalid="ignore"):
        near = np.hypot(step_x, step_y) < NEAR_CELLS
    # Streaks are no points.
    gain = np.minimum(np.abs(1 + points.distance * points.k_min), np.abs(1 + points.distance * points.k_max))
    near &= gain.reshape(height, width) > MIN_GAIN
    seeds = pixels[near] - stride * np.stack([step_x[near], step_y[near]], axis=1)
    return _distinct(seeds)[:MAX_SEEDS]


def _newton(session: Caster, seeds: Array, light: Array) -> Array:
    """Refine seeds to zeros of the misfit; return those that converged, shape (M, 2), px."""
    # Active seeds take a Newton step with derivatives from a stencil of five rays.
    position = seeds.copy()
    step_length = np.full(len(position), np.inf)
    offsets = DIFFERENCE_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for _ in range(NEWTON_STEPS):
        active = np.flatnonzero(~(step_length < CONVERGED_PX / 100))
        if not len(active):
            break
        stencil = (position[active, None, :] + offsets).reshape(-1, 2)
        points = session.cast(stencil)[0]
        # Jacobian from central differences.
        w = misfit(points.position, points.normal, light).reshape(-1, 5, 2)
        along_x = (w[:, 1] - w[:, 2]) / (2 * DIFFERENCE_PX)
        along_y = (w[:, 3] - w[:, 4]) / (2 * DIFFERENCE_PX)
        J = np.stack([along_x, along_y], axis=-1)
        determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        solvable = np.isfinite(determinant) & (np.abs(determinant) > 1e-18)
        step = np.full((len(active), 2), np.nan)
        step[solvable] = -np.linalg.solve(J[solvable], w[solvable, 0, :, None])[..., 0]
        length = np.linalg.norm(step, axis=1)
        # Limit the step; a seed may be the solution already, and its step 0.
        with np.errstate(invalid="ignore", divide="ignore"):
            step *= np.minimum(1.0, MAX_STEP_PX / length)[:, None]
        position[active] += step
        step_length[active] = length
        # Drop what left the surface or cannot be solved.
        keep = np.isfinite(position).all(axis=1)
        position, step_length = position[keep], step_length[keep]
    return position[step_length < CONVERGED_PX]


def _distinct(points: Array) -> Array:
    """Keep one of the points that lie within half a pixel of each other."""
    kept: list[Array] = []
    # Hash points into cells, so that only neighbours are compared.
    cells: dict[tuple[int, int], list[Array]] = {}
    for point in points[np.isfinite(points).all(axis=1)]:
        cell = (int(point[0] // SAME_PX), int(point[1] // SAME_PX))
        around = [p for i in (-1, 0, 1) for j in (-1, 0, 1) for p in cells.get((cell[0] + i, cell[1] + j), [])]
        if all(np.hypot(*(point - other)) > SAME_PX for other in around):
            cells.setdefault(cell, []).append(point)
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def describe(session: Caster, radiance: Radiance, solutions: Array, light: int) -> list[HighlightPoint]:
    """Describe the highlight points of a light at their pixels, shape (N, 2), with the frame's radiance."""
    points, _, _ = session.cast(solutions)
    lit = session.lit(points.position, light)
    # Radiance at the pixel that holds the point.
    total = radiance.intensity
    columns = np.clip(solutions[:, 0].astype(int), 0, session.camera.width - 1)
    rows = np.clip(solutions[:, 1].astype(int), 0, session.camera.height - 1)
    return [
        HighlightPoint(
            light=light,
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
