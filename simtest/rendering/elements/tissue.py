"""The reflectance of wet tissue, as a plugin: a film's rough reflection over a diffuse base."""

from functools import cache
from typing import Any

from simtest.rendering.backend import dr, mi
from simtest.rendering.elements.base import lobe_over_base, reflected
from simtest.rendering.kernel_values import channel_mean

MARGIN = 1 / 40
"""Share of the light through the film that is given up per unit of alpha.

The film's rough surface reflects a little more than the smooth one, of which the light through it is taken: less than
this in any direction for alpha up to 0.5 and an index from 1.33 to 1.40, so that no more is reflected than arrives.
"""


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


def _lift(bsdf: Any, albedo: Any) -> Any:
    """Compute the base's share of the light within the film that leaves it upwards, times eta^2."""
    return albedo / (1 - albedo * bsdf.returned)


def _alpha(bsdf: Any, si: Any, active: Any) -> Any:
    """Return the roughness at surface points: the film's, or that of dry ground, as they are wet."""
    return bsdf.alpha if bsdf.wet_at is None else dr.lerp(bsdf.dry_alpha, bsdf.alpha, bsdf.wet_at(si, active))


def _film(bsdf: Any, wi: Any, wo: Any, alpha: Any) -> tuple[Any, Any]:
    """Compute f cos(theta) and the sampling density of the film's reflection, of directions above it."""
    density, lobe, facing = reflected(wi, wo, alpha, bsdf.ggx)
    # Gradients must not flow through the choice of samples.
    return lobe * mi.fresnel(facing, bsdf.index)[0], dr.detach(density)


def _values(bsdf: Any, ctx: Any, si: Any, wo: Any, active: Any) -> tuple[Any, Any]:
    """Compute f cos(theta) and the sampling density of the enabled parts."""
    facing = si.wi.z > 0
    active &= facing & (wo.z > 0)
    # Other lanes compute with a direction of their own, so that no derivative is NaN. That to the camera is the same
    # for all lights, so that its terms are computed once.
    wi, wo = dr.select(facing, si.wi, mi.Vector3f(0, 0, 1)), dr.select(active, wo, mi.Vector3f(0, 0, 1))
    value, density = mi.Spectrum(0), mi.Float(0)
    share = bsdf._share(ctx, si, wi, active)
    glossy, diffuse = bsdf._enabled(ctx)
    if glossy:
        film, drawn = bsdf._film(wi, wo, bsdf._alpha(si, active))
        value += film if bsdf.bare_at is None else film * bsdf.bare_at(si, active)
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
    facet, _ = mi.MicrofacetDistribution(kind, dr.detach(bsdf._alpha(si, active))).sample(wi, sample2)
    return mi.reflect(wi, facet), bsdf._share(ctx, si, wi, active), active


@cache
def make_tissue(variant: str) -> Any:
    """Return the plugin's class of a variant."""

    class Tissue(lobe_over_base(variant)):  # type: ignore[misc]
        """A film's rough dielectric reflection D G F / (4 cos_i cos_o) over a diffuse base below the film.

        D is Beckmann's or GGX's, G = G1(i) G1(o) Smith's, F Fresnel's for unpolarised light at the facet. What is not
        reflected passes the film, is reflected diffusely, and passes it again or is reflected back from within:
        T(i) T(o) / eta^2 albedo/pi / (1 - albedo r), with T = 1 - F of the smooth film, less a margin (see `MARGIN`),
        and r the share of diffuse light that the film reflects from within. Both parts are reciprocal, and together
        they reflect at most what arrives.

        Parameters: `alpha`, `index` (of the film, above 1), `distribution` ("beckmann" or "ggx"),
        `diffuse_reflectance`, the base's albedo, and `dry_alpha`, where `wet_at` is set: the roughness where it returns
        0, at surface points and in the lanes of a mask. Components: 0 the film's reflection, 1 the base.
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props, 0.5)
            self.alpha = mi.Float(props.get("alpha", 0.03))
            self.index = mi.Float(props.get("index", 1.33))
            self.dry_alpha = mi.Float(props["dry_alpha"]) if "dry_alpha" in props else None
            self.wet_at: Any = None
            distribution = props.get("distribution", "beckmann")
            if distribution not in ("beckmann", "ggx"):
                raise ValueError(f"distribution = {distribution!r}: unknown; allowed: beckmann, ggx")
            self.ggx = distribution == "ggx"
            self.parameters_changed()

        def traverse(self, callback: Any) -> None:
            callback.put("alpha", self.alpha, mi.ParamFlags.Differentiable)
            callback.put("index", self.index, mi.ParamFlags.Differentiable)
            if self.dry_alpha is not None:
                callback.put("dry_alpha", self.dry_alpha, mi.ParamFlags.Differentiable)
            super().traverse(callback)

        def parameters_changed(self, keys: Any = ()) -> None:
            # Literal parameters would be baked into the kernel, and each change would recompile it.
            dr.make_opaque(self.alpha, self.index, self.dry_alpha)
            roughest = self.alpha if self.dry_alpha is None else dr.maximum(self.alpha, self.dry_alpha)
            passed = (1 - external_reflectance(self.index)) / dr.square(self.index)
            # Reflected back from within, and the factor of both passages.
            self.returned, self.passage = 1 - passed, (1 - MARGIN * roughest) / dr.square(self.index)
            dr.make_opaque(self.returned, self.passage)

        _lift, _alpha, _film, _values, _share, _draw = _lift, _alpha, _film, _values, _share, _draw

        def to_string(self) -> str:
            return f"Tissue[alpha={self.alpha}, index={self.index}, ggx={self.ggx}]"

    return Tissue
