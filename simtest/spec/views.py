"""Where the camera stands, and the further views from which experiments look at the same surface."""

from typing import Annotated

import numpy as np
from pydantic import Field

from simtest.geometry.vectors import rotation
from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Spec

Length = Annotated[float, Field(ge=-1e3, le=1e3)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class Moved(Spec):
    """Camera and rig stand elsewhere than where the surface's own keys put them; in the camera frame of that place."""

    translation_mm: tuple[Length, Length, Length] = Field((0.0, 0.0, 0.0), description="of the camera's centre, mm")
    rotation_deg: tuple[Angle, Angle, Angle] = Field(
        (0.0, 0.0, 0.0), description="the camera is turned about this axis through its centre, right-handed, deg"
    )

    def pose(self) -> Array:
        """Return unmoved_from_moved, shape (4, 4), mm."""
        pose = np.eye(4)
        pose[:3, :3] = rotation(np.radians(self.rotation_deg))
        pose[:3, 3] = self.translation_mm
        return pose


class Views(Spec):
    """Further views of the same surface, from a camera moved with its lights: for an experiment on motion.

    The first view is that of the scene. Each further one is moved by `length_mm` across the optical axis.
    """

    count: int = Field(2, ge=2, le=16, description="number of views, the scene's own included")
    length_mm: float = Field(1.0, ge=0, le=100, description="of the motion from the first view to each other one, mm")
    direction_deg: Angle = Field(0.0, description="image direction of the first motion, deg from x to y")
    turn_deg: Angle = Field(90.0, description="by how much the direction of each next motion is turned on, deg")
    translation_error: float = Field(
        0.0,
        ge=0,
        le=1,
        description="standard deviation of the told translation along each axis, share of length_mm",
    )
    rotation_error_deg: float = Field(
        0.0, ge=0, le=45, description="standard deviation of the told rotation about each axis, deg"
    )
    errors_told: bool = Field(True, description="whether the method is told these standard deviations, rather than 0")

    def moved(self) -> list[Moved]:
        """Return where the camera of each further view stands, from the first one."""
        angles = np.radians(self.direction_deg + self.turn_deg * np.arange(self.count - 1))
        return [
            Moved(translation_mm=(float(self.length_mm * np.cos(a)), float(self.length_mm * np.sin(a)), 0.0))
            for a in angles
        ]
