"""How light spreads below the tissue's surface before it leaves again."""

from typing import Annotated

from pydantic import Field

from simtest.spec.spec_model import Spec

Scattering = Annotated[float, Field(ge=0.1, le=100)]
Absorption = Annotated[float, Field(ge=1e-3, le=100)]


class Translucency(Spec):
    """Optical properties that the spread of diffuse light follows, per channel; sources in docs/concepts/tissue.md."""

    scattering_per_mm: tuple[Scattering, Scattering, Scattering] = Field(
        (1.0, 1.1, 1.25), description="reduced scattering coefficient in red, green and blue, 1/mm"
    )
    absorption_per_mm: tuple[Absorption, Absorption, Absorption] = Field(
        (0.056, 0.83, 0.63), description="absorption coefficient in red, green and blue, 1/mm: 3 % of blood"
    )
    index: float = Field(1.37, ge=1, le=1.6, description="refractive index of the tissue, against air")
