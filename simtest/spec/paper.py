"""The published protocol as a kind of scene: a table ``[paper]`` in place of surface, rig and camera."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from simtest.spec.reading import Spec, validate


class Paper(Spec):
    """One setting of the published protocol [MB, section 3.1]; the defaults are the article's."""

    eps: float = Field(0.0, ge=0, le=1e6, description="light offset, texture units")
    size: int = Field(406, ge=16, le=4096, description="M: px and texture samples along a side")
    height: float = Field(1000.0, gt=0, le=1e6, description="V_Z, texture units")
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    sigma: float = Field(0.05, ge=0, le=1, description="standard deviation of the noise, share of the noise-free peak")
    isovalue: float = Field(0.1, gt=0, lt=1, description="t")
    theta_deg: float = Field(58.0, ge=0, lt=90, description="slant, deg")
    smoothing_px: float = Field(2.0, ge=0, le=50, description="standard deviation of the Gaussian smoothing, px")
    recentre: bool = Field(True, description="centre the texture's window at the BP; false: at the camera's foot")


class PaperScene(Spec):
    """A scene of the published protocol."""

    name: str = Field("published", min_length=1, max_length=80)
    paper: Paper = Paper()


def is_paper(data: Mapping[str, Any]) -> bool:
    """Tell whether a scene's tables are those of the published protocol."""
    return "paper" in data


def paper_from_dict(data: Mapping[str, Any], where: str) -> Paper:
    """Validate a scene of the published protocol given as nested tables; raises `InputError`."""
    return validate(PaperScene, data, where).paper
