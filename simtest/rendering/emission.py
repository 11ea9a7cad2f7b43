"""Emission of the lights: as Dr.Jit expressions for direct light, and as a Mitsuba emitter for further bounces.

Both call `factor`, so that direct light and inter-reflections come from the same lights.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from simtest.rendering import light_points, lobes
from simtest.rendering.mitsuba_values import MitsubaDict, spectrum
from simtest.runtime.arrays import Array
from simtest.spec.lights import CosineProfile, LightSpec, TableProfile

PLUGIN = "simtest_light"


@dataclass(frozen=True)
class LightKind:
    """What of a light is compiled into the kernel; everything else is a parameter.

    Parameters
    ----------
    profile : {"uniform", "cosine", "table"}
        Form of the angular profile.
    entries : int
        Of the table; 0 without one.
    spot : bool
        Whether the emission is cut off.
    plain : bool
        Whether Mitsuba's own point light is the same light.
    source : {"point", "disc", "ring", "crescent"}
        Form of its exit.
    """

    profile: str
    entries: int
    spot: bool
    plain: bool
    source: str = "point"


@dataclass(frozen=True)
class LightPose:
    """Where a light is in the model frame.

    Parameters
    ----------
    position : ndarray, shape (3,)
        Of its centroid, mm.
    axis : ndarray, shape (3,)
        Unit vector.
    across : ndarray, shape (2, 3)
        Unit vectors x and y of its source's plane.
    """

    position: Array
    axis: Array
    across: Array


def kind_of(light: LightSpec) -> LightKind:
    """Return the kind of a light."""
    source = light_points.kind_of(light.source)
    plain = light.is_isotropic and len(set(light.colour)) == 1 and source == "point"
    match light.profile:
        case TableProfile():
            return LightKind("table", len(light.profile.angle_deg), light.spot_deg is not None, plain, source)
        case CosineProfile():
            uniform = light.profile.power == 0
            return LightKind("uniform" if uniform else "cosine", 0, light.spot_deg is not None, plain, source)


def parameters(mi: Any, light: LightSpec, pose: LightPose) -> MitsubaDict:
    """Return the emitter's parameters by name."""
    # Angles in radians.
    values = {
        "position": mi.Point3f(*pose.position.tolist()),
        "axis": mi.Vector3f(*pose.axis.tolist()),
        "intensity": mi.Spectrum(spectrum(mi, [light.power * c for c in light.colour])),
        "exponent": mi.Float(light.profile.power if isinstance(light.profile, CosineProfile) else 0.0),
        "rim": mi.Float(math.radians((light.spot_deg or 360.0) / 2)),
        "edge": mi.Float(math.radians(light.soft_edge_deg)),
    }
    if isinstance(light.profile, TableProfile):
        values["angles"] = mi.Float(np.radians(light.profile.angle_deg).astype(np.float32))
        values["values"] = mi.Float(np.array(light.profile.value, dtype=np.float32))
    if light.source is not None:
        values |= light_points.parameters(mi, light.source, pose.position, pose.across)
    return values


def factor(mi: Any, kind: LightKind, values: MitsubaDict, away: Any) -> Any:
    """Compute the emission, mitsuba.Float, into unit directions away from a light, relative to that along its axis."""
    import drjit as dr

    if kind.profile == "uniform" and not kind.spot:
        return mi.Float(1)
    axis = values["axis"]
    value = mi.Float(1)
    # Angular profile.
    if kind.profile == "cosine":
        log_cosine, ahead = lobes.log_cosine(away, axis)
        value = dr.select(ahead, dr.exp(values["exponent"] * log_cosine), 0)
    if kind.profile == "table" or kind.spot:
        # Not the arc cosine, which loses half of the digits next to the axis.
        angle = dr.atan2(dr.norm(dr.cross(axis, away)), dr.dot(axis, away))
        if kind.profile == "table":
            value = _interpolate(mi, values["angles"], values["values"], angle, kind.entries)
        # Cut-off, with a linear edge where it is soft.
        if kind.spot:
            inside, edge = values["rim"] - angle, values["edge"]
            soft = dr.clip(inside / dr.maximum(edge, 1e-12), 0, 1)
            value *= dr.select(edge > 0, soft, dr.select(inside >= 0, mi.Float(1), mi.Float(0)))
    return value


def _interpolate(mi: Any, knots: Any, values: Any, x: Any, entries: int) -> Any:
    """Interpolate a table linearly; beyond its end the last value holds."""
    import drjit as dr

    upper = dr.binary_search(1, entries - 1, lambda i: dr.gather(mi.Float, knots, i) < x)
    low, high = dr.gather(mi.Float, knots, upper - 1), dr.gather(mi.Float, knots, upper)
    share = dr.clip((x - low) / (high - low), 0, 1)
    return dr.lerp(dr.gather(mi.Float, values, upper - 1), dr.gather(mi.Float, values, upper), share)


def emitter_dict(kind: LightKind) -> MitsubaDict:
    """Describe a light of a kind to `mi.load_dict`; `emitter_values` sets its parameters afterwards."""
    if kind.plain:
        return {"type": "point", "intensity": {"type": "uniform", "value": 1.0}}
    return {
        "type": PLUGIN, "profile": kind.profile, "entries": kind.entries, "spot": kind.spot, "source": kind.source,
    }  # fmt: skip


def emitter_values(mi: Any, light: LightSpec, pose: LightPose) -> MitsubaDict:
    """Return the values for the emitter that `emitter_dict` describes, by parameter path (see `parameters`)."""
    if kind_of(light).plain:
        return {"position": mi.Point3f(*pose.position.tolist()), "intensity.value": light.power * light.colour[0]}
    return parameters(mi, light, pose)


@cache
def register(mi: Any, variant: str) -> str:
    """Register the emitter plugin for a variant, once (see `simtest.rendering.phong.register`)."""
    mi.register_emitter(PLUGIN, lambda props: _make_class(mi, variant)(props))
    return PLUGIN


@cache
def _make_class(mi: Any, variant: str) -> Any:  # noqa: C901 - a class whose base is known at run time only
    import drjit as dr

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
            self.parts |= light_points.blank(mi, self.kind.source)
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
                position, weight = light_points.point(mi, self.kind.source, self.parts, sample.x, sample.y)
            towards = position - it.p
            squared = dr.squared_norm(towards)
            ds.p, ds.dist = position, dr.sqrt(squared)
            ds.d = towards / ds.dist
            ds.time, ds.pdf, ds.delta = it.time, mi.Float(1), mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            emitted = self.parts["intensity"] * (weight * factor(mi, self.kind, self.parts, -ds.d))
            return ds, dr.select(active & (squared > 0), emitted / squared, 0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            emitted = self.parts["intensity"] * factor(mi, self.kind, self.parts, -ds.d)
            return dr.select(active, emitted / dr.square(ds.dist), 0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Spectrum(0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"Light[{self.kind}]"

    return Light
