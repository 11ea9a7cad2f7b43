"""Instruments: rays meet their round cones in closed form in a kernel, so that a moved one compiles nothing.

They are no part of the Mitsuba scene. Whatever searches the tissue's truth sees the tissue alone; a frame's kernel asks
which of both is nearer, and shadow rays ask both. Here is also which pixels they cover, and which highlights they hide.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.rendering.backend import dr, mi
from simtest.rendering.elements.base import reflected
from simtest.rendering.frames import HighlightPoint, Maps, Real
from simtest.rendering.kernel_values import channels, spectrum, vectors_to_kernel
from simtest.rendering.placement_checks import check_instruments
from simtest.rendering.rays import Hit
from simtest.runtime.arrays import Array, Image, IntArray, Mask
from simtest.spec.lights import is_at_camera
from simtest.spec.surfaces import DEFAULT_DEPTH_SHARE, Instrument
from simtest.surfaces.instrument import RoundCones, round_cones

if TYPE_CHECKING:
    from simtest.rendering.session import Session


PER_PART = 12
"""Numbers of a round cone: start (3), axis (3), length, radii (2), sine and cosine of its slope, instrument."""

PER_METAL = 8
"""Numbers of an instrument's metal: roughness, matt share, metal (3), matt base (3)."""


NEAR, ALONG = 1.01, 1e-6
"""Of a cone's radius, how near a ray's line passes that is tried; the squared sine to the axis below which all are."""


