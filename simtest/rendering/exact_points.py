"""Exact points of the smooth surface, in double precision, from a ray tracer's hits."""

from dataclasses import replace
from typing import Any

import numpy as np

from simtest.rendering.frames import TruthMaps
from simtest.rendering.hits import make_hit
from simtest.rendering.kernel_arrays import to_kernel, vectors_from_kernel, vectors_to_kernel
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.runtime.arrays import Array, Mask
from simtest.surfaces import RayHits, Shape, SurfaceModel, SurfacePoints

_OF_POINTS = (
    "position", "normal", "k_min", "k_max", "direction_min", "direction_max",
    "normal_base", "k_min_base", "k_max_base",
)  # fmt: skip
"""Truth maps that are named as in `SurfacePoints`."""


def trace_hits(
    mi: Any, scene: Any, shape: Shape, origins: Array, directions: Array, relief: ReliefKernel | None
) -> tuple[RayHits, Array, Array]:
    """Trace rays, shape (N, 3), model frame, mm, against the rendered shape, the scene's only surface.

    Directions are unit, NaN where there is no ray. With a `relief` the shading normals are those of the fine surface.

    Returns
    -------
    hits : RayHits
        Where the rays meet the shape.
    shading, geometric : ndarray, shape (N, 3)
        Normals of the rendered shape, model frame; NaN where the ray misses.
    """
    if not len(origins):
        # Dr.Jit ends the process on a kernel without rays.
        none = np.empty((0, 3))
        return RayHits(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 2))), none, none
    import drjit as dr

    ray, asked = _rays(mi, origins, directions)
    # Hits: what the exact solution starts from, and the normals of the rendered shape.
    preliminary = scene.ray_intersect_preliminary(ray, False, asked)
    si = preliminary.compute_surface_interaction(ray, mi.RayFlags.All, asked)
    valid = si.is_valid()
    normals = (mi.Vector3f(make_hit(mi, si, relief).fine.sh_frame.n), mi.Vector3f(si.n))
    dr.eval(preliminary.t, preliminary.prim_uv, preliminary.prim_index, *normals, valid)
    # Back to arrays; a miss becomes NaN.
    missed = ~np.array(valid)
    hits = pack_hits(
        np.where(missed, np.nan, np.array(preliminary.t)),
        np.array(preliminary.prim_index),
        vectors_from_kernel(preliminary.prim_uv, np.float32),
    )
    shading, geometric = (vectors_from_kernel(n, np.float64) for n in normals)
    if shape.kind == "mesh":
        # A triangle may be seen from behind.
        with np.errstate(invalid="ignore"):
            geometric = geometric * np.where(np.einsum("ij,ij->i", geometric, directions) > 0, -1.0, 1.0)[:, None]
    for normal in (shading, geometric):
        normal[missed] = np.nan
    return hits, shading, geometric


def trace_starts(mi: Any, scene: Any, origins: Array, directions: Array) -> RayHits:
    """Trace rays as `trace_hits` does, without the normals: the same hits in a fraction of the time."""
    if not len(origins):
        return RayHits(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 2)))
    import drjit as dr

    ray, asked = _rays(mi, origins, directions)
    preliminary = scene.ray_intersect_preliminary(ray, False, asked)
    valid = preliminary.is_valid()
    dr.eval(preliminary.t, preliminary.prim_uv, preliminary.prim_index, valid)
    return pack_hits(
        np.where(np.array(valid), np.array(preliminary.t), np.nan),
        np.array(preliminary.prim_index),
        vectors_from_kernel(preliminary.prim_uv, np.float32),
    )


def trace_blocked(mi: Any, scene: Any, origins: Array, directions: Array, reach: Array) -> Mask:
    """Return which rays, shape (N, 3), model frame, mm, meet the rendered shape before `reach`, shape (N,), mm."""
    if not len(origins):
        return np.empty(0, dtype=bool)
    ray, asked = _rays(mi, origins, directions)
    ray.maxt = to_kernel(mi.Float, np.nan_to_num(reach), np.float32)
    return np.array(scene.ray_test(ray, False, asked & (ray.maxt > 0)))


def _rays(mi: Any, origins: Array, directions: Array) -> tuple[Any, Any]:
    """Return mitsuba.Ray3f, and mitsuba.Bool: which of them exist."""
    asked = np.asarray(np.isfinite(directions).all(axis=1) & np.isfinite(origins).all(axis=1))
    # No NaN may enter the renderer.
    ray = mi.Ray3f(
        vectors_to_kernel(mi.Point3f, mi.Float, np.where(asked[:, None], origins, 0.0), np.float32),
        vectors_to_kernel(mi.Vector3f, mi.Float, np.where(asked[:, None], directions, [0.0, 0.0, 1.0]), np.float32),
    )
    return ray, to_kernel(mi.Bool, asked, bool)


def pack_hits(distance: Any, face: Any, barycentric: Any) -> RayHits:
    """Make `RayHits` from single-precision values, shapes (N,), (N,) and (N, 2); a NaN distance is a miss."""
    missed = np.isnan(distance)
    # The values of a miss may not be numbers: replace them before the conversion.
    return RayHits(
        np.where(missed, np.float32(np.inf), distance).astype(np.float64),
        np.where(missed, 0, face).astype(np.int64),
        np.where(missed[:, None], np.float32(0), barycentric).astype(np.float64),
    )


def solve(surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits, fine: bool = True) -> SurfacePoints:
    """Compute the exact points, in the camera frame, on rays of the model frame, shape (N, 3).

    Normals and curvatures are those of the `fine` surface, or else of its base.
    """
    exact = (surface.fine_points if fine else surface.points)(np.asarray(origins), directions, hits)
    return in_camera(surface, exact)


def in_camera(surface: SurfaceModel, exact: SurfacePoints) -> SurfacePoints:
    """Turn points of the model frame to the camera frame."""
    rotation = surface.model_from_camera[:3, :3]
    return replace(
        exact,
        position=(exact.position - surface.model_from_camera[:3, 3]) @ rotation,
        normal=exact.normal @ rotation,
        direction_min=exact.direction_min @ rotation,
        direction_max=exact.direction_max @ rotation,
        normal_base=exact.normal_base @ rotation,
    )


def truth_maps(points: SurfacePoints, shading: Array, geometric: Array, size: tuple[int, int]) -> TruthMaps:
    """Arrange points and the renderer's normals, all of H W rays in the camera frame, as maps of `size` (H, W)."""
    maps = {"depth": points.distance, "shading_normal": shading, "geometric_normal": geometric}
    maps |= {name: getattr(points, name) for name in _OF_POINTS}
    images = {name: values.reshape(*size, *values.shape[1:]) for name, values in maps.items()}
    none = np.zeros(size, dtype=np.uint8)
    return TruthMaps(**images, pool=points.pool.reshape(size), mask=points.valid.reshape(size), instrument=none)
