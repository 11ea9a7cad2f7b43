"""Factors over the angle from an axis, as scene and calibration files hold them."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from simtest.calibration.angular_profile import AngularProfile
from simtest.spec.spec_model import Spec


class CosineProfile(Spec):
    """cos^power of the angle from the axis; 0 at 90 deg and beyond."""

    type: Literal["cosine"] = "cosine"
    power: float = Field(0.0, ge=0, le=1000, description="k of cos^k; 0 is uniform in all directions")

    def model(self) -> AngularProfile:
        """Return the profile as the geometry package uses it."""
        return AngularProfile(self.power)


class TableProfile(Spec):
    """A table, linear between its angles; its last value holds beyond the last angle."""

    type: Literal["table"] = "table"
    angle_deg: tuple[Annotated[float, Field(ge=0, le=180)], ...] = Field(
        min_length=2, max_length=4096, description="angles from the axis, deg, rising from 0"
    )
    value: tuple[Annotated[float, Field(ge=0, le=1e6)], ...] = Field(
        min_length=2, max_length=4096, description="factor at each angle; positive on the axis"
    )

    @model_validator(mode="after")
    def _table(self) -> "TableProfile":
        if len(self.value) != len(self.angle_deg):
            raise ValueError(f"value has {len(self.value)} entries, angle_deg {len(self.angle_deg)}; must be as many")
        # Interpolation needs a value on the axis, to which all others are relative.
        if self.angle_deg[0] != 0 or not (np.diff(self.angle_deg) > 0).all():
            raise ValueError(f"angle_deg = {list(self.angle_deg)}: must rise from 0")
        if self.value[0] <= 0:
            raise ValueError(f"value = {list(self.value)}: must be positive on the axis")
        return self

    def model(self) -> AngularProfile:
        """Return the profile as the geometry package uses it."""
        return AngularProfile(angles=tuple(np.radians(self.angle_deg).tolist()), values=self.value)


Profile = Annotated[CosineProfile | TableProfile, Field(discriminator="type")]
