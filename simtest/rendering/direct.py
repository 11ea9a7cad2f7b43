"""Direct light in closed form: intensity over squared distance times f cos(theta), of the lobe and of the base."""

from dataclasses import dataclass
from typing import Any

from simtest.rendering import emission
from simtest.runtime.arrays import Array
from simtest.spec.rig import Rig, is_at_camera


@dataclass(frozen=True)
class Material:
    """A surface's reflectance in two parts.

    Parameters
    ----------
    bsdf : mitsuba.BSDF
        The whole.
    base : mitsuba.BSDF or None
        The same without its specular part; None where the whole evaluates its parts separately (components 0 and 1).
    """

    bsdf: Any
    base: Any

    def parts(self, mi: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
        """Compute f cos(theta) of the lobe and of the base."""
        import drjit as dr

        if self.base is None:
            lobe, base = (mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.All, part) for part in (0, 1))
            return self.bsdf.eval(lobe, si, wo, active), self.bsdf.eval(base, si, wo, active)
        # No component is the lobe alone: it is the difference between the whole and the base.
        context = mi.BSDFContext()
        base = self.base.eval(context, si, wo, active)
        return dr.maximum(self.bsdf.eval(context, si, wo, active) - base, 0), base


class DirectLight:
    """The lights of a rig, as a kernel evaluates them.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    rig : Rig
        The lights.
    positions, axes : ndarray, shape (L, 3)
        In the model frame; mm and unit.
    """

    def __init__(self, mi: Any, rig: Rig, positions: Array, axes: Array) -> None:
        import drjit as dr

        self.mi = mi
        self.kinds = [emission.kind_of(light) for light in rig.lights]
        # A light at the camera reaches every point that the camera sees: no shadow rays.
        self.shadows = [not is_at_camera(position) for position in rig.true_mm()]
        self.values = [
            emission.parameters(mi, light, position, axis)
            for light, position, axis in zip(rig.lights, positions, axes, strict=True)
        ]
        # Opaque, so that a moved light compiles no new kernel.
        dr.make_opaque(self.values)

    def radiance(self, scene: Any, material: Material, si: Any) -> tuple[Any, Any]:
        """Compute the radiance off the lobe and the base, mitsuba.Spectrum, at surface points, with shadow rays."""
        import drjit as dr

        mi = self.mi
        specular, diffuse = mi.Spectrum(0), mi.Spectrum(0)
        for kind, values, shadow in zip(self.kinds, self.values, self.shadows, strict=True):
            position = values["position"]
            towards = position - si.p
            squared = dr.squared_norm(towards)
            direction = towards * dr.rsqrt(squared)
            active = si.is_valid() & (squared > 0)
            if shadow:
                # Shadow rays of neighbouring pixels are as coherent as their sightlines.
                active &= ~scene.ray_test(si.spawn_ray_to(position), True, active)
            arriving = values["intensity"] * (emission.factor(mi, kind, values, -direction) / squared)
            lobe, base = material.parts(mi, si, si.to_local(direction), active)
            specular += dr.select(active, arriving * lobe, 0)
            diffuse += dr.select(active, arriving * base, 0)
        return specular, diffuse
