"""Labels of the rendered shape at each pixel's centre, from the same hits as the radiance.

They are single precision and those of the triangles where the shape is a mesh, with normals and shape operators
interpolated between its corners. The exact truth of the smooth surface is `simtest.rendering.exact_points`.

On a relief, normals and curvatures are those of the fine surface, and those of the base stand beside them. On a smooth
surface they are the same, so they are neither traced nor stored twice.
"""

from typing import Any

import numpy as np

from simtest.rendering.exact_points import pack_hits
from simtest.rendering.frames import Labels
from simtest.rendering.hits import Hit
from simtest.rendering.rays import Rays
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.runtime.arrays import Array, Image
from simtest.surfaces import RayHits

CHANNELS = (
    "depth", "x", "y", "z", "normal_x", "normal_y", "normal_z", "geometric_x", "geometric_y", "geometric_z",
    "k_min", "k_max", "face", "second", "third",
)  # fmt: skip
"""Channels of `trace`: depth, mm; position, mm, and normals, camera frame; curvatures, 1/mm; triangle, and position in
it. Normal and curvatures are those of the fine surface."""

BASE_CHANNELS = ("base_x", "base_y", "base_z", "k_min_base", "k_max_base", "pool")
"""Further channels on a relief: normal and curvatures of the base, and 1 in the film's pools, else 0."""


class ShapeLabels:
    """Labels of one Mitsuba shape.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    shape : mitsuba.Shape
        The scene's only surface.
    shape_operators : ndarray, shape (V, 3, 3), or None
        Of a mesh: S at its vertices for normals on the camera's side, model frame, 1/mm. None for a sphere, cylinder
        or plane, whose derivatives Mitsuba knows exactly.
    curved : bool
        Whether to compute the curvatures; they are NaN otherwise, and all else is the same.
    """

    def __init__(self, mi: Any, shape: Any, shape_operators: Array | None, curved: bool = True) -> None:
        self.mi, self._shape, self._curved = mi, shape, curved
        self._operators = None
        if shape_operators is not None:
            # S is symmetric: six numbers a vertex.
            rows, columns = np.triu_indices(3)
            upper = np.ascontiguousarray(shape_operators[:, rows, columns], dtype=np.float32)
            self._operators = mi.Float(upper.ravel())

    def trace(self, preliminary: Any, hit: Hit, rays: Rays, rotation: Any, relief: ReliefKernel | None) -> list[Any]:
        """Compute the channels at the hits (see `CHANNELS`, `BASE_CHANNELS`); NaN where there is no surface.

        `hit` are the surface points, with all derivatives, on the surface's `relief`; `rotation` leads from the model
        frame to the camera frame.
        """
        import drjit as dr

        mi, si = self.mi, hit.base
        seen = si.is_valid()
        # Rendered shapes are seen from either side: turn the triangle's normal towards the camera.
        facing = dr.select(dr.dot(si.n, rays.traced.d) > 0, mi.Float(-1), mi.Float(1))
        shading, geometric = rotation @ mi.Vector3f(hit.fine.sh_frame.n), rotation @ (mi.Vector3f(si.n) * facing)
        curvatures = below = [mi.Float(dr.nan), mi.Float(dr.nan)]
        if self._curved:
            tangents, form = self._second_form(preliminary, si, seen)
            curvatures = below = _principal(form, facing)
            if hit.jets is not None:
                curvatures = _principal(_fine_form(mi, hit, tangents, form), facing)
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
        import drjit as dr

        mi = self.mi
        if self._operators is None:
            first = dr.normalize(si.dp_du)
            # Analytic shape: dN along the first tangent, and along the one perpendicular to it.
            along = si.dn_du / dr.norm(si.dp_du)
            share = dr.dot(first, si.dp_dv)
            across = si.dp_dv - share * first
            second = dr.normalize(across)
            along_second = (si.dn_dv - share * along) / dr.norm(across)
            return (first, second), (dr.dot(first, along), dr.dot(first, along_second), dr.dot(second, along_second))
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
    import drjit as dr

    a, b, c = form
    mean, half = (a + c) / 2, dr.sqrt(dr.square((a - c) / 2) + dr.square(b))
    return [facing * mean - half, facing * mean + half]


def _fine_form(mi: Any, hit: Hit, tangents: tuple[Any, Any], form: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """Compute the fine surface's second fundamental form from the base's, as `relief.fine_curvatures` does."""
    import drjit as dr

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
        geometric_normal=vector("geometric_x", "geometric_y", "geometric_z"),
        k_min=named["k_min"],
        k_max=named["k_max"],
        normal_base=vector("base_x", "base_y", "base_z") if has_relief else normal,
        k_min_base=named["k_min_base"] if has_relief else named["k_min"],
        k_max_base=named["k_max_base"] if has_relief else named["k_max"],
        pool=named["pool"] > 0 if has_relief else np.zeros(seen.shape, dtype=bool),
        instance=np.where(seen, np.int32(0), np.int32(-1)),
        face=np.where(seen, named["face"].view(np.int32), np.int32(-1)),
    )


def as_hits(channels: list[Image]) -> tuple[RayHits, Array, Array]:
    """Return the hits that the exact truth starts from, and shading and geometric normals, camera frame, (N, 3).

    The shading normal is that of the light off the lobe: on a relief the fine one.
    """
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
