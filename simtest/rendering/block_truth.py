"""Exact points of a whole frame, block by block: the solution's temporaries stay in the processor's cache.

In one piece the temporaries of a frame of 1280 x 720 take 1 GB, and half of the time goes into fetching their pages.
"""

from dataclasses import fields

import numpy as np

from simtest.rendering import exact_points as exact
from simtest.runtime.arrays import Array
from simtest.surfaces import RayHits, SurfaceModel, SurfacePoints

BLOCK = 8192
"""Rays that are solved together. Rounding may depend on it in the last bit, so it never follows the machine."""

_OF_BASE = {"normal_base": "normal", "k_min_base": "k_min", "k_max_base": "k_max"}
"""Fields of the base, which are those of the fine surface where there is no relief."""


def solve(surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
    """Compute the exact points of many rays, shape (N, 3), as `exact_points.solve` does of a few."""
    whole: dict[str, Array] = {}
    own = [field.name for field in fields(SurfacePoints) if surface.relief is not None or field.name not in _OF_BASE]
    for start in range(0, max(len(directions), 1), BLOCK):
        some = slice(start, start + BLOCK)
        part = RayHits(hits.distance[some], hits.face[some], hits.barycentric[some])
        points = exact.solve(surface, origins[some], directions[some], part)
        for name in own:
            values = getattr(points, name)
            if not start:
                whole[name] = np.empty((len(directions), *values.shape[1:]), dtype=values.dtype)
            whole[name][some] = values
    # One array stands for both surfaces where they are one.
    shared = {base: whole[fine] for base, fine in _OF_BASE.items() if base not in whole}
    return SurfacePoints(**{**whole, **shared})  # type: ignore[arg-type]
