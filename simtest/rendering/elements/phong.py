"""Phong's reflectance, which Mitsuba lacks, as a plugin."""

from functools import cache
from typing import Any

from simtest.rendering import kernel_values
from simtest.rendering.backend import dr, mi
from simtest.rendering.elements.base import lobe_over_base


@cache
def make_phong(variant: str) -> Any:
    """Return the plugin's class of a variant."""

    class Phong(lobe_over_base(variant)):  # type: ignore[misc]
        """Specular c cos^n(beta) plus a Lambertian base, beta between mirror direction and view [P75].

        As published, the specular radiance has no cosine of incidence: f cos(theta) = c cos^n(beta). The radiance stays
        the same when light and camera swap positions; f itself is not reciprocal and grows without bound at grazing
        light. The normalised form is f = c (n + 2)/(2 pi) cos^n(beta): reciprocal, of albedo c at normal incidence and
        less elsewhere, so it conserves energy where c plus the base's albedo are at most 1.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props, 0.0)
            self.exponent = mi.Float(props.get("exponent", 50.0))
            self.specular = mi.Float(props.get("specular", 1.0))
            self.normalised = bool(props.get("normalised", False))
            self.parameters_changed()

        def traverse(self, callback: Any) -> None:
            callback.put("exponent", self.exponent, mi.ParamFlags.Differentiable)
            callback.put("specular", self.specular, mi.ParamFlags.Differentiable)
            super().traverse(callback)

        def parameters_changed(self, keys: Any = ()) -> None:
            # Literal parameters would be baked into the kernel, and each change would recompile it.
            dr.make_opaque(self.exponent, self.specular)

        def _values(self, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """Compute f cos(theta) and the sampling density of the enabled lobes."""
            cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active &= (cos_i > 0) & (cos_o > 0)
            value, density = mi.Spectrum(0), mi.Float(0)
            share = self._share(ctx, si, active)
            glossy, diffuse = self._enabled(ctx)
            if glossy:
                # beta is the angle to the mirror direction.
                log_cosine, ahead = kernel_values.log_cosine(wo, mi.reflect(si.wi))
                scale = (self.exponent + 2) * dr.inv_two_pi * cos_o if self.normalised else mi.Float(1)
                lobe = self.specular * scale * dr.exp(self.exponent * log_cosine)
                lobe = lobe if self.bare_at is None else lobe * self.bare_at(si, active)
                value += dr.select(ahead, lobe, 0)
                # Gradients must not flow through the choice of samples.
                n = dr.detach(self.exponent)
                density += dr.select(ahead, share * (n + 1) * dr.inv_two_pi * dr.exp(n * log_cosine), 0)
            if diffuse:
                value += self._albedo(si, active) * dr.inv_pi * cos_o
                density += (1 - share) * dr.inv_pi * cos_o
            return dr.select(active, value, 0), dr.select(active, density, 0)

        def _share(self, ctx: Any, si: Any, active: Any) -> Any:
            """Return the share of samples for the lobe: its part of the albedo at normal incidence.

            In the published form all samples above the surface then have the same weight.
            """
            glossy, diffuse = self._enabled(ctx)
            if not (glossy and diffuse):
                return mi.Float(float(glossy))
            lobe = self.specular if self.normalised else self.specular * dr.two_pi / (self.exponent + 1)
            base = kernel_values.channel_mean(self._albedo(si, active))
            whole = lobe + base
            return dr.detach(dr.select(whole > 0, lobe / dr.select(whole > 0, whole, 1), 0.5))

        def _draw(self, ctx: Any, si: Any, sample2: Any, active: Any) -> tuple[Any, Any, Any]:
            # cos(beta) = u^(1/(n+1)) about the mirror direction, its sine without cancellation; u in (0, 1].
            slope = -dr.log(1 - sample2.x) / (dr.detach(self.exponent) + 1)
            cosine, sine = dr.exp(-slope), dr.sqrt(2 * dr.exp(-slope) * dr.sinh(slope))
            s, c = dr.sincos(dr.two_pi * sample2.y)
            lobe = mi.Frame3f(mi.reflect(si.wi)).to_world(mi.Vector3f(sine * c, sine * s, cosine))
            return lobe, self._share(ctx, si, active), active

        def to_string(self) -> str:
            return f"Phong[exponent={self.exponent}, specular={self.specular}, normalised={self.normalised}]"

    return Phong
