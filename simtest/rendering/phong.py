"""The Phong reflectance as a Mitsuba plugin, usable by any Mitsuba integrator."""

from functools import cache
from typing import Any

PLUGIN = "simtest_phong"


@cache
def register(mi: Any, variant: str) -> str:
    """Register the plugin for a variant, once.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    variant : str
        Its name; the class is made anew for each, since its base is the variant's own.

    Returns
    -------
    str
        The plugin's name for `mi.load_dict`.
    """
    mi.register_bsdf(PLUGIN, lambda props: _make_class(mi, variant)(props))
    return PLUGIN


@cache
def _make_class(mi: Any, variant: str) -> Any:  # noqa: C901 - a class whose base is known at run time only
    import drjit as dr

    class Phong(mi.BSDF):
        """Specular c cos^n(beta) plus a Lambertian base, beta between mirror direction and view [P75].

        As published, the specular radiance has no cosine of incidence: f cos(theta) = c cos^n(beta). The normalised
        form is f = c (n + 2)/(2 pi) cos^n(beta), which conserves energy for c <= 1 and is reciprocal.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.exponent = mi.Float(props.get("exponent", 50.0))
            self.specular = mi.Float(props.get("specular", 1.0))
            self.normalised = bool(props.get("normalised", False))
            self.base = props.get_texture("diffuse_reflectance", 0.0)
            glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [glossy, diffuse]
            self.m_flags = glossy | diffuse
            self.parameters_changed()

        def traverse(self, callback: Any) -> None:
            callback.put("exponent", self.exponent, mi.ParamFlags.Differentiable)
            callback.put("specular", self.specular, mi.ParamFlags.Differentiable)
            callback.put("diffuse_reflectance", self.base, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys: Any = ()) -> None:
            # Literal parameters would be baked into the kernel and recompile it at each change.
            dr.make_opaque(self.exponent, self.specular)

        def _lobe(self, wi: Any, wo: Any) -> tuple[Any, Any]:
            """Give cos(beta), clipped at 0, and its power n."""
            cosine = dr.maximum(dr.dot(mi.reflect(wi), wo), 0)
            return cosine, cosine**self.exponent

        def _values(self, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
            """Give f cos(theta) and the sampling density of the enabled lobes."""
            cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            active &= (cos_i > 0) & (cos_o > 0)
            value, density = mi.Spectrum(0), mi.Float(0)
            share = self._share(ctx)
            if ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                _, power = self._lobe(si.wi, wo)
                scale = (self.exponent + 2) * dr.inv_two_pi * cos_o if self.normalised else mi.Float(1)
                value += self.specular * scale * power
                density += share * (self.exponent + 1) * dr.inv_two_pi * power
            if ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1):
                value += self.base.eval(si, active) * dr.inv_pi * cos_o
                density += (1 - share) * dr.inv_pi * cos_o
            return dr.select(active, value, 0), dr.select(active, density, 0)

        def _share(self, ctx: Any) -> float:
            """Share of the samples that go to the specular lobe."""
            glossy = ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0)
            diffuse = ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1)
            return 0.5 if glossy and diffuse else float(glossy)

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            share = self._share(ctx)
            # cos(beta) = u^(1/(n+1)) about the mirror direction; cosine-weighted about the normal.
            cosine = sample2.x ** (1 / (self.exponent + 1))
            sine, angle = dr.safe_sqrt(1 - cosine**2), dr.two_pi * sample2.y
            s, c = dr.sincos(angle)
            glossy = mi.Frame3f(mi.reflect(si.wi)).to_world(mi.Vector3f(sine * c, sine * s, cosine))
            chosen = sample1 < share
            bs = mi.BSDFSample3f()
            bs.wo = dr.select(chosen, glossy, mi.warp.square_to_cosine_hemisphere(sample2))
            value, bs.pdf = self._values(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_type = dr.select(
                chosen, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            bs.sampled_component = dr.select(chosen, mi.UInt32(0), mi.UInt32(1))
            return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._values(ctx, si, wo, mi.Bool(active))[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._values(ctx, si, wo, mi.Bool(active))[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self._values(ctx, si, wo, mi.Bool(active))

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self.base.eval(si, active)

        def to_string(self) -> str:
            return f"Phong[exponent={self.exponent}, specular={self.specular}]"

    return Phong
