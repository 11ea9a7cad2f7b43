"""The lights: points of their sources, emission, and the direct light that a surface reflects, in closed form.

Direct light and Mitsuba's emitter for further bounces call the same `factor`, so that both come from the same lights.
"""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, Protocol

import numpy as np

from simtest.rendering import kernel_values
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import MitsubaDict, channel_mean, spectrum
from simtest.rendering.rays import Hit, Lanes
from simtest.rendering.tissue_kernels import AlbedoKernel
from simtest.runtime.arrays import Array
from simtest.spec.lights import (
    CosineProfile,
    CrescentSource,
    DiscSource,
    LightSpec,
    Rig,
    RingSource,
    Source,
    TableProfile,
    is_at_camera,
)

DRAWN = 4
"""Points of each source at each of a pixel's samples."""

FIXED = 64
"""Points of each source where a pixel has one sample, the same in all pixels: the picture has no noise."""

SLICES = 5 * FIXED // 2
"""Slices of a crescent, of about equal area; each pair of fixed points lies in the middle of one."""

_GOLDEN = 0x9E3779B9
"""The golden ratio as a share of 2^32: its multiples beside equal steps cover the square evenly (Vogel's spiral)."""

_SILVER = 0x6A09E667
"""The root of 2 the same way, for the choice of a shadow ray's target."""


@dataclass(frozen=True)
class LightDraw:
    """Which points of the sources a sample of each pixel takes: some of one spiral over all samples of the pixel."""

    # first, step: Number of the first point, and from one to the next; the latter is the number of samples
    first: Any
    step: Any
    total: Any  # Points of all samples of the pixel together
    # Random shifts of the pixel's points and choices, shares of 2^32; None for the fixed points
    shifts: tuple[Any, Any, Any] | None

    def square(self, kind: str, number: Any, light: int) -> tuple[Any, Any]:
        """Return u and v in [0, 1) of a sample's point by number, for a light by index; even in v around a ring."""
        index = self.first + number * self.step
        if self.shifts is None:
            # Pairs of opposite points, so that the centroid is exact: where it is off the highlight moves.
            pair, opposite = index >> 1, (index & 1) << 31
            even, turn = (2 * mi.Float(pair) + 1) / self.total, pair * mi.UInt32(_GOLDEN)
            if kind == "ring":
                return _share(turn), even / 2 + _share(opposite)
            return even, _share(turn + opposite)
        # Lights get other points each, else their errors would add up.
        along = _share(self.shifts[0] + mi.UInt32(light * _GOLDEN & 0xFFFFFFFF))
        turn = index * mi.UInt32(_GOLDEN) + self.shifts[1] + mi.UInt32(light * _SILVER & 0xFFFFFFFF)
        even = (mi.Float(index) + along) / self.total
        return (_share(turn), even) if kind == "ring" else (even, _share(turn))

    def choice(self, light: int) -> Any:
        """Return a number in [0, 1), mitsuba.Float, to choose one of the points by."""
        assert self.shifts is not None
        return _share(self.shifts[2] + (self.first + mi.UInt32(light)) * mi.UInt32(_SILVER))


def _share(number: Any) -> Any:
    """Return a share of 2^32 as a number in [0, 1); single precision holds 24 bits."""
    return mi.Float(number >> 8) * 2.0**-24


class Drawer:
    """Draws of one launch's samples, of so many for each pixel; without lanes the fixed points."""

    def __init__(self, lanes: Lanes | None, samples: int) -> None:
        self._shifts = None
        self._step = mi.UInt32(1 if lanes is None else samples)
        self._total = mi.Float(FIXED if lanes is None else DRAWN * samples)
        dr.make_opaque(self._step, self._total)
        if lanes is not None:
            # Other numbers than those of the places in the pixel, from the same seed. The golden ratio's field is not
            # that of the places' recurrence: place and point are independent of each other.
            first = mi.sample_tea_32(lanes.shift_x, lanes.shift_y)
            self._shifts = (*first, mi.sample_tea_32(*first)[0])

    def at(self, number: Any) -> LightDraw:
        """Return the draw of a pixel's sample by its number."""
        return LightDraw(mi.UInt32(number), self._step, self._total, self._shifts)


def source_kind(source: Source | None) -> str:
    """Return which form of source is compiled into the kernel."""
    return "point" if source is None else source.type


