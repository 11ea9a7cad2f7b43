"""The published protocol as a kind of scene: a table ``[paper]`` in place of surface, rig and camera."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from simtest.conventions import PAPER_SMOOTHING_PX
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Spec, validate


class PaperSetting(Spec):
    """One setting of the published protocol [MB, section 3.1]; the defaults are the article's."""

    eps: float = Field(0.0, ge=0, le=1e6, description="light offset, texture units: L = V + eps (cos a, sin a, b)")
    size: int = Field(406, ge=16, le=4096, description="M: px and texture samples along a side")
    height: float = Field(1000.0, gt=0, le=1e6, description="V_Z, texture units")
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    sigma: float = Field(0.05, ge=0, le=1, description="standard deviation of the noise, share of the noise-free peak")
    isovalue: float = Field(0.1, gt=0, lt=1, description="t")
    theta_deg: float = Field(58.0, ge=0, lt=90, description="slant, deg")
    smoothing_px: float = Field(
        PAPER_SMOOTHING_PX, ge=0, le=50, description="standard deviation of the Gaussian smoothing, px"
    )
    recentre: bool = Field(True, description="centre the texture's window at the BP; false: at the camera's foot")

    @model_validator(mode="after")
    def _light_in_front(self) -> "PaperSetting":
        # Lights lie at V + eps (cos a, sin a, b) with b down to -1/2.
        if self.eps >= 2 * self.height:
            raise ValueError(
                f"eps = {self.eps:g} and height = {self.height:g}: the lowest light, at height - eps / 2, would lie "
                "behind the plane; eps must be less than 2 height"
            )
        return self

    @property
    def camera(self) -> Camera:
        """The imaging camera: f = M, c = M/2."""
        size = self.size
        return Camera(size, size, float(size), float(size), size / 2, size / 2)

    @property
    def normal(self) -> Array:
        """The plane's normal in the imaging camera's frame, facing it, unit, shape (3,)."""
        theta = np.radians(self.theta_deg)
        return np.array([0.0, np.sin(theta), -np.cos(theta)])


class PaperScene(Spec):
    """A scene of the published protocol."""

    name: str = Field("published", min_length=1, max_length=80)
    paper: PaperSetting = PaperSetting()


def is_paper(data: Mapping[str, Any]) -> bool:
    """Return whether a scene's tables are those of the published protocol."""
    return "paper" in data


def paper_from_dict(data: Mapping[str, Any], where: str) -> PaperSetting:
    """Validate a scene of the published protocol given as nested tables; raise `InputError` if it is malformed."""
    return validate(PaperScene, data, where).paper
