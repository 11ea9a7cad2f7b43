"""Ground truth: labels of the rendered shape from the radiance's own hits, and exact points of the smooth surface.

Labels are single precision and those of the triangles where the shape is a mesh, with normals and shape operators
interpolated between its corners. Exact points are double precision, from the same hits. A whole frame is solved block
by block: in one piece the temporaries of 1280 x 720 take 1 GB, and half of the time goes into fetching their pages.

On a relief, normals and curvatures are those of the fine surface, and those of the base stand beside them. On a smooth
surface they are the same, so they are neither traced nor stored twice.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from simtest.rendering import tube_kernel
from simtest.rendering.backend import dr, mi
from simtest.rendering.frames import Labels, TruthMaps
from simtest.rendering.kernel_values import to_kernel, vectors_from_kernel, vectors_to_kernel
from simtest.rendering.rays import Hit, Rays, tangents_and_turns
from simtest.rendering.tissue_kernels import ReliefKernel
from simtest.rendering.tube_kernel import TubeKernel
from simtest.runtime.arrays import Array, Image, Mask
from simtest.surfaces import RayHits, SurfaceModel, SurfacePoints

_OF_POINTS = (
    "position", "normal", "k_min", "k_max", "direction_min", "direction_max",
    "normal_base", "k_min_base", "k_max_base",
)  # fmt: skip
"""Truth maps that are named as in `SurfacePoints`."""


def trace_starts(scene: Any, origins: Array, directions: Array) -> RayHits:
    """Trace rays, shape (N, 3), model frame, mm, against the scene's only surface; NaN directions are no rays."""
    if not len(origins):
        # Dr.Jit ends the process on a kernel without rays.
        return RayHits(np.empty(0), np.empty(0, dtype=np.int64), np.empty((0, 2)))
    ray, asked = _rays(origins, directions)
    preliminary = scene.ray_intersect_preliminary(ray, False, asked)
    valid = preliminary.is_valid()
    dr.eval(preliminary.t, preliminary.prim_uv, preliminary.prim_index, valid)
    return pack_hits(
        np.where(np.array(valid), np.array(preliminary.t), np.nan),
        np.array(preliminary.prim_index),
        vectors_from_kernel(preliminary.prim_uv, np.float32),
    )


def trace_blocked(scene: Any, origins: Array, directions: Array, reach: Array) -> Mask:
    """Return which rays, shape (N, 3), model frame, mm, meet the rendered shape before `reach`, shape (N,), mm."""
    if not len(origins):
        return np.empty(0, dtype=bool)
    ray, asked = _rays(origins, directions)
    ray.maxt = to_kernel(mi.Float, np.nan_to_num(reach), np.float32)
    return np.array(scene.ray_test(ray, False, asked & (ray.maxt > 0)))


def _rays(origins: Array, directions: Array) -> tuple[Any, Any]:
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
    """Compute the exact points, camera frame, of the fine surface or its base, on rays of the model frame."""
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
    maps: dict[str, Any] = {"depth": points.distance, "shading_normal": shading, "geometric_normal": geometric}
    maps |= {name: getattr(points, name) for name in _OF_POINTS}
    images = {name: values.reshape(*size, *values.shape[1:]) for name, values in maps.items()}
    none = np.zeros(size, dtype=np.uint8)
    return TruthMaps(**images, pool=points.pool.reshape(size), mask=points.valid.reshape(size), instrument=none)


CHANNELS = (
    "depth", "x", "y", "z", "normal_x", "normal_y", "normal_z", "geometric_x", "geometric_y", "geometric_z",
    "k_min", "k_max", "face", "second", "third",
)  # fmt: skip
"""Channels of `trace`: depth, mm; position, mm, and normals, camera frame; curvatures, 1/mm; triangle, and position in
it. Normal and curvatures are those of the fine surface."""

