"""What reflectances that Mitsuba lacks are made of: a lobe over a base as a plugin, and the terms of microfacets."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from simtest.rendering.backend import dr, mi

STEEPEST = 10.0
"""Where the Smith function is 1 to the last digit: cot(theta) / alpha."""

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
            # The share of the lobe that is left by what lies on the surface, where it is set.
            self.bare_at: Albedo | None = None
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


def reflected(wi: Any, wo: Any, alpha: Any, ggx: bool) -> tuple[Any, Any, Any]:
    """Compute of facets that reflect from one direction to another above the surface what a microfacet lobe takes.

    The density of the directions that they are drawn with, f cos(theta) over Fresnel's term, and Fresnel's cosine.
    """
    # Slope and Fresnel's cosine from the sum of both directions: a cosine of the facet's angle would lose the
    # digits that matter next to 1.
    both = wi + wo
    squared = (dr.square(both.x) + dr.square(both.y)) / dr.square(both.z)
    density = facet_density(squared, alpha, ggx) * visible_over_cosine(wi, alpha, ggx) / 4
    return density, density * visible_over_cosine(wo, alpha, ggx) * wo.z, dr.minimum(dr.norm(both) / 2, 1)


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