def source_parameters(source: Source, centroid: Array, across: Array) -> MitsubaDict:
    """Return a source's parameters by name, from its centroid and the axes of its plane, model frame, mm."""
    centre = centroid - source.centroid_mm @ across
    if not isinstance(source, CrescentSource):
        inner = source.inner_mm if isinstance(source, RingSource) else 0.0
        own = {"inner2": mi.Float(inner**2), "outer2": mi.Float(source.radius_mm**2)}
    else:
        # x of the plane points towards the cut.
        x = source.towards_cut @ across
        across = np.stack([x, [-source.towards_cut[1], source.towards_cut[0]] @ across])
        own = {
            "outer2": mi.Float(source.radius_mm**2),
            "cut2": mi.Float(source.cut_radius_mm**2),
            "cut_at": mi.Float(source.cut_offset_mm),
            "area": mi.Float(source.area_mm2),
            "knots": mi.Float(source.quantiles(SLICES).astype(np.float32)),
        }
    return {
        "centre": mi.Point3f(*centre.tolist()),
        "side": mi.Vector3f(*across[0].tolist()),
        "up": mi.Vector3f(*across[1].tolist()),
        **own,
    }


def blank(kind: str) -> MitsubaDict:
    """Return parameters of some source of a kind, for a plugin that gets its values later."""
    some: dict[str, Source] = {
        "disc": DiscSource(type="disc", radius_mm=1.0),
        "ring": RingSource(type="ring", radius_mm=1.0, inner_mm=0.5),
        "crescent": CrescentSource(type="crescent", radius_mm=1.0, cut_radius_mm=1.0, cut_offset_mm=1.0),
    }
    return {} if kind == "point" else source_parameters(some[kind], np.zeros(3), np.eye(3)[:2])


def point(kind: str, values: MitsubaDict, u: Any, v: Any) -> tuple[Any, Any]:
    """Compute a point of a source, mitsuba.Point3f, mm, and its weight, 1 on average over the unit square."""
    if kind != "crescent":
        radius = dr.sqrt(dr.lerp(values["inner2"], values["outer2"], u))
        sine, cosine = dr.sincos(dr.two_pi * v)
        return values["centre"] + radius * (cosine * values["side"] + sine * values["up"]), mi.Float(1)
    # Slice by slice: along the knots, then over both parts of the chord, beyond the cut and this side of it.
    slices = dr.minimum(mi.UInt32(u * SLICES), SLICES - 1)
    low, high = dr.gather(mi.Float, values["knots"], slices), dr.gather(mi.Float, values["knots"], slices + 1)
    along = dr.lerp(low, high, u * SLICES - mi.Float(slices))
    outer = dr.safe_sqrt(values["outer2"] - dr.square(along))
    cut = dr.minimum(dr.safe_sqrt(values["cut2"] - dr.square(along - values["cut_at"])), outer)
    across = 2 * v - 1
    height = dr.copysign(dr.lerp(cut, outer, dr.abs(across)), across)
    # Slices are of equal area only nearly: the weight makes up for the rest.
    weight = 2 * (outer - cut) * (high - low) * SLICES / values["area"]
    return values["centre"] + along * values["side"] + height * values["up"], weight


LIGHT = "simtest_light"


@dataclass(frozen=True)
class LightKind:
    """What of a light is compiled into the kernel; everything else is a parameter."""

    profile: str  # {"uniform", "cosine", "table"}: Form of the angular profile
    entries: int  # Of the table; 0 without one
    spot: bool  # Whether the emission is cut off
    plain: bool  # Whether Mitsuba's own point light is the same light
    source: str = "point"  # {"point", "disc", "ring", "crescent"}: Form of its exit


@dataclass(frozen=True)
class LightPose:
    """Where a light is in the model frame."""

    position: Array  # (3,): of its centroid, mm
    axis: Array  # (3,): unit vector
    across: Array  # (2, 3): unit vectors x and y of its source's plane


def kind_of(light: LightSpec) -> LightKind:
    """Return the kind of a light."""
    source = source_kind(light.source)
    plain = light.is_isotropic and len(set(light.colour)) == 1 and source == "point"
    match light.profile:
        case TableProfile():
            return LightKind("table", len(light.profile.angle_deg), light.spot_deg is not None, plain, source)
        case CosineProfile():
            uniform = light.profile.power == 0
            return LightKind("uniform" if uniform else "cosine", 0, light.spot_deg is not None, plain, source)