BASE_CHANNELS = ("base_x", "base_y", "base_z", "k_min_base", "k_max_base", "pool")
"""Further channels on a relief: normal and curvatures of the base, and 1 in the film's pools, else 0."""


class ShapeLabels:
    """Labels of one Mitsuba shape, the scene's only surface.

    `shape_operators`, shape (V, 3, 3), are S at a mesh's vertices for normals on the camera's side, model frame, 1/mm;
    None for a sphere, cylinder or plane, whose derivatives Mitsuba knows exactly. Unless `curved` the curvatures are
    NaN.
    """

    def __init__(self, shape: Any, shape_operators: Array | None, curved: bool = True) -> None:
        self._shape, self._curved = shape, curved
        self._operators = None
        if shape_operators is not None:
            # S is symmetric: six numbers a vertex.
            rows, columns = np.triu_indices(3)
            upper = np.ascontiguousarray(shape_operators[:, rows, columns], dtype=np.float32)
            self._operators = mi.Float(upper.ravel())

    def trace(self, preliminary: Any, hit: Hit, rays: Rays, rotation: Any, relief: ReliefKernel | None) -> list[Any]:
        """Compute the channels at hits with all derivatives (see `CHANNELS`, `BASE_CHANNELS`); NaN at misses."""
        si = hit.base
        seen = si.is_valid()
        # Rendered shapes are seen from either side: turn the triangle's normal towards the camera.
        facing = dr.select(dr.dot(si.n, rays.traced.d) > 0, mi.Float(-1), mi.Float(1))
        shading, geometric = rotation @ mi.Vector3f(hit.fine.sh_frame.n), rotation @ (mi.Vector3f(si.n) * facing)
        curvatures = below = [mi.Float(dr.nan), mi.Float(dr.nan)]
        if self._curved:
            tangents, form = self._second_form(preliminary, si, seen)
            curvatures = below = _principal(form, facing)
            if hit.jets is not None:
                curvatures = _principal(_fine_form(hit, tangents, form), facing)
        # Misses are NaN; triangle and position in it travel as they are.
        position = rays.sightline * si.t
        channels = [si.t, *position, *shading, *geometric, *curvatures]
        base = []
        if relief is not None:
            assert hit.jets is not None
            pool = dr.select(relief.pool(hit.jets), mi.Float(1), mi.Float(0))
            base = [*(rotation @ mi.Vector3f(si.sh_frame.n)), *below, pool]
        channels, base = ([dr.select(seen, channel, dr.nan) for channel in part] for part in (channels, base))
        face = dr.reinterpret_array(mi.Float, preliminary.prim_index)
        return [*channels, face, *preliminary.prim_uv, *base]

    def _second_form(self, preliminary: Any, si: Any, seen: Any) -> tuple[tuple[Any, Any], tuple[Any, Any, Any]]:
        """Compute two perpendicular tangents, and the components of S along them, for the shape's own normal."""
        if self._operators is None:
            (first, second), (along, across) = tangents_and_turns(si)
            return (first, second), (dr.dot(first, along), dr.dot(first, across), dr.dot(second, across))
        # Mesh: S interpolated between the triangle's corners.
        corners = self._shape.face_indices(preliminary.prim_index, seen)
        u, v = preliminary.prim_uv
        upper = [mi.Float(0)] * 6
        for corner, weight in zip(corners, (1 - u - v, u, v), strict=True):
            for k in range(6):
                upper[k] = dr.fma(weight, dr.gather(mi.Float, self._operators, corner * 6 + k, seen), upper[k])
        xx, xy, xz, yy, yz, zz = upper

        def form(p: Any, q: Any) -> Any:
            return (
                p.x * (xx * q.x + xy * q.y + xz * q.z)
                + p.y * (xy * q.x + yy * q.y + yz * q.z)
                + p.z * (xz * q.x + yz * q.y + zz * q.z)
            )

        first, second = mi.coordinate_system(si.sh_frame.n)
        return (first, second), (form(first, first), form(first, second), form(second, second))


