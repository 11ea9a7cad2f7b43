"""Maps of the misfit between the rendered shape's normals and the bisector, which show where glints may be."""

from typing import Any

import numpy as np

from simtest.conventions import PIXEL_CENTRE
from simtest.rendering.frames import MisfitMaps
from simtest.rendering.integrate import LANES, Tracer, blocks_of, evaluate
from simtest.runtime.arrays import Array, Image, IntArray

MARGIN_PX = 2
"""How far maps of the frame reach beyond it."""


def trace_misfits(tracer: Tracer, lights: Array) -> MisfitMaps:
    """Trace the misfits for lights, shape (L, 3), camera frame, mm, at the centres of pixels."""
    import drjit as dr

    mi, camera = tracer.mi, tracer.sightlines.camera
    height, width = camera.height + 2 * MARGIN_PX, camera.width + 2 * MARGIN_PX
    sources = [mi.Vector3f(*light.tolist()) for light in lights]
    dr.make_opaque(sources)
    rows: list[list[Image]] = []
    for first, count in blocks_of(height * width):
        start, across = mi.UInt32(first), mi.UInt32(width)
        dr.make_opaque(start, across)
        index = dr.arange(mi.UInt32, count) + start
        row = index // across
        x, y = (mi.Float(i) + PIXEL_CENTRE - MARGIN_PX for i in (index - row * across, row))
        rows.append(evaluate(_misfits_at(tracer, x, y, sources, base=tracer.relief is not None), count))
    channels = [np.concatenate(pieces).reshape(height, width) for pieces in zip(*rows, strict=True)]
    both = np.stack(channels[1:]).reshape(-1, len(lights), 2, height, width)
    return MisfitMaps(channels[0], both[0], both[-1], MARGIN_PX)


def trace_tiles(tracer: Tracer, light: Array, division: int, corners: IntArray, size: int) -> Image:
    """Trace the misfit of the fine normal for a light, shape (3,), in square tiles of divided pixels.

    Parameters
    ----------
    tracer : Tracer
        Of the scene.
    light : ndarray, shape (3,)
        Camera frame, mm.
    division : int
        Cells of a pixel along both axes.
    corners : ndarray of int, shape (T, 2)
        Columns and rows of the tiles' first pixels.
    size : int
        Pixels along a tile's side.

    Returns
    -------
    ndarray of float32, shape (2, T, n, n)
        At the cells' centres, with one cell beyond each side: n is `size` `division` + 2; NaN where there is no
        surface.
    """
    import drjit as dr

    mi, across = tracer.mi, size * division + 2
    source, width, cells = mi.Vector3f(*light.tolist()), mi.UInt32(across), mi.Float(division)
    dr.make_opaque(source, width, cells)
    step, pieces = max(1, LANES // across**2), []
    for first in range(0, len(corners), step):
        own = corners[first : first + step]
        count = len(own) * across**2
        index = dr.arange(mi.UInt32, count)
        line = index // width
        tile = line // width
        within = (index - line * width, line - tile * width)
        starts = (mi.Float(np.ascontiguousarray(axis, dtype=np.float32)) for axis in own.T)
        x, y = (dr.gather(mi.Float, start, tile) + (mi.Float(cell) + (PIXEL_CENTRE - 1)) / cells
                for start, cell in zip(starts, within, strict=True))  # fmt: skip
        channels = evaluate(_misfits_at(tracer, x, y, [source], base=False)[1:], count)
        pieces.append(np.stack(channels).reshape(2, len(own), across, across))
    return np.concatenate(pieces, axis=1)


def _misfits_at(tracer: Tracer, x: Any, y: Any, sources: list[Any], base: bool) -> list[Any]:
    """Return the distance, and the misfits for lights of the fine normal and, if asked for, of the base's."""
    import drjit as dr

    rays, _, hit = tracer.hit(x, y)
    values = [hit.base.t]
    for si in (hit.fine, hit.base) if base else (hit.fine,):
        normal = tracer.sightlines.camera_from_model @ tracer.mi.Vector3f(si.sh_frame.n)
        for light in sources:
            values += _misfit(tracer.mi, rays.sightline, hit.base.t, normal, light)
    return [dr.select(hit.base.is_valid(), value, dr.nan) for value in values]


def _misfit(mi: Any, sightline: Any, distance: Any, normal: Any, light: Any) -> tuple[Any, Any]:
    """Compute normal minus bisector across sightlines, camera frame, as `exact_misfit` does."""
    import drjit as dr

    bisector = dr.normalize(dr.normalize(light - sightline * distance) - sightline)
    first, second = mi.coordinate_system(-sightline)
    gap = normal - bisector
    return dr.dot(first, gap), dr.dot(second, gap)
