"""Labels of the rendered shape at each pixel's centre, from the same hits as the radiance.

They are single precision and those of the triangles where the shape is a mesh, with normals and shape operators
interpolated between its corners. The exact truth of the smooth surface is `simtest.rendering.exact_points`.
"""

from typing import Any

import numpy as np

from simtest.rendering.exact_points import pack_hits
from simtest.rendering.frames import Labels
from simtest.rendering.rays import Rays
from simtest.runtime.arrays import Array, Image
from simtest.surfaces import RayHits

CHANNELS = (
    "depth", "x", "y", "z", "normal_x", "normal_y", "normal_z", "geometric_x", "geometric_y", "geometric_z",
    "k_min", "k_max", "face", "second", "third",
)  # fmt: skip
"""Channels of `trace`: depth, mm; position, mm, and normals, camera frame; curvatures, 1/mm; triangle, and position in
it."""


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

    def trace(self, preliminary: Any, si: Any, rays: Rays, rotation: Any) -> list[Any]:
        """Compute the channels at the hits (see `CHANNELS`); NaN where there is no surface.

        `si` are the surface points of the hits, with all derivatives; `rotation` leads from the model frame to the
        camera frame.
        """
        import drjit as dr

        mi = self.mi
        seen = si.is_valid()
        # Rendered shapes are seen from either side: turn the triangle's normal towards the camera.
        facing = dr.select(dr.dot(si.n, rays.traced.d) > 0, mi.Float(-1), mi.Float(1))
        shading, geometric = rotation @ mi.Vector3f(si.sh_frame.n), rotation @ (mi.Vector3f(si.n) * facing)
        curvatures = [mi.Float(dr.nan), mi.Float(dr.nan)]
        if self._curved:
            a, b, c = self._second_form(preliminary, si, seen)
            # Eigenvalues of the second fundamental form [[a, b], [b, c]].
            mean, half = (a + c) / 2, dr.sqrt(dr.square((a - c) / 2) + dr.square(b))
            curvatures = [facing * mean - half, facing * mean + half]
        # Misses are NaN; triangle and position in it travel as they are.
        position = rays.sightline * si.t
        channels = [si.t, *position, *shading, *geometric, *curvatures]
        channels = [dr.select(seen, channel, dr.nan) for channel in channels]
        face = dr.reinterpret_array(mi.Float, preliminary.prim_index)
        return [*channels, face, *preliminary.prim_uv]

    def _second_form(self, preliminary: Any, si: Any, seen: Any) -> tuple[Any, Any, Any]:
        """Compute the components of S along two perpendicular tangents, for the shape's own normal."""
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
            return dr.dot(first, along), dr.dot(first, along_second), dr.dot(second, along_second)
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
        return form(first, first), form(first, second), form(second, second)


def as_labels(channels: list[Image]) -> Labels:
    """Arrange the channels of `CHANNELS`, each of shape (H, W)."""
    named = dict(zip(CHANNELS, channels, strict=True))
    seen = np.isfinite(named["depth"])

    def vector(*names: str) -> Image:
        # The components stay separate in memory, which saves a copy from pixel to pixel.
        return np.moveaxis(np.stack([named[name] for name in names]), 0, -1)

    return Labels(
        depth=named["depth"],
        position=vector("x", "y", "z"),
        normal=vector("normal_x", "normal_y", "normal_z"),
        geometric_normal=vector("geometric_x", "geometric_y", "geometric_z"),
        k_min=named["k_min"],
        k_max=named["k_max"],
        instance=np.where(seen, np.int32(0), np.int32(-1)),
        face=np.where(seen, named["face"].view(np.int32), np.int32(-1)),
    )


def as_hits(channels: list[Image]) -> tuple[RayHits, Array, Array]:
    """Return the hits that the exact truth starts from, and shading and geometric normals, camera frame, (N, 3)."""
    named = {name: channel.ravel() for name, channel in zip(CHANNELS, channels, strict=True)}
    barycentric = np.stack([named["second"], named["third"]], axis=1)
    hits = pack_hits(named["depth"], named["face"].view(np.int32), barycentric)
    shading, geometric = (
        np.stack([named[f"{kind}_{axis}"] for axis in "xyz"], axis=1).astype(np.float64)
        for kind in ("normal", "geometric")
    )
    return hits, shading, geometric