def parameters(light: LightSpec, pose: LightPose) -> MitsubaDict:
    """Return the emitter's parameters by name."""
    # Angles in radians.
    values = {
        "position": mi.Point3f(*pose.position.tolist()),
        "axis": mi.Vector3f(*pose.axis.tolist()),
        "intensity": mi.Spectrum(spectrum([light.power * c for c in light.colour])),
        "exponent": mi.Float(light.profile.power if isinstance(light.profile, CosineProfile) else 0.0),
        "rim": mi.Float(math.radians((light.spot_deg or 360.0) / 2)),
        "edge": mi.Float(math.radians(light.soft_edge_deg)),
    }
    if isinstance(light.profile, TableProfile):
        values["angles"] = mi.Float(np.radians(light.profile.angle_deg).astype(np.float32))
        values["values"] = mi.Float(np.array(light.profile.value, dtype=np.float32))
    if light.source is not None:
        values |= source_parameters(light.source, pose.position, pose.across)
    return values


def factor(kind: LightKind, values: MitsubaDict, away: Any) -> Any:
    """Compute the emission, mitsuba.Float, into unit directions away from a light, relative to that along its axis."""
    if kind.profile == "uniform" and not kind.spot:
        return mi.Float(1)
    axis = values["axis"]
    value = mi.Float(1)
    # Angular profile.
    if kind.profile == "cosine":
        log_cosine, ahead = kernel_values.log_cosine(away, axis)
        value = dr.select(ahead, dr.exp(values["exponent"] * log_cosine), 0)
    if kind.profile == "table" or kind.spot:
        # Not the arc cosine, which loses half of the digits next to the axis.
        angle = dr.atan2(dr.norm(dr.cross(axis, away)), dr.dot(axis, away))
        if kind.profile == "table":
            value = _interpolate(values["angles"], values["values"], angle, kind.entries)
        # Cut-off, with a linear edge where it is soft.
        if kind.spot:
            inside, edge = values["rim"] - angle, values["edge"]
            soft = dr.clip(inside / dr.maximum(edge, 1e-12), 0, 1)
            value *= dr.select(edge > 0, soft, dr.select(inside >= 0, mi.Float(1), mi.Float(0)))
    return value


def _interpolate(knots: Any, values: Any, x: Any, entries: int) -> Any:
    """Interpolate a table linearly; beyond its end the last value holds."""
    upper = dr.binary_search(1, entries - 1, lambda i: dr.gather(mi.Float, knots, i) < x)
    low, high = dr.gather(mi.Float, knots, upper - 1), dr.gather(mi.Float, knots, upper)
    share = dr.clip((x - low) / (high - low), 0, 1)
    return dr.lerp(dr.gather(mi.Float, values, upper - 1), dr.gather(mi.Float, values, upper), share)


def emitter_dict(kind: LightKind) -> MitsubaDict:
    """Describe a light of a kind to `mi.load_dict`; `emitter_values` sets its parameters afterwards."""
    if kind.plain:
        return {"type": "point", "intensity": {"type": "uniform", "value": 1.0}}
    return {
        "type": LIGHT, "profile": kind.profile, "entries": kind.entries, "spot": kind.spot, "source": kind.source,
    }  # fmt: skip


def emitter_values(light: LightSpec, pose: LightPose) -> MitsubaDict:
    """Return the values for the emitter that `emitter_dict` describes, by parameter path (see `parameters`)."""
    if kind_of(light).plain:
        return {"position": mi.Point3f(*pose.position.tolist()), "intensity.value": light.power * light.colour[0]}
    return parameters(light, pose)


@cache
def register_light(variant: str) -> str:
    """Register the emitter plugin for a variant, once (see `simtest.rendering.reflectances.register_phong`)."""
    mi.register_emitter(LIGHT, lambda props: _make_light(variant)(props))
    return LIGHT


