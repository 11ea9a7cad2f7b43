"""A factor over the angle from an axis: a light's emission, a lens's vignetting."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry.checks import check_number, check_numbers
from simtest.runtime.arrays import Array


@dataclass(frozen=True)
class AngularProfile:
    """A factor over the angle from an axis: cos^k, which is 1 on the axis, or a table in any unit.

    Parameters
    ----------
    power : float
        k of cos^k; used where there is no table. 0 is isotropic.
    angles : tuple of float
        Angles of a table, rad, rising from 0 to at most pi; empty for cos^k.
    values : tuple of float
        Factors at those angles, >= 0; interpolated linearly, constant beyond the table.
    """

    power: float = 0.0
    angles: tuple[float, ...] = ()
    values: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_number("profile power", self.power, least=0)
        for name in ("angles", "values"):
            check_numbers(f"profile {name}", getattr(self, name))
        if len(self.angles) != len(self.values):
            raise InputError(f"profile: {len(self.angles)} angles and {len(self.values)} values; must be as many")
        if not self.angles:
            return
        angles, values = np.array(self.angles), np.array(self.values)
        if len(angles) < 2 or angles[0] != 0 or not (np.diff(angles) > 0).all() or angles[-1] > np.pi + 1e-12:
            raise InputError(f"profile angles = {list(self.angles)}: must rise from 0 to at most pi, two or more")
        if not ((values >= 0).all() and values[0] > 0):
            raise InputError(f"profile values = {list(self.values)}: must be >= 0 and positive on the axis")

    @property
    def is_uniform(self) -> bool:
        """Whether the factor is 1 in all directions."""
        return self.power == 0 and not self.angles

    def at(self, cosine: npt.ArrayLike, sine: npt.ArrayLike | None = None) -> Array:
        """Return the factor at an angle from the axis, named by its cosine, any shape.

        With the sine >= 0 of the same angle a table keeps the digits that the cosine has lost near the axis. cos^k is 0
        at angles of 90 deg and more, unless k is 0.
        """
        c = np.clip(np.asarray(cosine, dtype=float), -1.0, 1.0)
        if self.angles:
            angle = np.arccos(c) if sine is None else np.arctan2(sine, c)
            return np.asarray(np.interp(angle, self.angles, self.values))
        return np.ones_like(c) if self.power == 0 else np.asarray(np.maximum(c, 0.0) ** self.power)
