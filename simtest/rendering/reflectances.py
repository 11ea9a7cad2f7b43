"""Reflectances as Mitsuba takes them: descriptions of all, and plugins, for any integrator, of Phong and tissue."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from simtest.rendering import kernel_values
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import MitsubaDict, channel_mean, spectrum
from simtest.spec.reflectance import (
    PhongReflectance,
    PrincipledReflectance,
    Reflectance,
    RoughConductorReflectance,
    RoughPlasticReflectance,
    TissueReflectance,
)

Albedo = Callable[[Any, Any], Any]
"""Albedo of the base, mitsuba.Spectrum, at a surface point, mitsuba.SurfaceInteraction3f, in the lanes of a mask."""


@cache
def lobe_over_base(variant: str) -> Any:
    """Return the class that the plugins of a variant derive from: `mi.BSDF`, the base of all, is the variant's."""

    class LobeOverBase(mi.BSDF):
        """A lobe, component 0, over a diffuse base, component 1, both on the front side.

        A plugin defines `_values(ctx, si, wo, active)`, f cos(theta) and the sampling density of the enabled parts, and
        `_draw(ctx, si, sample2, active)`, a direction of the lobe, the share of samples for it, and the lanes that
        count. `diffuse_reflectance` is the base's albedo.
        """

        def __init__(self, props: Any, albedo: float) -> None:
            super().__init__(props)
            self.base = props.get_texture("diffuse_reflectance", albedo)
            # Called with surface points and a mask in place of the texture, where it is set.
            self.albedo_at: Albedo | None = None
            glossy = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            diffuse = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [glossy, diffuse]
            self.m_flags = glossy | diffuse

        def traverse(self, callback: Any) -> None:
            callback.put("diffuse_reflectance", self.base, mi.ParamFlags.Differentiable)

        def _albedo(self, si: Any, active: Any) -> Any:
            return self.base.eval(si, active) if self.albedo_at is None else self.albedo_at(si, active)

        def _enabled(self, ctx: Any) -> tuple[bool, bool]:
            """Return whether the lobe and the base are asked for."""
            return (
                ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0),
                ctx.is_enabled(mi.BSDFFlags.DiffuseReflection, 1),
            )

        def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
            lobe, share, active = self._draw(ctx, si, sample2, mi.Bool(active))
            chosen = sample1 < share
            bs = mi.BSDFSample3f()
            # Base: cosine-weighted about the normal.
            bs.wo = dr.select(chosen, lobe, mi.warp.square_to_cosine_hemisphere(sample2))
            value, bs.pdf = self._values(ctx, si, bs.wo, active)
            bs.eta = 1.0
            bs.sampled_type = dr.select(
                chosen, mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            )
            bs.sampled_component = dr.select(chosen, mi.UInt32(0), mi.UInt32(1))
            drawn = bs.pdf > 0
            return bs, dr.select(drawn, value / dr.select(drawn, bs.pdf, 1), 0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._values(ctx, si, wo, mi.Bool(active))[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self._values(ctx, si, wo, mi.Bool(active))[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
            return self._values(ctx, si, wo, mi.Bool(active))

        def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
            return self._albedo(si, mi.Bool(active))

    return LobeOverBase


PHONG = "simtest_phong"


@cache
def register_phong(variant: str) -> str:
    """Register the plugin for a variant, whose own class it derives from, once; return its name."""
    mi.register_bsdf(PHONG, lambda props: _make_phong(variant)(props))
    return PHONG


@cache
def _make_phong(variant: str) -> Any:
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
                value += dr.select(ahead, self.specular * scale * dr.exp(self.exponent * log_cosine), 0)
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


TISSUE = "simtest_tissue"

MARGIN = 1 / 40
"""Share of the light through the film that is given up per unit of alpha.

The film's rough surface reflects a little more than the smooth one, of which the light through it is taken: less than
this in any direction for alpha up to 0.1 and an index from 1.33 to 1.40, so that no more is reflected than arrives.
"""

STEEPEST = 10.0
"""Where the Smith function is 1 to the last digit: cot(theta) / alpha."""


@cache
def register_tissue(variant: str) -> str:
    """Register the plugin for a variant, once (see `simtest.rendering.reflectances.register_phong`)."""
    mi.register_bsdf(TISSUE, lambda props: _make_tissue(variant)(props))
    return TISSUE


def external_reflectance(index: Any) -> Any:
    """Compute the share of diffuse light that a smooth surface of an index above 1 reflects, from outside.

    The integral of 2 F(mu) mu over the cosine mu, in closed form [Duntley 1942].
    """
    n, n2 = index, index * index
    n4 = n2 * n2
    return (
        0.5
        + (n - 1) * (3 * n + 1) / (6 * (n + 1) * (n + 1))
        + n2 * (n2 - 1) * (n2 - 1) / ((n2 + 1) * (n2 + 1) * (n2 + 1)) * dr.log((n - 1) / (n + 1))
        - 2 * n2 * n * (n2 + 2 * n - 1) / ((n2 + 1) * (n4 - 1))
        + 8 * n4 * (n4 + 1) / ((n2 + 1) * (n4 - 1) * (n4 - 1)) * dr.log(n)
    )


def facet_density(squared: Any, alpha: Any, ggx: bool) -> Any:
    """Compute the density D of the facets' normals per solid angle, from the squared tangent of their angle.

    Beckmann: exp(-t^2/alpha^2) / (pi alpha^2 cos^4); GGX: 1 / (pi alpha^2 cos^4 (1 + t^2/alpha^2)^2).
    """
    scaled = squared / (alpha * alpha)
    shape = dr.rcp(dr.square(1 + scaled)) if ggx else dr.exp(-scaled)
    return dr.inv_pi * dr.square(1 + squared) / (alpha * alpha) * shape


def visible_over_cosine(direction: Any, alpha: Any, ggx: bool) -> Any:
    """Compute Smith's share of facets that are seen from a direction above the surface, over its cosine.

    G1 = 1/(1 + Lambda) [Walter 2007, exact]; G1/cos stays finite at grazing directions.
    """
    cosine = direction.z
    sine = dr.sqrt(dr.maximum(dr.square(direction.x) + dr.square(direction.y), 1e-20))
    if ggx:
        return 2 / (cosine + dr.sqrt(dr.square(cosine) + dr.square(alpha * sine)))
    a = dr.minimum(cosine / (alpha * sine), STEEPEST)
    # Lambda cos: a in its denominator would be 0 at the horizon.
    hidden = cosine * (dr.erf(a) - 1) / 2 + dr.exp(-a * a) * alpha * sine * (0.5 / math.sqrt(math.pi))
    return dr.rcp(cosine + hidden)


def _lift(bsdf: Any, albedo: Any) -> Any:
    """Compute the base's share of the light within the film that leaves it upwards, times eta^2."""
    return albedo / (1 - albedo * bsdf.returned)


def _film(bsdf: Any, wi: Any, wo: Any) -> tuple[Any, Any]:
    """Compute f cos(theta) and the sampling density of the film's reflection, of directions above it."""
    # Slope and Fresnel's cosine from the sum of both directions: a cosine of the facet's angle would lose the
    # digits that matter next to 1.
    both = wi + wo
    squared = (dr.square(both.x) + dr.square(both.y)) / dr.square(both.z)
    facing = dr.minimum(dr.norm(both) / 2, 1)
    seen, lit = visible_over_cosine(wi, bsdf.alpha, bsdf.ggx), visible_over_cosine(wo, bsdf.alpha, bsdf.ggx)
    density = facet_density(squared, bsdf.alpha, bsdf.ggx) * seen / 4
    # Gradients must not flow through the choice of samples.
    return density * lit * wo.z * mi.fresnel(facing, bsdf.index)[0], dr.detach(density)


def _values(bsdf: Any, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
    """Compute f cos(theta) and the sampling density of the enabled parts."""
    active &= (si.wi.z > 0) & (wo.z > 0)
    # Other lanes compute with a direction of their own, so that no derivative is NaN.
    wi, wo = dr.select(active, si.wi, mi.Vector3f(0, 0, 1)), dr.select(active, wo, mi.Vector3f(0, 0, 1))
    value, density = mi.Spectrum(0), mi.Float(0)
    share = bsdf._share(ctx, si, wi, active)
    glossy, diffuse = bsdf._enabled(ctx)
    if glossy:
        film, drawn = bsdf._film(wi, wo)
        value += film
        density += share * drawn
    if diffuse:
        through = (1 - mi.fresnel(wi.z, bsdf.index)[0]) * (1 - mi.fresnel(wo.z, bsdf.index)[0])
        value += bsdf._lift(bsdf._albedo(si, active)) * (through * bsdf.passage * wo.z * dr.inv_pi)
        density += (1 - share) * dr.inv_pi * wo.z
    return dr.select(active, value, 0), dr.select(active, density, 0)


def _share(bsdf: Any, ctx: Any, si: Any, wi: Any, active: Any) -> Any:
    """Return the share of samples for the film's reflection: its part of what is reflected, about."""
    glossy, diffuse = bsdf._enabled(ctx)
    if not (glossy and diffuse):
        return mi.Float(float(glossy))
    film = mi.fresnel(wi.z, bsdf.index)[0]
    base = (1 - film) * (1 - bsdf.returned) * channel_mean(bsdf._lift(bsdf._albedo(si, active)))
    return dr.detach(film / (film + base))


def _draw(bsdf: Any, ctx: Any, si: Any, sample2: Any, active: Any) -> tuple[Any, Any, Any]:
    active &= si.wi.z > 0
    wi = dr.select(active, si.wi, mi.Vector3f(0, 0, 1))
    # The normals of the facets that are seen from the direction of incidence.
    kind = mi.MicrofacetType.GGX if bsdf.ggx else mi.MicrofacetType.Beckmann
    facet, _ = mi.MicrofacetDistribution(kind, dr.detach(bsdf.alpha)).sample(wi, sample2)
    return mi.reflect(wi, facet), bsdf._share(ctx, si, wi, active), active


@cache
def _make_tissue(variant: str) -> Any:
    class Tissue(lobe_over_base(variant)):  # type: ignore[misc]
        """A film's rough dielectric reflection D G F / (4 cos_i cos_o) over a diffuse base below the film.

        D is Beckmann's or GGX's, G = G1(i) G1(o) Smith's, F Fresnel's for unpolarised light at the facet. What is not
        reflected passes the film, is reflected diffusely, and passes it again or is reflected back from within:
        T(i) T(o) / eta^2 albedo/pi / (1 - albedo r), with T = 1 - F of the smooth film, less a margin (see `MARGIN`),
        and r the share of diffuse light that the film reflects from within. Both parts are reciprocal, and together
        they reflect at most what arrives.

        Parameters: `alpha`, `index` (of the film, above 1), `distribution` ("beckmann" or "ggx") and
        `diffuse_reflectance`, the base's albedo. Components: 0 the film's reflection, 1 the base.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props, 0.5)
            self.alpha = mi.Float(props.get("alpha", 0.03))
            self.index = mi.Float(props.get("index", 1.33))
            distribution = props.get("distribution", "beckmann")
            if distribution not in ("beckmann", "ggx"):
                raise ValueError(f"distribution = {distribution!r}: unknown; allowed: beckmann, ggx")
            self.ggx = distribution == "ggx"
            self.parameters_changed()

        def traverse(self, callback: Any) -> None:
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)
            callback.put("index", self.index, mi.ParamFlags.Differentiable)
            super().traverse(callback)

        def parameters_changed(self, keys: Any = ()) -> None:
            # Literal parameters would be baked into the kernel, and each change would recompile it.
            dr.make_opaque(self.alpha, self.index)
            passed = (1 - external_reflectance(self.index)) / dr.square(self.index)
            # Reflected back from within, and the factor of both passages.
            self.returned, self.passage = 1 - passed, (1 - MARGIN * self.alpha) / dr.square(self.index)
            dr.make_opaque(self.returned, self.passage)

        _lift, _film, _values, _share, _draw = _lift, _film, _values, _share, _draw

        def to_string(self) -> str:
            return f"Tissue[alpha={self.alpha}, index={self.index}, ggx={self.ggx}]"

    return Tissue


def bsdf_dict(reflectance: Reflectance, phong_plugin: str, diffuse_only: bool) -> MitsubaDict:
    """Describe a reflectance to `mi.load_dict`; `phong_plugin` is the registered name of the Phong plugin.

    With `diffuse_only` the specular part is left out: the difference between both radiances is the specular one. Not
    for tissue, whose parts are evaluated one by one.
    """
    specular = 0.0 if diffuse_only else 1.0
    base = {"type": "rgb", "value": [reflectance.diffuse * c for c in reflectance.colour]}
    match reflectance:
        case PhongReflectance():
            return {
                "type": phong_plugin,
                "exponent": reflectance.exponent,
                "specular": specular * reflectance.specular,
                "normalised": reflectance.normalised,
                "diffuse_reflectance": base,
            }
        case RoughPlasticReflectance():
            return {
                "type": "roughplastic",
                "distribution": "ggx",
                "alpha": reflectance.alpha,
                "diffuse_reflectance": base,
                "specular_reflectance": {"type": "uniform", "value": specular},
            }
        case PrincipledReflectance():
            return {
                "type": "principled",
                "base_color": base,
                "roughness": {"type": "uniform", "value": reflectance.roughness},
                "specular": 0.5 * specular,
            }
        # A rough conductor has no base of its own: a matt one is blended in.
        case RoughConductorReflectance():
            return {
                "type": "blendbsdf",
                "weight": reflectance.diffuse,
                "glossy": {
                    "type": "roughconductor",
                    "material": "none",
                    "distribution": "ggx",
                    "alpha": reflectance.alpha,
                    "specular_reflectance": {"type": "uniform", "value": specular},
                },
                "matt": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance.colour)}},
            }
        case TissueReflectance():
            assert not diffuse_only
            return {
                "type": TISSUE,
                "alpha": reflectance.film.alpha,
                "index": reflectance.film.index,
                "distribution": reflectance.film.distribution,
                "diffuse_reflectance": base,
            }


def parts_alone(reflectance: Reflectance) -> bool:
    """Return whether components 0 and 1 of the BSDF are the lobe and the base."""
    return isinstance(reflectance, PhongReflectance | TissueReflectance)


def compiled_form(reflectance: Reflectance) -> tuple[object, ...]:
    """Return what of a reflectance is compiled into the kernels."""
    if isinstance(reflectance, TissueReflectance):
        return type(reflectance), reflectance.film.distribution
    return type(reflectance), getattr(reflectance, "normalised", None)


def parameter_updates(reflectance: Reflectance) -> MitsubaDict:
    """Return the values that change without a rebuild, by Mitsuba's path below the BSDF or its base alone."""
    base = spectrum([reflectance.diffuse * c for c in reflectance.colour])
    match reflectance:
        case PhongReflectance():
            lobe = {"exponent": reflectance.exponent, "specular": reflectance.specular}
            return {**lobe, "diffuse_reflectance.value": base}
        case RoughPlasticReflectance():
            return {"alpha": reflectance.alpha, "diffuse_reflectance.value": base}
        case PrincipledReflectance():
            return {"roughness.value": reflectance.roughness, "base_color.value": base}
        case RoughConductorReflectance():
            matt = {"bsdf_1.reflectance.value": spectrum(list(reflectance.colour))}
            return {"weight.value": reflectance.diffuse, "bsdf_0.alpha.value": reflectance.alpha, **matt}
        case TissueReflectance():
            film = {"alpha": reflectance.film.alpha, "index": reflectance.film.index}
            return {**film, "diffuse_reflectance.value": base}
