"""The relief of a surface: fine height over the smooth base, in bands of wavelength."""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from simtest.spec.spec_model import Spec

MAX_HEIGHT_MM = 0.3
"""Tissue's relief stays below this; higher forms are shape, not relief."""

MAX_DEVIATIONS = 3.0
"""Standard deviations of a gaussian height that are taken as its peak: 99.7 % of the surface stay within."""

PEAK_PER_SLOPE = {"ridged": 1.33, "pits": 2.4}
"""What 99.7 % of the heights stay within, over slope (rad) and wavelength: measured, much the same for all widths."""

Component = Annotated[float, Field(ge=-1e3, le=1e3)]


class ReliefBand(Spec):
    """One band of wavelengths of the relief, a random field in the space around the surface."""

    kind: Literal["gaussian", "ridged", "pits"] = Field(
        "gaussian", description="gaussian; ridged: crests and grooves; pits: a level surface with dimples"
    )
    slope_deg: float = Field(
        gt=0, le=20, description="standard deviation of the slope along one direction (across `direction`), deg"
    )
    wavelength_mm: float = Field(
        ge=0.02, le=20, description="2 pi sqrt(m2/m4) of the spectrum's moments on the surface, across `direction`, mm"
    )
    width: float = Field(0.25, ge=0.05, le=0.5, description="relative width of the band of wave numbers")
    anisotropy: float = Field(1.0, ge=1, le=5, description="wavelength along `direction` over that across it")
    direction: tuple[Component, Component, Component] = Field(
        (1.0, 0.0, 0.0), description="along which the relief is drawn out, model frame, any length"
    )

    @model_validator(mode="after")
    def _usable(self) -> "ReliefBand":
        if not any(self.direction):
            raise ValueError(f"direction = {list(self.direction)}: must have a length")
        return self


class Relief(Spec):
    """The relief of a surface: the sum of its bands, applied to the normal and not to the position."""

    bands: tuple[ReliefBand, ...] = Field(min_length=1, max_length=4)
    seed: int = Field(0, ge=0, lt=2**32, description="of the random field")
    diffusion_mm: float = Field(
        1.0,
        ge=0,
        le=10,
        description="diffuse light follows the normal of the relief smoothed by a Gaussian of this standard "
        "deviation, mm: it has travelled below the surface",
    )

    @property
    def slope_deg(self) -> float:
        """Standard deviation of the slope of all bands along one direction, deg; bands are independent."""
        return math.hypot(*(band.slope_deg for band in self.bands))

    @model_validator(mode="after")
    def _low(self) -> "Relief":
        # Bands are independent: their variances add.
        height = math.hypot(*(_peak(band) for band in self.bands))
        if height > MAX_HEIGHT_MM:
            raise ValueError(
                f"slopes and wavelengths make a relief of about {height:.2g} mm (99.7 % of its heights stay within); "
                f"must stay below {MAX_HEIGHT_MM:g} mm: lower slope_deg or wavelength_mm"
            )
        return self


def _peak(band: ReliefBand) -> float:
    """Return about what 99.7 % of a band's heights stay within, mm.

    The wave numbers of a gaussian band spread about k0 with the standard deviation w k0. On a section of the isotropic
    field m0 = 1, m2 = 2/3 E k^2 and m4 = 8/15 E k^4, so the height's deviation over slope and wavelength is
    sqrt(m0) / (sqrt(m2/2) 2 pi sqrt(m2/m4)) = sqrt(2.4 E k^4) / (2 pi E k^2).
    """
    w2 = band.width**2
    deviation = math.sqrt(2.4 * (1 + 6 * w2 + 3 * w2**2)) / (2 * math.pi * (1 + w2))
    per_slope = PEAK_PER_SLOPE.get(band.kind, MAX_DEVIATIONS * deviation)
    return per_slope * math.radians(band.slope_deg) * band.wavelength_mm
