"""The reflectances of a scene."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from simtest.spec.spec_model import Share, Spec

ROUNDING = 1e-9
"""By how much a sum of shares written in decimals may exceed 1."""


class _Reflectance(Spec):
    diffuse: Share = Field(0.0, description="share of the diffuse base, its albedo")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="linear RGB colour of the diffuse base")


class PhongReflectance(_Reflectance):
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
        # At normal incidence the albedo is the sum, in the colour's strongest channel.
        base = self.diffuse * max(self.colour)
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


class RoughPlasticReflectance(_Reflectance):
    """Mitsuba's rough plastic, GGX."""

    type: Literal["rough_plastic"] = "rough_plastic"
    alpha: float = Field(0.15, gt=0, le=1, description="GGX roughness")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")


class PrincipledReflectance(_Reflectance):
    """Mitsuba's principled material, not metallic."""

    type: Literal["principled"] = "principled"
    roughness: float = Field(0.3, gt=0, le=1, description="roughness (alpha is its square)")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")


class RoughConductorReflectance(_Reflectance):
    """Mitsuba's rough conductor, GGX, blended with a diffuse base by its share."""

    type: Literal["rough_conductor"] = "rough_conductor"
    alpha: float = Field(0.2, gt=0, le=1, description="GGX roughness")


Reflectance = Annotated[
    PhongReflectance | RoughPlasticReflectance | PrincipledReflectance | RoughConductorReflectance,
    Field(discriminator="type"),
]
