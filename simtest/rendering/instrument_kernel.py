"""Instruments inside a kernel: rays meet their round cones in closed form, so that a moved one compiles nothing.

They are no part of the Mitsuba scene. Whatever searches the tissue's truth sees the tissue alone; a frame's kernel asks
which of both is nearer, and shadow rays ask both.
"""

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.rendering.hits import Hit
from simtest.rendering.mitsuba_values import channels, spectrum
from simtest.rendering.tissue import facet_density, visible_over_cosine
from simtest.runtime.arrays import Array
from simtest.spec.surfaces import Instrument
from simtest.surfaces.instrument import RoundCones

PER_PART = 12
"""Numbers of a round cone: start (3), axis (3), length, radii (2), sine and cosine of its slope, instrument."""

PER_METAL = 8
"""Numbers of an instrument's metal: roughness, matt share, metal (3), matt base (3)."""


@dataclass(frozen=True)
class Metal:
    """The reflectance of instruments at the points that a kernel hits; evaluated as `direct.Material` is.

    A rough conductor, GGX with Schlick's Fresnel term, blended with a matt base.
    """

    alpha: Any
    share: Any
    metal: Any
    matt: Any

    def painted(self, hit: Hit) -> AbstractContextManager[None]:
        """Metal has no pattern."""
        return nullcontext()

    def towards(self, mi: Any, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the matt base towards a direction of the model frame."""
        import drjit as dr

        si = hit.base
        wi, wo = si.wi, si.to_local(direction)
        active &= (wi.z > 0) & (wo.z > 0)
        up = mi.Vector3f(0, 0, 1)
        wi, wo = dr.select(active, wi, up), dr.select(active, wo, up)
        both = wi + wo
        squared = (dr.square(both.x) + dr.square(both.y)) / dr.square(both.z)
        # 1 minus the cosine at the facet, without cancellation.
        grazing = 1 - dr.minimum(dr.norm(both) / 2, 1)
        fresnel = self.metal + (1 - self.metal) * grazing**5
        seen, lit = visible_over_cosine(wi, self.alpha, True), visible_over_cosine(wo, self.alpha, True)
        lobe = facet_density(squared, self.alpha, True) * seen * lit * wo.z / 4
        base = self.matt * (self.share * dr.inv_pi * wo.z)
        return dr.select(active, fresnel * (lobe * (1 - self.share)), 0), dr.select(active, base, 0)


class _Blockers:
    """What stands before lights: the scene's surface and the instruments."""

    def __init__(self, scene: Any, kernel: "InstrumentKernel") -> None:
        self._scene, self._kernel = scene, kernel

    def ray_test(self, ray: Any, coherent: bool, active: Any) -> Any:
        """Return which rays are blocked before their end."""
        blocked = self._scene.ray_test(ray, coherent, active)
        return blocked | self._kernel.blocked(ray, active & ~blocked)


class InstrumentKernel:
    """Traces instruments.

    All numbers lie in one buffer (see `albedo.AlbedoKernel`), and how many there are is no part of the kernel either.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    cones : RoundCones
        Model frame, mm.
    instruments : mapping
        By index, those that the cones belong to.
    """

    def __init__(self, mi: Any, cones: RoundCones, instruments: Mapping[int, Instrument]) -> None:
        import drjit as dr

        self.mi, self.cones = mi, cones
        h = cones.lengths
        sine = (cones.radii[:, 0] - cones.radii[:, 1]) / h
        rank = {index: number for number, index in enumerate(instruments)}
        owners = [rank[index] for index in cones.owners.tolist()]
        axes = (cones.ends - cones.starts) / h[:, None]
        numbers = np.column_stack([cones.starts, axes, h, cones.radii, sine, np.sqrt(1 - sine**2), owners])
        metals = [(one.alpha, one.diffuse, *one.metal, *one.colour) for one in instruments.values()]
        self._data = mi.Float64(np.concatenate([numbers.ravel(), np.ravel(metals)]))
        self._count = mi.UInt32(len(numbers))
        self._names = np.array(list(instruments), dtype=np.int64)
        dr.make_opaque(self._data, self._count)

    def first(self, origin: Any, direction: Any, active: Any) -> tuple[Any, Any]:
        """Return the distance to the first cone on rays, mitsuba.Vector3d, unit; inf without; and the cone's number."""
        import drjit as dr

        mi = self.mi

        def step(part: Any, nearest: Any, found: Any) -> tuple[Any, Any, Any]:
            for root, valid in self._roots(part, origin, direction, active):
                closer = valid & (root > 0) & (root < nearest)
                nearest, found = dr.select(closer, root, nearest), dr.select(closer, part, found)
            return part + 1, nearest, found

        start = (mi.UInt32(0), mi.Float64(dr.inf), mi.UInt32(0))
        _, nearest, found = dr.while_loop(start, lambda part, *_: active & (part < self._count), step)
        return nearest, found

    def blocked(self, ray: Any, active: Any) -> Any:
        """Return which rays, mitsuba.Ray3f of unit directions, meet a cone before their end; in single precision."""
        import drjit as dr

        mi = self.mi
        origin, direction = mi.Vector3f(ray.o), mi.Vector3f(ray.d)

        def step(part: Any, hidden: Any) -> tuple[Any, Any]:
            for root, valid in self._roots(part, origin, direction, active):
                hidden |= valid & (root > 0) & (root < ray.maxt)
            return part + 1, hidden

        _, hidden = dr.while_loop(
            (mi.UInt32(0), mi.Bool(False)), lambda part, hidden: active & ~hidden & (part < self._count), step
        )
        return hidden

    def _roots(self, part: Any, o: Any, d: Any, active: Any) -> Iterator[tuple[Any, Any]]:
        """Yield where rays enter each ball, and both roots of the cone between their tangents; and whether they do."""
        import drjit as dr

        start, axis, h, r1, r2, sine, cosine = self._shape(part, active, type(o))
        o = o - start
        y, v = dr.dot(o, axis), dr.dot(d, axis)
        # Across the axis, so that a long shaft costs no digits.
        q, p = o - axis * y, d - axis * v
        for centre, radius in ((0, r1), (h, r2)):
            near = o - axis * centre
            b = dr.dot(near, d)
            c = dr.squared_norm(near - d * b)
            inside = dr.square(radius) - c
            yield -b - dr.safe_sqrt(inside), active & (inside > 0)
        # Between the tangents: cosine |q + t p| = radius(t), of a radius that is linear along the axis.
        radius, slope = r1 - sine * y, sine * v
        a = dr.square(cosine) * dr.squared_norm(p) - dr.square(slope)
        b = dr.square(cosine) * dr.dot(q, p) + radius * slope
        c = dr.square(cosine) * dr.squared_norm(q) - dr.square(radius)
        inside = b * b - a * c
        # Without cancellation: one root is w/a, the other c/w.
        w = -(b + dr.copysign(dr.safe_sqrt(inside), b))
        for root in (w / a, c / w):
            x = (radius - slope * root) / cosine
            along = cosine * (y + v * root) - sine * x
            yield root, active & (inside > 0) & (x > 0) & (along > 0) & (along < cosine * h)

    def _shape(self, part: Any, active: Any, vector: Any) -> tuple[Any, ...]:
        """Return start, axis, length, radii, sine and cosine of round cones, in the precision of a type of vectors."""
        real = self.mi.Float if vector is self.mi.Vector3f else self.mi.Float64
        n = [real(self._number(part * PER_PART + k, active)) for k in range(PER_PART - 1)]
        return vector(*n[:3]), vector(*n[3:6]), *n[6:]

    def _number(self, index: Any, active: Any) -> Any:
        import drjit as dr

        return dr.gather(self.mi.Float64, self._data, index, active)

    def normal(self, position: Any, part: Any, active: Any) -> Any:
        """Return the unit normals, mitsuba.Vector3d, at points of round cones."""
        import drjit as dr

        start, axis, h, _, _, sine, cosine = self._shape(part, active, self.mi.Vector3d)
        o = position - start
        y = dr.dot(o, axis)
        q = o - axis * y
        x = dr.norm(q)
        along = cosine * y - sine * x
        between = q * (cosine / dr.maximum(x, 1e-12)) + axis * sine
        on_ball = o - axis * dr.select(along <= 0, 0, h)
        return dr.normalize(dr.select((along <= 0) | (along >= cosine * h), on_ball, between))

    def hit(self, rays: Any) -> tuple[Hit, Metal]:
        """Return the first points of instruments on a launch's rays (`Rays`), and their metal."""
        import drjit as dr

        mi = self.mi
        distance, part = self.first(rays.origin, rays.direction, rays.active)
        found = rays.active & dr.isfinite(distance)
        position = mi.Vector3d(rays.origin + rays.direction * dr.select(found, distance, 1))
        normal = mi.Normal3f(self.normal(position, part, found))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t = dr.select(found, mi.Float(distance), mi.Float(dr.inf))
        si.p, si.n, si.sh_frame = mi.Point3f(position), normal, mi.Frame3f(normal)
        si.wi = si.to_local(-mi.Vector3f(rays.direction))
        return Hit(si, si, si), self._metal(part, found)

    def _metal(self, part: Any, active: Any) -> Metal:
        mi = self.mi
        owner = mi.UInt32(self._number(part * PER_PART + PER_PART - 1, active))
        first = self._count * PER_PART + owner * PER_METAL
        n = [mi.Float(self._number(first + k, active)) for k in range(PER_METAL)]
        return Metal(n[0], n[1], self._colour(n[2:5]), self._colour(n[5:8]))

    def _colour(self, rgb: list[Any]) -> Any:
        if channels(self.mi) == 3:
            return self.mi.Color3f(*rgb)
        # As `spectrum` makes it of numbers: the luminance.
        weights = [spectrum(self.mi, unit) for unit in np.eye(3).tolist()]
        return self.mi.Spectrum(sum(value * weight for value, weight in zip(rgb, weights, strict=True)))

    def before(self, scene: Any) -> Any:
        """Return what shadow rays ask in place of a scene: its surface and the instruments."""
        return _Blockers(scene, self)

    # Single rays -------------------------------------------------------------------------------------------------

    def cast(self, origins: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Trace rays of the model frame, shape (N, 3), unit; NaN ones hit nothing.

        Returns
        -------
        distance : ndarray, shape (N,)
            mm; inf without an instrument.
        normal : ndarray, shape (N, 3)
            Unit, model frame.
        instrument : ndarray of int, shape (N,)
            Its index in the scene's list; -1 without.
        """
        import drjit as dr

        if not len(directions):
            return np.empty(0), np.empty((0, 3)), np.empty(0, dtype=np.int64)
        mi, asked = self.mi, np.isfinite(directions).all(axis=1)
        whole = np.where(np.reshape(asked, (-1, 1)), directions, [0.0, 0.0, 1.0])
        o = mi.Vector3d(np.ascontiguousarray(np.broadcast_to(origins, whole.shape).T))
        d, active = mi.Vector3d(np.ascontiguousarray(whole.T)), mi.Bool(asked)
        distance, part = self.first(o, d, active)
        found = active & dr.isfinite(distance)
        normal = self.normal(o + d * dr.select(found, distance, 1), part, found)
        dr.eval(distance, part, normal, found)
        met = np.array(found)
        owner = self.cones.owners[np.where(met, np.array(part), 0)]
        return np.where(met, np.array(distance), np.inf), np.array(normal).T, np.where(met, owner, -1)
