"""The reflectances of a scene."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from simtest.spec.spec_model import Share, Spec
from simtest.spec.tissue_colour import TissueColour
from simtest.spec.translucency import Translucency

ROUNDING = 1e-9
"""By how much a sum of shares written in decimals may exceed 1."""


def ggx_half_width(alpha: float) -> float:
    """Return the half-angle, rad, at which GGX's density of facets falls to half: tan^2 = alpha^2 (sqrt(2) - 1)."""
    return math.atan(alpha * math.sqrt(math.sqrt(2) - 1))


class _Reflectance(Spec):
    diffuse: Share = Field(0.0, description="share of the diffuse base, its albedo")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="linear RGB colour of the diffuse base")


class _Painted(_Reflectance):
    """A reflectance whose base may have the colour of tissue."""

    albedo: TissueColour | None = Field(
        None, description="mottling and vessels: the base's albedo in place of diffuse and colour"
    )

    @model_validator(mode="after")
    def _one_albedo(self) -> "_Painted":
        # A dump names the defaults too.
        fields = type(self).model_fields
        given = [name for name in ("colour", "diffuse") if getattr(self, name) != fields[name].default]
        if self.albedo is not None and given:
            raise ValueError(f"{given[0]} and albedo exclude each other; leave out {given[0]} or albedo")
        return self


class PhongReflectance(_Painted):
    """Phong: specular c cos^n(beta) as published, or the energy-conserving form."""

    type: Literal["phong"] = "phong"
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    specular: float = Field(1.0, ge=0, le=1e6, description="scale c of the specular lobe")
    normalised: bool = Field(
        False,
        description="energy-conserving form: (n + 2)/(2 pi) cos^n(beta) cos(theta); specular + diffuse at most 1",
    )

    @model_validator(mode="after")
    def _conserves_energy(self) -> "PhongReflectance":
        # At normal incidence the albedo is the sum, in the colour's strongest channel; mottling reaches up to 1.
        base = self.diffuse * max(self.colour) if self.albedo is None else 1.0
        if self.normalised and self.specular + base > 1 + ROUNDING:
            raise ValueError(
                f"specular = {self.specular:g} and a diffuse base of {base:g} reflect more light than arrives; "
                "their sum must be at most 1 when normalised is true"
            )
        return self

    @property
    def lobe_curvature(self) -> float:
        """Curvature -(log f)''(0) of the lobe: 4 n as published, one more with the cosine of the normalised form."""
        return 4 * self.exponent + (1.0 if self.normalised else 0.0)

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad, light and camera together."""
        return math.acos(2 ** (-1 / self.exponent)) / 2


class RoughPlasticReflectance(_Reflectance):
    """Mitsuba's rough plastic, GGX."""

    type: Literal["rough_plastic"] = "rough_plastic"
    alpha: float = Field(0.15, gt=0, le=1, description="GGX roughness")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.alpha)


class PrincipledReflectance(_Reflectance):
    """Mitsuba's principled material, not metallic."""

    type: Literal["principled"] = "principled"
    roughness: float = Field(0.3, gt=0, le=1, description="roughness (alpha is its square)")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.roughness**2)


class RoughConductorReflectance(_Reflectance):
    """Mitsuba's rough conductor, GGX, blended with a diffuse base by its share."""

    type: Literal["rough_conductor"] = "rough_conductor"
    alpha: float = Field(0.2, gt=0, le=1, description="GGX roughness")

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad (`ggx_half_width`)."""
        return ggx_half_width(self.alpha)


class Film(Spec):
    """A liquid film over the tissue: a rough dielectric surface."""

    index: float = Field(ge=1.33, le=1.40, description="refractive index; water 1.33, mucus up to about 1.40")
    alpha: float = Field(0.03, ge=0.01, le=0.1, description="roughness; alpha^2/2 is the variance of Beckmann's slopes")
    distribution: Literal["beckmann", "ggx"] = Field("beckmann", description="of the slopes of the film's surface")
    level: float | None = Field(
        None,
        ge=-3,
        le=3,
        description="height up to which the film fills the valleys of surface.relief, in standard deviations of the "
        "relief's height about its mean; default: the film follows the relief",
    )


class TissueReflectance(_Painted):
    """Wet tissue: the film's reflection, and a diffuse base whose light passes the film twice."""

    type: Literal["tissue"] = "tissue"
    film: Film
    diffuse: Share = Field(0.5, description="albedo of the diffuse base below the film")
    translucency: Translucency | None = Field(
        None, description="how the diffuse light spreads below the surface; default: it leaves where it entered"
    )

    @property
    def lobe_curvature(self) -> float | None:
        """Curvature -(log f)''(0) of the lobe with the light at the camera; None for GGX, whose tails it misses.

        Beckmann: f cos(theta) is proportional to exp(-tan^2(theta)/alpha^2) / cos^5(theta), so 2/alpha^2 - 5. Smith's
        function is 1 next to the normal, and the facets that reflect back are met straight on.
        """
        return 2 / self.film.alpha**2 - 5 if self.film.distribution == "beckmann" else None

    @property
    def half_width(self) -> float:
        """Half-angle at which the lobe falls to half, rad: Beckmann's exp(-tan^2/alpha^2), or `ggx_half_width`."""
        alpha = self.film.alpha
        return (
            math.atan(alpha * math.sqrt(math.log(2))) if self.film.distribution == "beckmann" else ggx_half_width(alpha)
        )


Reflectance = Annotated[
    PhongReflectance | RoughPlasticReflectance | PrincipledReflectance | RoughConductorReflectance | TissueReflectance,
    Field(discriminator="type"),
]
