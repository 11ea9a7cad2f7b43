"""Direct light in closed form: intensity over squared distance times f cos(theta), by lobe and by base."""

from dataclasses import dataclass
from typing import Any

from simtest.rendering import emission
from simtest.rendering.frames import Array
from simtest.spec.rig import Rig, is_at_camera


@dataclass(frozen=True)
class Material:
    """A surface's reflectance in two parts.

    Parameters
    ----------
    bsdf : mitsuba.BSDF
        The whole.
    base : mitsuba.BSDF or None
        The same without its specular part; None where the whole evaluates its parts alone (components 0 and 1).
    """

    bsdf: Any
    base: Any

    def parts(self, mi: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
        """Give f cos(theta) of the lobe and of the base."""
        import drjit as dr

        if self.base is None:
            lobe, base = (mi.BSDFContext(mi.TransportMode.Radiance, +mi.BSDFFlags.All, part) for part in (0, 1))
            return self.bsdf.eval(lobe, si, wo, active), self.bsdf.eval(base, si, wo, active)
        context = mi.BSDFContext()
        base = self.base.eval(context, si, wo, active)
        return dr.maximum(self.bsdf.eval(context, si, wo, active) - base, 0), base


class DirectLight:
    """The lights of a rig, as a kernel sees them.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    rig : Rig
        The lights.
    places, axes : ndarray, shape (L, 3)
        In the model frame; mm and unit.
    """

    def __init__(self, mi: Any, rig: Rig, places: Array, axes: Array) -> None:
        import drjit as dr

        self.mi = mi
        self.kinds = [emission.kind_of(light) for light in rig.lights]
        # A light at the camera sees what the camera sees.
        self.shadows = [not is_at_camera(place) for place in rig.true_mm()]
        self.values = [
            emission.parameters(mi, light, place, axis)
            for light, place, axis in zip(rig.lights, places, axes, strict=True)
        ]
        # Opaque, so that a moved light compiles no new kernel.
        dr.make_opaque(self.values)

    def radiance(self, scene: Any, material: Material, si: Any) -> tuple[Any, Any]:
        """Give the radiance off the lobe and off the base at surface points.

        Parameters
        ----------
        scene : mitsuba.Scene
            For the shadow rays.
        material : Material
            The surface's.
        si : mitsuba.SurfaceInteraction3f
            The points.

        Returns
        -------
        specular, diffuse : mitsuba.Spectrum
        """
        import drjit as dr

        mi = self.mi
        specular, diffuse = mi.Spectrum(0), mi.Spectrum(0)
        for kind, values, shadow in zip(self.kinds, self.values, self.shadows, strict=True):
            place = values["position"]
            towards = place - si.p
            squared = dr.squared_norm(towards)
            direction = towards * dr.rsqrt(squared)
            active = si.is_valid() & (squared > 0)
            if shadow:
                # Neighbouring pixels' shadow rays are as coherent as their sightlines.
                active &= ~scene.ray_test(si.spawn_ray_to(place), True, active)
            arriving = values["intensity"] * (emission.factor(mi, kind, values, -direction) / squared)
            lobe, base = material.parts(mi, si, si.to_local(direction), active)
            specular += dr.select(active, arriving * lobe, 0)
            diffuse += dr.select(active, arriving * base, 0)
        return specular, diffuse
