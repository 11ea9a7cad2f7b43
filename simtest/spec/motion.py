"""How the camera moves while its shutter is open."""

from typing import Annotated

import numpy as np
from pydantic import Field

from simtest.geometry.vectors import rotation
from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Spec

Speed = Annotated[float, Field(ge=-1e4, le=1e4)]
AngularSpeed = Annotated[float, Field(ge=-3600, le=3600)]


class Motion(Spec):
    """Camera and rig move evenly during the exposure; the frame is the mean of the radiance over it.

    All truth (labels, highlights, poses) is that of the middle of the exposure. Camera frame of that moment: x right,
    y down, z forward.
    """

    velocity_mm_s: tuple[Speed, Speed, Speed] = Field((0.0, 0.0, 0.0), description="of the camera's centre, mm/s")
    angular_velocity_deg_s: tuple[AngularSpeed, AngularSpeed, AngularSpeed] = Field(
        (0.0, 0.0, 0.0), description="the camera turns about this axis through its centre, right-handed, deg/s"
    )
    exposure_s: float = Field(1 / 60, gt=0, le=10, description="how long the shutter is open, s; 1/60 is a video field")
    steps: int = Field(
        16,
        ge=2,
        le=1024,
        description="moments at which the radiance is taken; they share the pixel's samples, at least one each. The "
        "picture should move by little more than a pixel from one to the next",
    )

    @property
    def moves(self) -> bool:
        """Whether any velocity differs from 0."""
        return any((*self.velocity_mm_s, *self.angular_velocity_deg_s))

    @property
    def times_s(self) -> Array:
        """The moments, shape (steps,), s from the middle of the exposure: the middles of equal parts of it."""
        return np.asarray(((np.arange(self.steps) + 0.5) / self.steps - 0.5) * self.exposure_s)

    def poses(self) -> Array:
        """Return the camera's poses, shape (steps, 4, 4), at `times_s`: middle_from_moment, mm.

        The centre moves along a straight line, and the camera turns about a fixed axis.
        """
        poses = np.tile(np.eye(4), (self.steps, 1, 1))
        poses[:, :3, 3] = self.times_s[:, None] * np.array(self.velocity_mm_s)
        turn = np.radians(self.angular_velocity_deg_s)
        poses[:, :3, :3] = [rotation(time * turn) for time in self.times_s]
        return poses
