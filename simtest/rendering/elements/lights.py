"""Lights in a kernel: points of their sources, emission, and the emitter plugin for further bounces.

Direct light and the plugin call the same `factor`, so that both come from the same lights.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from simtest.rendering import kernel_values
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import MitsubaDict, spectrum
from simtest.runtime.arrays import Array
from simtest.spec.lights import (
    CosineProfile,
    CrescentSource,
    DiscSource,
    LightSpec,
    RingSource,
    Source,
    TableProfile,
)

SLICES = 160
"""Slices of a crescent, of about equal area; each pair of fixed points lies in the middle of five of them."""


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
    source = "point" if light.source is None else light.source.type
    plain = light.is_isotropic and len(set(light.colour)) == 1 and source == "point"
    entries = len(light.profile.angle_deg) if isinstance(light.profile, TableProfile) else 0
    profile = "table" if entries else "uniform" if light.profile.model().is_uniform else "cosine"
    return LightKind(profile, entries, light.spot_deg is not None, plain, source)


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
def make_light(variant: str) -> Any:  # noqa: C901 - a class whose base is known at run time only
    """Return the emitter plugin's class of a variant."""

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
