"""What is known beside the picture: where the lights are, how far the surface is, how wide the lobe is."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError

MAX_LIGHTS = 32


@dataclass(frozen=True)
class Priors:
    """What estimators may be told beside the picture and the camera; each part may be missing.

    Parameters
    ----------
    lights_mm : tuple of tuple of float
        Nominal places of the lights, camera frame, mm; empty: not known.
    distance_mm : float, optional
        Working distance, along the sightline, mm: measured, or the middle of the range that is expected.
    distance_sd_mm : float
        Standard deviation of the true distance about it, mm.
    lobe_curvature : float, optional
        c = -(log f)''(0) of the reflectance f as a function of the angle between normal and view, rad; 4 n for Phong.

    Raises
    ------
    InputError
        If a number is not finite or out of range.
    """

    lights_mm: tuple[tuple[float, float, float], ...] = ()
    distance_mm: float | None = None
    distance_sd_mm: float = 0.0
    lobe_curvature: float | None = None

    def __post_init__(self) -> None:
        if len(self.lights_mm) > MAX_LIGHTS or not all(
            len(place) == 3 and np.isfinite(place).all() for place in self.lights_mm
        ):
            raise InputError(f"lights_mm: must be at most {MAX_LIGHTS} places of three finite numbers, mm")
        for name in ("distance_mm", "lobe_curvature"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} = {value!r}: must be a finite number > 0")
        if not (np.isfinite(self.distance_sd_mm) and self.distance_sd_mm >= 0):
            raise InputError(f"distance_sd_mm = {self.distance_sd_mm!r}: must be a finite number >= 0")
        if self.distance_sd_mm > 0 and self.distance_mm is None:
            raise InputError(f"distance_sd_mm = {self.distance_sd_mm:g}: needs distance_mm")

    @cached_property
    def lights(self) -> npt.NDArray[np.float64]:
        """Nominal places of the lights, shape (L, 3), camera frame, mm."""
        return np.array(self.lights_mm, dtype=float).reshape(-1, 3)


NO_PRIORS = Priors()
"""Nothing is known beside the picture and the camera."""
