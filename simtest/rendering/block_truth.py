"""Exact points of a whole frame, block by block: the solution's temporaries stay in the processor's cache.

In one piece the temporaries of a frame of 1280 x 720 take 1 GB, and half of the time goes into fetching their pages.
"""

from dataclasses import fields
from typing import Any

import numpy as np

from simtest.rendering import exact_points as exact
from simtest.rendering import tube_kernel
from simtest.rendering.tube_kernel import TubeKernel
from simtest.runtime.arrays import Array
from simtest.surfaces import RayHits, SurfaceModel, SurfacePoints

BLOCK = 8192
"""Rays that are solved together. Rounding may depend on it in the last bit, so it never follows the machine."""

_OF_BASE = {"normal_base": "normal", "k_min_base": "k_min", "k_max_base": "k_max"}
"""Fields of the base, which are those of the fine surface where there is no relief."""


def solve(mi: Any, surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
    """Compute the exact points of many rays, shape (N, 3), as `exact_points.solve` does of a few.

    A surface with a chart is solved in a kernel of `mi`, mitsuba with the variant set.
    """
    kernel = None if surface.chart is None else TubeKernel(mi, surface.chart)
    block = BLOCK if kernel is None else tube_kernel.BLOCK
    whole: dict[str, Array] = {}
    for start in range(0, max(len(directions), 1), block):
        some = slice(start, start + block)
        part = RayHits(hits.distance[some], hits.face[some], hits.barycentric[some])
        rays = origins[some], directions[some], part
        solved = _of_numpy(surface, *rays) if kernel is None else _of_kernel(kernel, surface, *rays)
        for name, values in solved.items():
            if not start:
                whole[name] = np.empty((len(directions), *values.shape[1:]), dtype=values.dtype)
            whole[name][some] = values
    # One array stands for both surfaces where they are one.
    shared = {base: whole[fine] for base, fine in _OF_BASE.items() if base not in whole}
    return SurfacePoints(**{**whole, **shared})  # type: ignore[arg-type]


def distances(mi: Any, surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits) -> Array:
    """Compute the exact distances of many rays, shape (N,), mm, as `solve` does, without normals and curvatures."""
    kernel = None if surface.chart is None else TubeKernel(mi, surface.chart)
    block = BLOCK if kernel is None else tube_kernel.BLOCK
    solver = surface.distances if kernel is None else kernel.distances
    whole = np.empty(len(directions))
    for start in range(0, len(directions), block):
        some = slice(start, start + block)
        part = RayHits(hits.distance[some], hits.face[some], hits.barycentric[some])
        whole[some] = solver(origins[some], directions[some], part)
    return whole


def _of_numpy(surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits) -> dict[str, Array]:
    """Return the fields of a block's points; without a relief the base has none of its own."""
    points = exact.solve(surface, origins, directions, hits)
    own = [field.name for field in fields(SurfacePoints) if surface.relief is not None or field.name not in _OF_BASE]
    return {name: getattr(points, name) for name in own}


def _of_kernel(
    kernel: TubeKernel, surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits
) -> dict[str, Array]:
    """Return what `_of_numpy` returns, with the base's points solved by the kernel."""
    if surface.relief is None:
        return kernel.solve(origins, directions, hits, surface.model_from_camera)
    # The relief is applied in the model frame, in blocks as above.
    base = kernel.solve(origins, directions, hits, np.eye(4))
    base |= {name: base[fine] for name, fine in _OF_BASE.items()}
    parts = []
    for start in range(0, max(len(directions), 1), BLOCK):
        points = SurfacePoints(**{name: values[start : start + BLOCK] for name, values in base.items()})  # type: ignore[arg-type]
        parts.append(vars(exact.in_camera(surface, surface.relief.apply(points))))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