@dataclass(frozen=True)
class Metal:
    """Instruments' reflectance, in place of `Material`: GGX with Schlick's Fresnel term, blended with a matt base."""

    alpha: Any
    share: Any
    metal: Any
    matt: Any

    def towards(self, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the matt base towards a direction of the model frame."""
        si = hit.base
        wi, wo = si.wi, si.to_local(direction)
        active &= (wi.z > 0) & (wo.z > 0)
        up = mi.Vector3f(0, 0, 1)
        wi, wo = dr.select(active, wi, up), dr.select(active, wo, up)
        _, lobe, facing = reflected(wi, wo, self.alpha, True)
        fresnel = self.metal + (1 - self.metal) * (1 - facing) ** 5
        base = self.matt * (self.share * dr.inv_pi * wo.z)
        return dr.select(active, fresnel * (lobe * (1 - self.share)), 0), dr.select(active, base, 0)


class Blockers:
    """What shadow rays ask in place of a scene: its surface and the instruments."""

    def __init__(self, scene: Any, kernel: "InstrumentKernel") -> None:
        self._scene, self._kernel = scene, kernel

    def ray_test(self, ray: Any, coherent: bool, active: Any) -> Any:
        """Return which rays are blocked before their end."""
        blocked = self._scene.ray_test(ray, coherent, active)
        return blocked | self._kernel.blocked(ray, active & ~blocked)


class InstrumentKernel:
    """Traces instruments, by index in the scene's list, and their cones in the model frame, mm.

    All numbers lie in one buffer (see `AlbedoKernel`), and how many there are is no part of the kernel either.
    """

    def __init__(self, cones: RoundCones, instruments: Mapping[int, Instrument]) -> None:
        self.cones = cones
        h = cones.lengths
        sine = (cones.radii[:, 0] - cones.radii[:, 1]) / h
        rank = {index: number for number, index in enumerate(instruments)}
        owners = [rank[index] for index in cones.owners.tolist()]
        axes = (cones.ends - cones.starts) / h[:, None]
        numbers = np.column_stack([cones.starts, axes, h, cones.radii, sine, np.sqrt(1 - sine**2), owners])
        metals = [(one.alpha, one.diffuse, *one.metal, *one.colour) for one in instruments.values()]
        self._data = mi.Float64(np.concatenate([numbers.ravel(), np.ravel(metals)]))
        self._count = mi.UInt32(len(numbers))
        dr.make_opaque(self._data, self._count)

    def first(self, origin: Any, direction: Any, active: Any) -> tuple[Any, Any]:
        """Return the distance to the first cone on rays, mitsuba.Vector3d, unit; inf without; and the cone's number."""

        def met(part: Any, nearest: Any, nearest_part: Any) -> tuple[Any, Any]:
            for root, valid in self._roots(part, origin, direction, active):
                closer = valid & (root > 0) & (root < nearest)
                nearest, nearest_part = dr.select(closer, root, nearest), dr.select(closer, part, nearest_part)
            return nearest, nearest_part

        def step(part: Any, *found: Any) -> tuple[Any, Any, Any]:
            near = self._passes(part, origin, direction, active)
            return part + 1, *dr.if_stmt((part, *found), near, met, lambda part, *found: found)

        start = (mi.UInt32(0), mi.Float64(dr.inf), mi.UInt32(0))
        _, nearest, nearest_part = dr.while_loop(start, lambda part, *_: active & (part < self._count), step)
        return nearest, nearest_part

    def blocked(self, ray: Any, active: Any) -> Any:
        """Return which rays, mitsuba.Ray3f of unit directions, meet a cone before their end; in single precision."""
        origin, direction = mi.Vector3f(ray.o), mi.Vector3f(ray.d)

        def met(part: Any, hidden: Any) -> Any:
            for root, valid in self._roots(part, origin, direction, active):
                hidden |= valid & (root > 0) & (root < ray.maxt)
            return hidden

        def step(part: Any, hidden: Any) -> tuple[Any, Any]:
            # A branch, since few rays pass near.
            near = self._passes(part, origin, direction, active)
            return part + 1, dr.if_stmt((part, hidden), near, met, lambda part, hidden: hidden)

        _, hidden = dr.while_loop(
            (mi.UInt32(0), mi.Bool(False)), lambda part, hidden: active & ~hidden & (part < self._count), step
        )
        return hidden

    def _passes(self, part: Any, o: Any, d: Any, active: Any) -> Any:
        """Return which rays pass the line of a round cone's axis no farther off than its radii, and some more."""
        start, axis, _, r1, r2, *_ = self._shape(part, active, type(o))
        across = dr.cross(d, axis)
        squared, reach = dr.squared_norm(across), NEAR * dr.maximum(r1, r2)
        # Nearly along the axis, rounding decides.
        return (dr.square(dr.dot(o - start, across)) <= dr.square(reach) * squared) | (squared < ALONG)

    def _roots(self, part: Any, o: Any, d: Any, active: Any) -> Iterator[tuple[Any, Any]]:
        """Yield where rays enter each ball, and both roots of the cone between their tangents; and whether they do."""
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
        real = mi.Float if vector is mi.Vector3f else mi.Float64
        n = [real(self._number(part * PER_PART + k, active)) for k in range(PER_PART - 1)]
        return vector(*n[:3]), vector(*n[3:6]), *n[6:]

    def _number(self, index: Any, active: Any) -> Any:
        return dr.gather(mi.Float64, self._data, index, active)

    def normal(self, position: Any, part: Any, active: Any) -> Any:
        """Return the unit normals, mitsuba.Vector3d, at points of round cones."""
        start, axis, h, _, _, sine, cosine = self._shape(part, active, mi.Vector3d)
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
        distance, part = self.first(rays.origin, rays.direction, rays.active)
        is_hit = rays.active & dr.isfinite(distance)
        position = mi.Vector3d(rays.origin + rays.direction * dr.select(is_hit, distance, 1))
        normal = mi.Normal3f(self.normal(position, part, is_hit))
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.t = dr.select(is_hit, mi.Float(distance), mi.Float(dr.inf))
        si.p, si.n, si.sh_frame = mi.Point3f(position), normal, mi.Frame3f(normal)
        si.wi = si.to_local(-mi.Vector3f(rays.direction))
        # Its metal.
        owner = mi.UInt32(self._number(part * PER_PART + PER_PART - 1, is_hit))
        first = self._count * PER_PART + owner * PER_METAL
        n = [mi.Float(self._number(first + k, is_hit)) for k in range(PER_METAL)]
        return Hit(si, si, si), Metal(n[0], n[1], self._colour(n[2:5]), self._colour(n[5:8]))

    def _colour(self, rgb: list[Any]) -> Any:
        if channels() == 3:
            return mi.Color3f(*rgb)
        # As `spectrum` makes it of numbers: the luminance.
        weights = [spectrum(unit) for unit in np.eye(3).tolist()]
        return mi.Spectrum(sum(value * weight for value, weight in zip(rgb, weights, strict=True)))

    # Single rays -------------------------------------------------------------------------------------------------

    def cast(self, origins: Array, directions: Array) -> tuple[Array, Array, Array]:
        """Trace rays of the model frame, shape (N, 3), unit; NaN ones hit nothing.

        Returns the distance, mm, inf without an instrument; its unit normal, shape (N, 3), model frame; and its index
        in the scene's list, -1 without.
        """
        if not len(directions):
            return np.empty(0), np.empty((0, 3)), np.empty(0, dtype=np.int64)
        asked = np.isfinite(directions).all(axis=1)
        whole = np.where(np.reshape(asked, (-1, 1)), directions, [0.0, 0.0, 1.0])
        both = np.broadcast_to(origins, whole.shape), whole
        o, d = (vectors_to_kernel(mi.Vector3d, mi.Float64, rays, np.float64) for rays in both)
        active = mi.Bool(asked)
        distance, part = self.first(o, d, active)
        is_hit = active & dr.isfinite(distance)
        normal = self.normal(o + d * dr.select(is_hit, distance, 1), part, is_hit)
        dr.eval(distance, part, normal, is_hit)
        hit = np.array(is_hit)
        owner = self.cones.owners[np.where(hit, np.array(part), 0)]
        return np.where(hit, np.array(distance), np.inf), np.array(normal).T, np.where(hit, owner, -1)


SEARCH_PX = 16
"""Spacing of the sightlines among which the nearest one to a tip is taken that meets the surface."""

ROUNDING = 1e-6
"""An instrument nearer to a point than this share of the distance touches it, and does not hide it."""


def place(session: "Session") -> InstrumentKernel | None:
    """Return the kernel of a scene's instruments at their places; None without any."""
    shown = session.scene.shown_instruments
    if not shown:
        return None
    cones = round_cones(shown, {index: _tip(session, index, one) for index, one in shown.items()})
    check_instruments(session.scene, session.camera, cones)
    return InstrumentKernel(cones.moved(session.surface.model_from_camera), shown)


def _tip(session: "Session", index: int, instrument: Instrument) -> Array:
    """Return where an instrument's tip is, shape (3,), camera frame, mm."""
    camera, where = session.camera, f"scene {session.scene.name}: instruments.{index}"
    pixel = np.array(instrument.tip) * [camera.width, camera.height]
    sightline = camera.unproject(pixel[None])[0]
    if not np.isfinite(sightline).all():
        raise InputError(f"{where}.tip = {list(instrument.tip)}: no sightline leads there; must be nearer the middle")
    if instrument.depth_mm is not None:
        return np.asarray(instrument.depth_mm * sightline)
    # The surface's distance there, or where it is nearest in the picture.
    grid = camera.pixel_centres()[SEARCH_PX // 2 :: SEARCH_PX, SEARCH_PX // 2 :: SEARCH_PX].reshape(-1, 2)
    pixels = np.concatenate([pixel[None], grid, [[camera.width / 2, camera.height / 2]]])
    distance = session.exact_hits(*session.sightlines.in_model(pixels)).distance
    hit = np.flatnonzero(np.isfinite(distance))
    if not len(hit):
        raise InputError(f"{where}.depth_share: no sightline meets the surface; must be depth_mm where none does")
    nearest = hit[np.argmin(np.linalg.norm(pixels[hit] - pixel, axis=1))]
    share = DEFAULT_DEPTH_SHARE if instrument.depth_share is None else instrument.depth_share
    return np.asarray(share * distance[nearest] * sightline)


_NORMALS = ("normal", "shading_normal", "geometric_normal", "normal_base")


@dataclass(frozen=True)
class Cover:
    """What instruments cover of a frame, on the rays through the pixels' centres."""

    # (H, W): index in the scene's list of the instrument that is seen; -1 where the surface or nothing is
    instrument: IntArray
    distance: Array  # (H, W): along the ray, mm
    # position, normal: (H, W, 3): camera frame, mm and unit; like `distance` they hold where an instrument is seen
    position: Array
    normal: Array

    @property
    def seen(self) -> Mask:
        """Where an instrument is seen, shape (H, W)."""
        return np.asarray(self.instrument >= 0)

    @property
    def numbers(self) -> npt.NDArray[np.uint8]:
        """1 + the index, 0 where no instrument is seen, shape (H, W)."""
        return (self.instrument + 1).astype(np.uint8)

    def every(self, stride: int) -> "Cover":
        """Return what is covered of every `stride`-th pixel."""
        return Cover(*(values[::stride, ::stride] for values in vars(self).values()))

    def over(self, maps: Maps[Real]) -> Maps[Real]:
        """Return labels or truth of a frame with those of the instruments over those of the surface."""
        above: dict[str, Any] = {
            "depth": self.distance, "position": self.position, "pool": False, "mask": True, "face": 0,
            "polyp": 0, "instrument": self.instrument + 1, **dict.fromkeys(_NORMALS, self.normal),
        }  # fmt: skip
        made: dict[str, Any] = {}
        for name, below in vars(maps).items():
            if name in _NORMALS[1:] and below is maps.normal:
                made[name] = made["normal"]
            elif below is not None:
                seen = self.seen[..., None] if below.ndim == 3 else self.seen
                made[name] = np.where(seen, above.get(name, np.nan), below).astype(below.dtype)
        return replace(maps, **made)


def cover_of(session: "Session", kernel: InstrumentKernel, depth: Image) -> Cover:
    """Return what instruments cover of a frame whose surface is at `depth`, shape (H, W), mm; NaN: there is none."""
    camera = session.camera
    pixels = camera.pixel_centres().reshape(-1, 2)
    distance, normal, instrument = kernel.cast(*session.sightlines.in_view(pixels))
    # In single precision, as the frame decides.
    nearer = distance.astype(np.float32) < np.nan_to_num(np.ravel(depth), nan=np.inf).astype(np.float32)
    size = (camera.height, camera.width)
    reached = np.where(nearer, distance, np.nan)
    position = reached[:, None] * camera.unproject(pixels)
    normal = normal @ session.surface.model_from_camera[:3, :3]
    index = np.where(nearer, instrument, -1).reshape(size)
    return Cover(index, reached.reshape(size), position.reshape(*size, 3), normal.reshape(*size, 3))


def shade(session: "Session", kernel: InstrumentKernel, points: list[HighlightPoint]) -> list[HighlightPoint]:
    """Return highlight points of the surface; those are not lit that instruments hide or keep the light from."""
    if not points:
        return []
    positions = np.stack([point.position for point in points])
    sources = session.scene.rig.true_mm()[[point.light for point in points]]
    hidden = _blocked(session, kernel, np.zeros((1, 3)), positions)
    # A light at the camera reaches all that is seen.
    shaded = ~np.array([is_at_camera(source) for source in sources])
    shaded[shaded] = _blocked(session, kernel, sources[shaded], positions[shaded])
    return [
        replace(point, lit=point.lit and not (behind or dark), hidden=bool(behind))
        for point, behind, dark in zip(points, hidden.tolist(), shaded.tolist(), strict=True)
    ]


def _blocked(session: "Session", kernel: InstrumentKernel, sources: Array, positions: Array) -> Mask:
    """Return which positions, shape (N, 3), an instrument hides from sources, (1, 3) or (N, 3), camera frame, mm."""
    towards = positions - sources
    distance = np.linalg.norm(towards, axis=1)
    directions = towards / distance[:, None] @ session.surface.model_from_camera[:3, :3].T
    return np.asarray(kernel.cast(session.to_model(sources), directions)[0] < distance * (1 - ROUNDING))