@cache
def _make_light(variant: str) -> Any:  # noqa: C901 - a class whose base is known at run time only
    class Light(mi.Emitter):
        """A light with an angular profile, a cut-off and a colour: a point, or a source of finite size.

        A source of finite size takes a point of its area by the sample and is a point light there. The mean is that of
        the area, at any distance; no ray can hit the source by chance.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.kind = LightKind(props["profile"], props["entries"], props["spot"], False, props["source"])
            self.parts: MitsubaDict = {
                "position": mi.Point3f(0), "axis": mi.Vector3f(0, 0, 1), "intensity": mi.Spectrum(1),
                "exponent": mi.Float(0), "rim": mi.Float(dr.pi), "edge": mi.Float(0),
            }  # fmt: skip
            if self.kind.entries:
                self.parts |= {name: dr.zeros(mi.Float, self.kind.entries) for name in ("angles", "values")}
            self.parts |= blank(self.kind.source)
            self.m_flags = mi.EmitterFlags.DeltaPosition
            self.parameters_changed()

        def traverse(self, callback: Any) -> None:
            for name, value in self.parts.items():
                callback.put(name, value, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Any = ()) -> None:
            dr.make_opaque(self.parts)

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            # A point light has one direction, of density 1.
            ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            position, weight = self.parts["position"], mi.Float(1)
            if self.kind.source != "point":
                position, weight = point(self.kind.source, self.parts, sample.x, sample.y)
            towards = position - it.p
            squared = dr.squared_norm(towards)
            ds.p, ds.dist = position, dr.sqrt(squared)
            ds.d = towards / ds.dist
            ds.time, ds.pdf, ds.delta = it.time, mi.Float(1), mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            emitted = self.parts["intensity"] * (weight * factor(self.kind, self.parts, -ds.d))
            return ds, dr.select(active & (squared > 0), emitted / squared, 0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            emitted = self.parts["intensity"] * factor(self.kind, self.parts, -ds.d)
            return dr.select(active, emitted / dr.square(ds.dist), 0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Spectrum(0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"Light[{self.kind}]"

    return Light


class Reflecting(Protocol):
    """What direct light is reflected by: `Material`, or the metal of instruments."""

    def painted(self, hit: Hit) -> AbstractContextManager[None]:
        """Let the base have its albedo at a hit, computed once for all lights."""

    def towards(self, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame."""


