"""How a surface deforms in time: peristalsis, contractions along a curved path, breathing, the dent of a probe."""

import math
from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from simtest.spec.spec_model import Coordinate, Spec

MOST_DEFORMATIONS = 4

SHORTEST = 1e-6
"""Least length of a direction that is given."""

MAX_STRETCH = 0.9
"""Lipschitz bound that a displacement must stay below.

A map X -> X + u(X) is invertible where u has a Lipschitz constant below 1. The rest keeps its inverse well-conditioned.
"""

Component = Annotated[float, Field(ge=-1e3, le=1e3)]
Direction = tuple[Component, Component, Component]
Point = tuple[Coordinate, Coordinate, Coordinate]
Size = Annotated[float, Field(ge=0.1, le=1e4)]
Amplitude = Annotated[float, Field(ge=-100, le=100)]


MOST_POINTS = 500
"""Of a path."""

NEAREST_MM = 0.01
"""Least distance of neighbouring points of a path."""

MOST_RINGS = 20
"""Contractions on a path at one time: each is a map of its own."""


class _Periodic(Spec):
    """A displacement that repeats; points and directions are in the model frame."""

    amplitude_mm: Amplitude = Field(description="largest displacement, mm")
    period_s: float = Field(ge=1e-3, le=1e6, description="time of one repetition, s")
    phase: float = Field(0.0, ge=0, le=1, description="share of the period that has passed at time 0")

    def cycles(self, time_s: float) -> float:
        """Return how many periods have passed at a time."""
        return time_s / self.period_s + self.phase

    def share(self, time_s: float) -> float:
        """Return (1 - cos)/2 of the cycle: 0 at rest, 1 at the middle of the period."""
        return (1 - math.cos(2 * math.pi * self.cycles(time_s))) / 2

    def scaled(self, share: float) -> Self:
        """Return the same deformation with a share, 0 to 1, of its amplitude and turn."""
        amounts = {name: share * getattr(self, name) for name in ("amplitude_mm", "turn_deg") if hasattr(self, name)}
        return self.model_copy(update=amounts)

    @property
    def stretch(self) -> float:
        """Upper bound of the displacement's Lipschitz constant, at all times."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _invertible(self) -> "_Periodic":
        for name in ("axis", "direction", "along"):
            if name in type(self).model_fields and math.hypot(*getattr(self, name)) < SHORTEST:
                raise ValueError(f"{name} = {list(getattr(self, name))}: must have a length")
        if self.stretch >= MAX_STRETCH:
            raise ValueError(
                f"amplitude_mm = {self.amplitude_mm:g}: neighbouring points move apart by up to {self.stretch:.3g} of "
                f"their distance, so space could fold; must be below {MAX_STRETCH:g}: lower amplitude_mm, or lengthen "
                f"{' or '.join(self._lengths)}"
            )
        return self

    @property
    def _lengths(self) -> tuple[str, ...]:
        """Names of the lengths over which the displacement varies."""
        raise NotImplementedError


class _Centred(_Periodic):
    centre_mm: Point = Field((0.0, 0.0, 0.0), description="point of the model frame, mm")


class Peristalsis(_Centred):
    """Contractions that travel along a straight axis.

    With z along the axis and r the distance from it, points move inward by
    A w(z, t) (r/R) exp((1 - (r/R)^2)/2), w = (1 + cos(2 pi (z/wavelength - t/period)))/2: by A at most, at r = R.
    """

    type: Literal["peristalsis"] = "peristalsis"
    axis: Direction = Field(description="along which the waves travel, model frame, any length; through centre_mm")
    radius_mm: Size = Field(description="distance from the axis at which the displacement is largest, mm")
    wavelength_mm: Size = Field(description="distance between contractions along the axis, mm")

    @property
    def stretch(self) -> float:
        """Bound sqrt((A sqrt(e)/R)^2 + (pi A/wavelength)^2): of the parts across the axis and along it."""
        amplitude = abs(self.amplitude_mm)
        return math.hypot(amplitude * math.exp(0.5) / self.radius_mm, math.pi * amplitude / self.wavelength_mm)

    @property
    def _lengths(self) -> tuple[str, ...]:
        return "radius_mm", "wavelength_mm"


class Breathing(_Centred):
    """A slow motion to and fro, with a turn, that does not reach everything alike.

    With s = (1 - cos(2 pi t/period))/2 and b the coordinate along `along` from centre_mm, points move along `direction`
    by A s (1 - warp (1 - cos(2 pi b/wavelength))/2); then all is turned by s turn_deg about `axis`, through centre_mm.
    """

    type: Literal["breathing"] = "breathing"
    direction: Direction = Field(description="of the motion, model frame, any length")
    along: Direction = Field((1.0, 0.0, 0.0), description="along which the motion varies, model frame, any length")
    wavelength_mm: Size = Field(100.0, description="of this variation, mm")
    warp: float = Field(0.5, ge=0, le=1, description="share of the amplitude that varies; 0: a rigid motion")
    axis: Direction = Field((0.0, 0.0, 1.0), description="of the turn, model frame, any length")
    turn_deg: float = Field(0.0, ge=-90, le=90, description="largest turn, right-handed about axis, deg")

    @property
    def stretch(self) -> float:
        """Bound pi A warp/wavelength; the turn is rigid."""
        return math.pi * abs(self.amplitude_mm) * self.warp / self.wavelength_mm

    @property
    def _lengths(self) -> tuple[str, ...]:
        return ("wavelength_mm",)


class Dent(_Centred):
    """The dent of a probe that presses and lets go.

    Points move along `direction` by A s exp(-|X - centre|^2/(2 radius^2)), s = (1 - cos(2 pi t/period))/2.
    """

    type: Literal["dent"] = "dent"
    direction: Direction = Field(description="in which the probe presses, model frame, any length")
    radius_mm: Size = Field(description="standard deviation of the dent, mm")

    @property
    def stretch(self) -> float:
        """Bound A exp(-1/2)/radius: the steepest slope of the Gaussian."""
        return abs(self.amplitude_mm) * math.exp(-0.5) / self.radius_mm

    @property
    def _lengths(self) -> tuple[str, ...]:
        return ("radius_mm",)


class Contractions(_Periodic):
    """Rings of contraction that travel along a curved path, such as the centreline of a colon with bends.

    Each ring stands across the path. With z along the path's tangent there and r the distance from it, points move
    inward by A (r/R) exp((1 - (r/R)^2 - (z/width)^2)/2): by A at most, at r = R. The rings are `spacing_mm` apart, move
    on by as much in each period, and grow and fade within half of it from the path's ends. The maps of the rings are
    applied one after the other, so rings that overlap at a bend do not fold space.
    """

    type: Literal["contractions"] = "contractions"
    path_mm: tuple[Point, ...] = Field(
        min_length=2, max_length=MOST_POINTS, description="points of a smooth curve, in order, model frame, mm"
    )
    radius_mm: Size = Field(description="distance from the path at which the displacement is largest, mm")
    width_mm: Size = Field(description="standard deviation of a ring along the path, mm")
    spacing_mm: Size = Field(description="distance between rings along the path, mm")

    @property
    def chords_mm(self) -> tuple[float, ...]:
        """Distances between neighbouring points of the path, mm."""
        return tuple(math.dist(near, far) for near, far in pairwise(self.path_mm))

    @model_validator(mode="after")
    def _path(self) -> "Contractions":
        chords = self.chords_mm
        if min(chords) < NEAREST_MM:
            index = chords.index(min(chords))
            raise ValueError(
                f"path_mm: points {index} and {index + 1} are {chords[index]:.3g} mm apart; must be at least "
                f"{NEAREST_MM:g} mm"
            )
        if sum(chords) > MOST_RINGS * self.spacing_mm:
            raise ValueError(
                f"spacing_mm = {self.spacing_mm:g}: a path of {sum(chords):.4g} mm holds more than {MOST_RINGS} rings; "
                f"must be at least {sum(chords) / MOST_RINGS:.3g}"
            )
        return self

    @property
    def stretch(self) -> float:
        """Bound A sqrt(e/R^2 + 1/(e width^2)) for one ring: of the parts across the path and along it."""
        return abs(self.amplitude_mm) * math.hypot(math.exp(0.5) / self.radius_mm, math.exp(-0.5) / self.width_mm)

    @property
    def _lengths(self) -> tuple[str, ...]:
        return "radius_mm", "width_mm"


Deformation = Annotated[Peristalsis | Breathing | Dent | Contractions, Field(discriminator="type")]
