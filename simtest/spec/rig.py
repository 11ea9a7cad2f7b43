"""The lights that travel with the camera."""

import math

from pydantic import Field, model_validator

from simtest.spec.quantities import Coordinate
from simtest.spec.reading import Spec


class LightSpec(Spec):
    """An isotropic point light, placed in the camera frame.

    Its place is `position_mm`, or `offset_mm` from the camera centre along `azimuth_deg` in the plane z = 0.
    """

    position_mm: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="place in the camera frame, mm"
    )
    offset_mm: float = Field(0.0, ge=0, le=1e6, description="distance from the camera centre, mm")
    azimuth_deg: float = Field(0.0, ge=-360, le=360, description="direction of the offset, deg from x to y")
    power: float = Field(1.0, gt=0, le=1e12, description="radiant intensity, relative")

    @model_validator(mode="after")
    def _one_way(self) -> "LightSpec":
        if self.position_mm is not None and self.model_fields_set & {"offset_mm", "azimuth_deg"}:
            raise ValueError("position_mm and offset_mm exclude each other; give one of them")
        return self

    @property
    def place_mm(self) -> tuple[float, float, float]:
        """Position in the camera frame, mm."""
        if self.position_mm is not None:
            return self.position_mm
        angle = math.radians(self.azimuth_deg)
        return (self.offset_mm * math.cos(angle), self.offset_mm * math.sin(angle), 0.0)


class Rig(Spec):
    """The lights that travel with the camera."""

    lights: tuple[LightSpec, ...] = Field((LightSpec(),), min_length=1, max_length=32)
