"""Hits on analytic shapes in double precision.

Mitsuba's rays are single precision. At a silhouette the hit moves by the ray's rounding over the cosine of view, and
the cosine of the light is small there too: together a relative error of the radiance of 1e-4 and more, although the
light is direct and the surface has a formula. So the hit is solved again from the camera's own ray.
"""

from typing import Any

import numpy as np

from simtest.surfaces import Shape

_ROUND = {"sphere": (1.0, 1.0, 1.0), "cylinder": (1.0, 1.0, 0.0)}
"""Weights of the squared coordinates, whose sum is 1 on Mitsuba's unit shape."""

SAME_HIT = 1e-2
"""A solution farther than this from Mitsuba's hit, relative to the distance, is another point: Mitsuba's is kept."""


class Refinement:
    """Solves the hits on one shape again.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    shape : Shape
        The shape that was hit; hits on a mesh are left as they are.
    """

    def __init__(self, mi: Any, shape: Shape) -> None:
        import drjit as dr

        self.mi, self.shape = mi, shape
        if shape.mesh is None:
            local_from_model = np.linalg.inv(shape.to_model)
            # Opaque, so that a moved or larger shape compiles no new kernel.
            self._turn = mi.Matrix3d(local_from_model[:3, :3].tolist())
            self._shift = mi.Vector3d(local_from_model[:3, 3].tolist())
            self._normals = mi.Matrix3d(local_from_model[:3, :3].T.tolist())
            dr.make_opaque(self._turn, self._shift, self._normals)

    def apply(self, origin: Any, direction: Any, si: Any) -> None:
        """Replace position, normals and local view direction of hits.

        Parameters
        ----------
        origin, direction : mitsuba.Vector3d
            Rays in the model frame, mm; unit directions.
        si : mitsuba.SurfaceInteraction3f
            What Mitsuba found on these rays.
        """
        if self.shape.mesh is not None:
            return
        import drjit as dr

        mi = self.mi
        # Solve on the unit shape.
        o, d = self._turn @ origin + self._shift, self._turn @ direction
        if self.shape.kind == "plane":
            t = -o.z / d.z
            gradient = mi.Vector3d(0, 0, 1)
        else:
            weights = mi.Vector3d(*_ROUND[self.shape.kind])
            t = self._root(weights, o, d, mi.Float64(si.t))
            gradient = weights * (o + t * d)
        # Normals transform by the inverse transpose.
        normal = dr.normalize(self._normals @ gradient) * (-1.0 if self.shape.flip else 1.0)
        # Replace Mitsuba's values where the solution is the same hit.
        found = si.is_valid() & dr.isfinite(t) & (dr.abs(mi.Float(t) - si.t) < SAME_HIT * si.t)
        position = origin + t * direction
        si.p = dr.select(found, mi.Point3f(position), si.p)
        si.n = dr.select(found, mi.Normal3f(normal), si.n)
        si.sh_frame = mi.Frame3f(dr.select(found, mi.Normal3f(normal), si.sh_frame.n))
        si.wi = si.to_local(-mi.Vector3f(direction))

    def _root(self, weights: Any, o: Any, d: Any, near: Any) -> Any:
        """Solve |o + t d|^2 = 1, in the weighted norm, for the t nearest to a distance; NaN where there is none."""
        import drjit as dr

        a, b, c = (dr.sum(weights * p * q) for p, q in ((d, d), (o, d), (o, o)))
        c -= 1
        # Without cancellation: one root is q/a, the other c/q.
        q = -(b + dr.copysign(dr.sqrt(b * b - a * c), b))
        first, second = q / a, c / q
        return dr.select(dr.abs(first - near) < dr.abs(second - near), first, second)
