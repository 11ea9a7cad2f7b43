"""The misfit between normal and bisector: exact with its derivative, and traced where a search has to begin."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.geometry.vectors import tangent_basis
from simtest.rendering.backend import dr, mi
from simtest.rendering.frames import MisfitMaps
from simtest.rendering.trace import LANES, Tracer, blocks_of, evaluate
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.surfaces.model import shape_operator
from simtest.surfaces.relief_field import normal_derivative

if TYPE_CHECKING:
    from simtest.rendering.session import Session


DIFFERENCE_PX = 1e-2
"""Pixel positions are moved by this to find how sightlines turn: a lens has no closed derivative."""


@dataclass(frozen=True)
class Misfit:
    """Misfit between normal and bisector at pixel positions."""

    w: Array  # (N, 2): its components across the sightline
    jacobian: Array  # (N, 2, 2): their derivatives along the image's axes, 1/px
    length: Array  # (N,): of the whole misfit, rad: abs(tau) of theory.md section 7

    def newton_steps(self) -> Array:
        """Return the steps to the zeros of the linear misfit, shape (N, 2), px; NaN where there is none."""
        (a, b), (c, d) = self.jacobian[:, 0].T, self.jacobian[:, 1].T
        determinant = a * d - b * c
        with np.errstate(divide="ignore", invalid="ignore"):
            determinant = np.where(np.abs(determinant) > LEAST_DETERMINANT, determinant, np.nan)
        first, second = self.w.T
        return np.stack([b * second - d * first, c * first - a * second], axis=1) / determinant[:, None]


LEAST_DETERMINANT = 1e-18
"""A Jacobian of less, 1/px^2, is singular."""


def exact_misfit(
    session: "Session", points_px: Array, lights: Array, fine: bool = True, faceted: bool = False
) -> Misfit:
    """Compute the exact misfit at pixel positions, shape (N, 2), and its derivative, in the model frame.

    `lights`, shape (3,) or (N, 3), camera frame, mm, is the light of all positions, or of each. The normal is that of
    the relief, where there is one, if `fine`, or else the base's. With `faceted` the normals of a user's mesh change as
    they do within its triangles, instead of by the fitted curvatures: the former leads Newton's method to its zeros,
    the latter is the truth.
    """
    origins, r, turns = _sightlines(session, points_px)
    hits = session.exact_hits(origins, r)
    base = session.base_points(origins, r, hits)
    N, position, relief = base.normal, base.position, session.surface.relief
    plane, derivative = session.surface.motion(base, hits) if faceted else (N, shape_operator(base))
    normal = N
    if fine and relief is not None:
        jets = relief.jets(np.where(base.valid[:, None], position, 0.0))
        normal, derivative = normal_derivative(N, derivative, jets)
    # Bisector of the directions to camera and light.
    towards = session.to_model(np.atleast_2d(lights)) - position
    reach = _length(towards)
    towards /= reach
    both = towards - r
    size = _length(both)
    bisector = both / size
    gap = normal - bisector
    # Derivatives along the image's axes: of the point on its plane, of the normal, of the bisector.
    first, second = tangent_basis(-r)
    columns = []
    for turn in turns:
        slant = _dot(plane, turn) / _dot(plane, r)
        moved = base.distance[:, None] * (turn - r * slant)
        bent = np.einsum("nij,nj->ni", derivative, moved)
        swing = -(moved - towards * _dot(towards, moved)) / reach - turn
        swing = (swing - bisector * _dot(bisector, swing)) / size
        change = bent - swing
        columns.append(np.stack([np.einsum("ni,ni->n", e, change) for e in (first, second)], axis=1))
    w = np.stack([np.einsum("ni,ni->n", e, gap) for e in (first, second)], axis=1)
    return Misfit(w, np.stack(columns, axis=-1), _length(gap)[:, 0])


def _sightlines(session: "Session", points_px: Array) -> tuple[Array, Array, list[Array]]:
    """Return origins and directions of pixel positions, model frame, and how the directions turn along both axes."""
    moves = DIFFERENCE_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    origins, all_directions = session.sightlines.in_model((points_px + moves[:, None]).reshape(-1, 2))
    r, right, left, down, up = all_directions.reshape(5, -1, 3)
    return origins[: len(r)], r, [(right - left) / (2 * DIFFERENCE_PX), (down - up) / (2 * DIFFERENCE_PX)]


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("ni,ni->n", a, b)[:, None])


def _length(vectors: Array) -> Array:
    return np.sqrt(_dot(vectors, vectors))


def crossed(w: Image) -> tuple[tuple[IntArray, ...], list[Image]]:
    """Return the cells in which the linear misfit of a triangle half has its zero: (grid,) row and column; corners."""
    corners = [w[..., :-1, :-1], w[..., :-1, 1:], w[..., 1:, :-1], w[..., 1:, 1:]]
    with np.errstate(invalid="ignore"):
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        cells = np.nonzero(((low <= 0) & (high >= 0)).all(axis=0))
    a, b, c, d = corners = [np.stack([part[cells] for part in corner]) for corner in corners]

    def inside(*triangle: Image) -> Mask:
        p, q, r = triangle
        signs = np.stack([u[0] * v[1] - u[1] * v[0] for u, v in ((p, q), (q, r), (r, p))])
        return np.asarray((signs >= 0).all(axis=0) | (signs <= 0).all(axis=0))

    holds_zero = inside(a, b, c) | inside(b, d, c)
    return tuple(index[holds_zero] for index in cells), [corner[:, holds_zero] for corner in corners]


MARGIN = 2
"""Cells by which maps of the frame reach beyond it."""


def trace_misfits(tracer: Tracer, lights: Array, stride: int) -> MisfitMaps:
    """Trace the misfits for lights, shape (L, 3), camera frame, mm, at the centres of every `stride`-th pixel."""
    camera = tracer.sightlines.camera
    height, width = (len(range(stride // 2, size, stride)) + 2 * MARGIN for size in (camera.height, camera.width))
    sources = [mi.Vector3f(*light.tolist()) for light in lights]
    spacing, half, across = mi.Float(stride), mi.Float(stride // 2 + PIXEL_CENTRE), mi.UInt32(width)
    dr.make_opaque(sources, spacing, half, across)
    surfaces = 1 if tracer.relief is None else 2
    channels = np.empty((1 + surfaces * len(lights) * 2, height * width), dtype=np.float32)
    for first, count in blocks_of(height * width):
        start = mi.UInt32(first)
        dr.make_opaque(start)
        index = dr.arange(mi.UInt32, count) + start
        row = index // across
        x, y = ((mi.Float(i) - MARGIN) * spacing + half for i in (index - row * across, row))
        found = evaluate(_misfits_at(tracer, x, y, sources, base=surfaces == 2), count)
        # One after the other: they are many.
        for channel, values in zip(channels, found, strict=True):
            channel[first : first + count] = values
    both = channels[1:].reshape(surfaces, len(lights), 2, height, width)
    return MisfitMaps(channels[0].reshape(height, width), both[0], both[-1], MARGIN, stride)


def trace_tiles(tracer: Tracer, lights: Array, division: int, corners: IntArray, size: int) -> Image:
    """Trace the misfit of the fine normal in tiles of divided pixels, each for its light.

    `lights`, shape (T, 3), are the tiles' lights, camera frame, mm, `division` the cells of a pixel along both axes,
    `corners`, shape (T, 2), columns and rows of the tiles' first pixels, `size` the pixels along a tile's side. Returns
    the misfit at the cells' centres with one cell beyond each side, shape (2, T, n, n), n = `size` `division` + 2; NaN
    where there is no surface.
    """
    across = size * division + 2
    width, cells = mi.UInt32(across), mi.Float(division)
    dr.make_opaque(width, cells)
    step, maps = max(1, LANES // across**2), np.empty((2, len(corners), across, across), dtype=np.float32)
    for first in range(0, len(corners), step):
        chosen = corners[first : first + step]
        count = len(chosen) * across**2
        index = dr.arange(mi.UInt32, count)
        line = index // width
        tile = line // width
        within = (index - line * width, line - tile * width)
        of_tile = np.concatenate([chosen, lights[first : first + step]], axis=1)
        *starts, a, b, c = (dr.gather(mi.Float, mi.Float(np.ascontiguousarray(axis, dtype=np.float32)), tile)
                            for axis in of_tile.T)  # fmt: skip
        x, y = (start + (mi.Float(cell) + (PIXEL_CENTRE - 1)) / cells
                for start, cell in zip(starts, within, strict=True))  # fmt: skip
        channels = evaluate(_misfits_at(tracer, x, y, [mi.Vector3f(a, b, c)], base=False)[1:], count)
        for whole, channel in zip(maps, channels, strict=True):
            whole[first : first + step] = channel.reshape(len(chosen), across, across)
    return maps


def _misfits_at(tracer: Tracer, x: Any, y: Any, sources: list[Any], base: bool) -> list[Any]:
    """Return the distance, and the misfits for lights of the fine normal and, if asked for, of the base's."""
    rays, _, hit = tracer.hit(x, y)
    values = [hit.base.t]
    for si in (hit.fine, hit.base) if base else (hit.fine,):
        normal = tracer.sightlines.camera_from_model @ mi.Vector3f(si.sh_frame.n)
        for light in sources:
            values += _misfit(rays.sightline, hit.base.t, normal, light)
    return [dr.select(hit.base.is_valid(), value, dr.nan) for value in values]


def _misfit(sightline: Any, distance: Any, normal: Any, light: Any) -> tuple[Any, Any]:
    """Compute normal minus bisector across sightlines, camera frame, as `exact_misfit` does."""
    bisector = dr.normalize(dr.normalize(light - sightline * distance) - sightline)
    first, second = mi.coordinate_system(-sightline)
    gap = normal - bisector
    return dr.dot(first, gap), dr.dot(second, gap)
