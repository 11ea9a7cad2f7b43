"""Surgical instruments in the picture: where they are in the camera frame, their size and their metal."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Millimetres, Share, Spec

DEFAULT_DEPTH_SHARE = 0.8
"""Where a tip is that has neither depth: clear of the tissue, and near it."""

_OF_GRASPERS = ("jaw_mm", "opening_deg", "roll_deg")

PictureShare = Annotated[float, Field(ge=-0.5, le=1.5)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class Instrument(Spec):
    """A metal shaft or grasper, placed in the camera frame.

    The tip is seen at a share of the picture. From there the shaft leaves the picture along `azimuth_deg`, and comes
    towards the camera by `tilt_deg`.
    """

    kind: Literal["shaft", "grasper"] = Field("shaft", description="a round shaft, or one with a wrist and two jaws")
    present: bool = Field(True, description="whether it is in the picture: a dataset draws in how many frames it is")
    diameter_mm: float = Field(5.0, ge=1, le=20, description="of the shaft, mm; usual are 5 and 10")
    tip: tuple[PictureShare, PictureShare] = Field(
        (0.5, 0.5), description="where the tip is seen, shares of the picture's width and height from its upper left"
    )
    depth_mm: Millimetres | None = Field(None, description="distance of the tip along its sightline, mm")
    depth_share: float | None = Field(
        None,
        gt=0,
        le=2,
        description="the same as a share of the surface's distance there, beyond which the surface hides it; default "
        f"{DEFAULT_DEPTH_SHARE:g}",
    )
    azimuth_deg: Angle = Field(
        0.0, description="direction in which the shaft leaves the tip, across the optical axis, deg from x to y"
    )
    tilt_deg: float = Field(20.0, ge=-80, le=80, description="by which the shaft comes towards the camera, deg")
    length_mm: float = Field(300.0, ge=10, le=2000, description="from the tip to the shaft's end, out of the picture")
    jaw_mm: float | None = Field(
        None, gt=0, le=60, description="of a grasper: length of its jaws, mm; default 3 diameters"
    )
    opening_deg: float | None = Field(
        None, ge=0, le=90, description="of a grasper: angle between its jaws, deg; default 30"
    )
    roll_deg: Angle | None = Field(
        None,
        description="of a grasper: turn of the jaws about the shaft, deg; default 0, where they open across the "
        "optical axis",
    )
    alpha: float = Field(0.15, ge=0.02, le=1, description="GGX roughness of the metal")
    metal: tuple[Share, Share, Share] = Field(
        (0.62, 0.59, 0.56), description="reflectance of the metal at normal incidence, linear RGB"
    )
    diffuse: Share = Field(
        0.1, description="share of a matt base that is blended in: scratches, and the tissue that the metal mirrors"
    )
    colour: tuple[Share, Share, Share] = Field((0.6, 0.52, 0.5), description="linear RGB albedo of the matt base")

    @model_validator(mode="after")
    def _one_way(self) -> "Instrument":
        if self.depth_mm is not None and self.depth_share is not None:
            raise ValueError("depth_mm and depth_share exclude each other; give one of them")
        for name in _OF_GRASPERS if self.kind == "shaft" else ():
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: belongs to a grasper; must be left out where kind is shaft")
        if self.length_mm < self.head_mm + 2 * self.diameter_mm:
            raise ValueError(
                f"length_mm = {self.length_mm:g}: must be at least {self.head_mm + 2 * self.diameter_mm:g} with "
                f"diameter_mm = {self.diameter_mm:g}"
            )
        return self

    @property
    def jaw_length_mm(self) -> float:
        """Length of a grasper's jaws, mm; 0 for a shaft."""
        if self.kind == "shaft":
            return 0.0
        return 3 * self.diameter_mm if self.jaw_mm is None else self.jaw_mm

    @property
    def head_mm(self) -> float:
        """Length before the shaft, mm: jaws and wrist."""
        return 0.0 if self.kind == "shaft" else self.jaw_length_mm + 1.2 * self.diameter_mm

    @property
    def back(self) -> Array:
        """Unit vector from the tip along the shaft, shape (3,), camera frame."""
        azimuth, tilt = math.radians(self.azimuth_deg), math.radians(self.tilt_deg)
        across = math.cos(tilt)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), -math.sin(tilt)])

    @property
    def side(self) -> Array:
        """Unit vector across the shaft towards which a grasper's first jaw opens, shape (3,), camera frame."""
        azimuth, roll = math.radians(self.azimuth_deg), math.radians(self.roll_deg or 0.0)
        level = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        return np.asarray(math.cos(roll) * level + math.sin(roll) * np.cross(self.back, level))