def _principal(form: tuple[Any, Any, Any], facing: Any) -> list[Any]:
    """Return the principal curvatures, the smaller first, of a second fundamental form [[a, b], [b, c]]."""
    a, b, c = form
    mean, half = (a + c) / 2, dr.sqrt(dr.square((a - c) / 2) + dr.square(b))
    return [facing * mean - half, facing * mean + half]


def _fine_form(hit: Hit, tangents: tuple[Any, Any], form: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Compute the fine surface's second fundamental form from the base's, as `relief_field.fine_curvatures` does."""
    jets, N, n = hit.jets, mi.Vector3f(hit.base.sh_frame.n), mi.Vector3f(hit.fine.sh_frame.n)
    assert jets is not None
    assert jets.hessian is not None
    (p, q), (a, b, c), G = tangents, form, jets.gradient
    xx, xy, xz, yy, yz, zz = jets.hessian

    def S(t: Any) -> Any:
        along_p, along_q = dr.dot(p, t), dr.dot(q, t)
        return p * (a * along_p + b * along_q) + q * (b * along_p + c * along_q)

    def H(t: Any) -> Any:
        return mi.Vector3f(dr.dot(mi.Vector3f(xx, xy, xz), t), dr.dot(mi.Vector3f(xy, yy, yz), t),
                           dr.dot(mi.Vector3f(xz, yz, zz), t))  # fmt: skip

    along = dr.dot(N, G)
    length = dr.norm(N - G + N * along)
    # A tangent f of the fine surface stands over the base's tangent f - N (N.f).
    fine = mi.coordinate_system(n)
    changes = []
    for f in fine:
        t = f - N * dr.dot(N, f)
        bent, turned = H(t), S(t)
        changes.append(((1 + along) * turned + N * (dr.dot(G, turned) + dr.dot(N, bent)) - bent) / length)
    mixed = (dr.dot(fine[0], changes[1]) + dr.dot(fine[1], changes[0])) / 2
    return dr.dot(fine[0], changes[0]), mixed, dr.dot(fine[1], changes[1])


def as_labels(channels: list[Image]) -> Labels:
    """Arrange the channels of `CHANNELS` and, on a relief, `BASE_CHANNELS`, each of shape (H, W)."""
    named = _named(channels)
    seen = np.isfinite(named["depth"])

    def vector(*names: str) -> Image:
        # The components stay separate in memory, which saves a copy from pixel to pixel.
        return np.moveaxis(np.stack([named[name] for name in names]), 0, -1)

    normal = vector("normal_x", "normal_y", "normal_z")
    has_relief = "pool" in named
    return Labels(
        depth=named["depth"],
        position=vector("x", "y", "z"),
        normal=normal,
        shading_normal=normal,
        geometric_normal=vector("geometric_x", "geometric_y", "geometric_z"),
        k_min=named["k_min"],
        k_max=named["k_max"],
        normal_base=vector("base_x", "base_y", "base_z") if has_relief else normal,
        k_min_base=named["k_min_base"] if has_relief else named["k_min"],
        k_max_base=named["k_max_base"] if has_relief else named["k_max"],
        pool=named["pool"] > 0 if has_relief else np.zeros(seen.shape, dtype=bool),
        mask=seen,
        instrument=np.zeros(seen.shape, dtype=np.uint8),
        face=np.where(seen, named["face"].view(np.int32), np.int32(-1)),
    )


def as_hits(channels: list[Image]) -> tuple[RayHits, Array, Array]:
    """Return the hits that exact truth starts from, and shading (off the lobe) and geometric normals, (N, 3)."""
    named = {name: channel.ravel() for name, channel in _named(channels).items()}
    barycentric = np.stack([named["second"], named["third"]], axis=1)
    hits = pack_hits(named["depth"], named["face"].view(np.int32), barycentric)
    shading, geometric = (
        np.stack([named[f"{kind}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
        for kind in ("normal", "geometric")
    )
    return hits, shading, geometric


def _named(channels: list[Image]) -> dict[str, Image]:
    names = CHANNELS if len(channels) == len(CHANNELS) else CHANNELS + BASE_CHANNELS
    return dict(zip(names, channels, strict=True))


BLOCK = 8192
"""Rays that are solved together. Rounding may depend on it in the last bit, so it never follows the machine."""

_OF_BASE = {"normal_base": "normal", "k_min_base": "k_min", "k_max_base": "k_max"}
"""Fields of the base, which are those of the fine surface where there is no relief."""


Fields = dict[str, Array]
Solver = Callable[[Array, Array, RayHits], Fields]


def solve_frame(
    surface: SurfaceModel, kernel: TubeKernel | None, origins: Array, directions: Array, hits: RayHits
) -> SurfacePoints:
    """Compute the exact points of many rays as `solve` does of a few; with a chart in its kernel."""
    if kernel is None:
        whole = _in_blocks(partial(_of_numpy, surface), BLOCK, origins, directions, hits)
    else:
        whole = _in_blocks(partial(_of_kernel, kernel, surface), tube_kernel.BLOCK, origins, directions, hits)
    # One array stands for both surfaces where they are one.
    shared = {base: whole[fine] for base, fine in _OF_BASE.items() if base not in whole}
    return SurfacePoints(**{**whole, **shared})  # type: ignore[arg-type]


def frame_distances(
    surface: SurfaceModel, kernel: TubeKernel | None, origins: Array, directions: Array, hits: RayHits
) -> Array:
    """Compute the exact distances of many rays, shape (N,), mm: those of `solve_frame`."""
    block, solver = (BLOCK, surface.distances) if kernel is None else (tube_kernel.BLOCK, kernel.distances)
    return _in_blocks(lambda *rays: {"": solver(*rays)}, block, origins, directions, hits)[""]


def base_points(
    surface: SurfaceModel, kernel: TubeKernel | None, origins: Array, directions: Array, hits: RayHits
) -> SurfacePoints:
    """Compute the exact points of the base, model frame, on rays; with a chart in its kernel."""
    if kernel is None:
        return surface.points(origins, directions, hits)
    base = kernel.solve(origins, directions, hits, np.eye(4))
    return SurfacePoints(**base, **{name: base[fine] for name, fine in _OF_BASE.items()})  # type: ignore[arg-type]


def _in_blocks(solver: Solver, block: int, origins: Array, directions: Array, hits: RayHits) -> Fields:
    """Return fields of rays that are solved for some of them at a time."""
    whole: Fields = {}
    for start in range(0, max(len(directions), 1), block):
        some = slice(start, start + block)
        for name, values in solver(origins[some], directions[some], hits.rows(some)).items():
            if not start:
                whole[name] = np.empty((len(directions), *values.shape[1:]), dtype=values.dtype)
            whole[name][some] = values
    return whole


def _of_numpy(surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits) -> dict[str, Array]:
    """Return the fields of a block's points; without a relief the base has none of its own."""
    points = solve(surface, origins, directions, hits)
    names = [field.name for field in fields(SurfacePoints) if surface.relief is not None or field.name not in _OF_BASE]
    return {name: getattr(points, name) for name in names}


def _of_kernel(
    kernel: TubeKernel, surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits
) -> dict[str, Array]:
    """Return what `_of_numpy` returns, with the base's points solved by the kernel."""
    if surface.relief is None:
        return kernel.solve(origins, directions, hits, surface.model_from_camera)
    # The relief is applied in the model frame, in blocks as above.
    base = vars(base_points(surface, kernel, origins, directions, hits))
    parts = []
    for start in range(0, max(len(directions), 1), BLOCK):
        points = SurfacePoints(**{name: values[start : start + BLOCK] for name, values in base.items()})
        parts.append(vars(in_camera(surface, surface.relief.apply(points))))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