@dataclass(frozen=True)
class Material:
    """A surface's reflectance in two parts."""

    bsdf: Any  # The whole
    # The same without its specular part; None where the whole evaluates its parts separately (components 0 and 1)
    base: Any
    # Of tissue, whose BSDF has an `albedo_at`; None where the albedo is the BSDF's own
    albedo: AlbedoKernel | None = None

    @contextmanager
    def painted(self, hit: Hit) -> Iterator[None]:
        """Let the BSDF's base have the albedo of tissue at a hit; nothing where the albedo is the BSDF's own."""
        if self.albedo is None:
            yield
            return
        albedo, own = self.albedo.of(hit.base, hit.base.is_valid()), self.bsdf.albedo_at
        self.bsdf.albedo_at = lambda si, active: albedo
        try:
            yield
        finally:
            self.bsdf.albedo_at = own

    def parts(self, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base."""
        if self.base is None:
            lobe, base = (mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.All, part) for part in (0, 1))
            return self.bsdf.eval(lobe, si, wo, active), self.bsdf.eval(base, si, wo, active)
        # No component is the lobe alone: it is the difference between the whole and the base.
        context = mi.BSDFContext()
        base = self.base.eval(context, si, wo, active)
        return dr.maximum(self.bsdf.eval(context, si, wo, active) - base, 0), base

    def towards(self, hit: Hit, direction: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base towards a direction of the model frame.

        On a relief the lobe follows the fine normal, and the base that of the surface that diffuse light sees.
        """
        lobe, base = self.parts(hit.fine, hit.fine.to_local(direction), active)
        if hit.diffuse is not hit.fine:
            base = self.parts(hit.diffuse, hit.diffuse.to_local(direction), active)[1]
        return lobe, base


class DirectLight:
    """The lights of a rig at their poses in the model frame, as a kernel evaluates them."""

    def __init__(self, rig: Rig, poses: list[LightPose]) -> None:
        self.kinds = [kind_of(light) for light in rig.lights]
        # A point at the camera reaches every point that the camera sees: no shadow rays. The rest of a source that
        # lies about the camera does not.
        self.shadows = [
            not is_at_camera(position) or light.source is not None
            for light, position in zip(rig.lights, rig.true_mm(), strict=True)
        ]
        self.values = [parameters(light, pose) for light, pose in zip(rig.lights, poses, strict=True)]
        # Opaque, so that a moved light compiles no new kernel.
        dr.make_opaque(self.values)

    def drawer(self, lanes: Lanes | None, samples: int = 1) -> Drawer | None:
        """Return what draws points of the sources of finite size for the pixels of a launch; None if all are points."""
        return Drawer(lanes, samples) if any(kind.source != "point" for kind in self.kinds) else None

    def radiance(self, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw | None) -> tuple[Any, Any]:
        """Compute the radiance off lobe and base at surface points; `draw` chooses points of finite sources."""
        with material.painted(hit):
            return self._of_lights(scene, material, hit, draw)

    def _of_lights(self, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw | None) -> tuple[Any, Any]:
        specular, diffuse = mi.Spectrum(0), mi.Spectrum(0)
        for i, kind in enumerate(self.kinds):
            if kind.source == "point":
                shaded = scene if self.shadows[i] else None
                lobe, base = self._from(i, shaded, material, hit, self.values[i]["position"])
            else:
                assert draw is not None
                spread = self._fixed if draw.shifts is None else self._drawn
                lobe, base = spread(i, scene, material, hit, draw)
            specular += lobe
            diffuse += base
        return specular, diffuse

    def _from(self, i: int, scene: Any | None, material: Reflecting, hit: Hit, position: Any) -> tuple[Any, Any]:
        """Compute the radiance by the light of an index from a position; shadow rays only if there is a scene."""
        si, kind, values = hit.base, self.kinds[i], self.values[i]
        towards = position - si.p
        squared = dr.squared_norm(towards)
        direction = towards * dr.rsqrt(squared)
        active = si.is_valid() & (squared > 0)
        if scene is not None:
            # Shadow rays of neighbouring pixels are as coherent as their sightlines.
            active &= ~scene.ray_test(si.spawn_ray_to(position), True, active)
        arriving = values["intensity"] * (factor(kind, values, -direction) / squared)
        lobe, base = material.towards(hit, direction, active)
        return dr.select(active, arriving * lobe, 0), dr.select(active, arriving * base, 0)

    def _fixed(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw) -> tuple[Any, Any]:
        """Compute the mean radiance over the fixed points of a source, with a shadow ray to each.

        Fewer rays would leave steps in penumbrae, since all pixels have the same points.
        """
        kind, values = self.kinds[i], self.values[i]

        def step(number: Any, specular: Any, diffuse: Any) -> tuple[Any, Any, Any]:
            position, weight = point(kind.source, values, *draw.square(kind.source, number, i))
            lobe, base = self._from(i, scene, material, hit, position)
            return number + 1, specular + weight * lobe, diffuse + weight * base

        start, end = (mi.UInt32(0), mi.Spectrum(0), mi.Spectrum(0)), mi.UInt32(draw.total)
        _, specular, diffuse = dr.while_loop(start, lambda number, *_: number < end, step)
        return specular / draw.total, diffuse / draw.total

    def _drawn(self, i: int, scene: Any, material: Reflecting, hit: Hit, draw: LightDraw) -> tuple[Any, Any]:
        """Compute the mean radiance over a sample's points of a source, with one shadow ray to one of them.

        The point is chosen in proportion to the radiance that it causes. Then the whole is without bias, and without
        noise where all points are seen or none. Where some are seen, lobe and base lose the same share.
        """
        si, kind, values = hit.base, self.kinds[i], self.values[i]
        specular, diffuse, whole = mi.Spectrum(0), mi.Spectrum(0), mi.Float(0)
        reached = []
        for number in range(DRAWN):
            position, weight = point(kind.source, values, *draw.square(kind.source, mi.UInt32(number), i))
            lobe, base = self._from(i, None, material, hit, position)
            specular += weight * lobe
            diffuse += weight * base
            whole += weight * channel_mean(lobe + base)
            reached.append((position, mi.Float(whole)))
        # The shadow ray's target: the first point up to which the share of the choice has come together.
        share, (target, _) = draw.choice(i) * whole, reached[-1]
        for position, sum_so_far in reached[-2::-1]:
            target = dr.select(share < sum_so_far, position, target)
        active = si.is_valid() & (whole > 0)
        seen = active & ~scene.ray_test(si.spawn_ray_to(target), True, active)
        scale = dr.select(seen, 1 / mi.Float(DRAWN), 0)
        return specular * scale, diffuse * scale
