"""The lights that travel with the camera: given one by one, or by a preset."""

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from simtest.spec.falloff import CosineProfile, Profile, TableProfile
from simtest.spec.light_source import Source
from simtest.spec.spec_model import Coordinate, Spec

Direction = Annotated[float, Field(ge=-1e6, le=1e6)]
Gain = Annotated[float, Field(ge=0, le=1e6)]
Power = Annotated[float, Field(gt=0, le=1e12)]
Vector = tuple[float, float, float]

COLOCATED_MM = 1e-9
"""A light no farther than this from the camera centre is at the camera: it sees what the camera sees."""


def is_at_camera(position_mm: npt.ArrayLike) -> bool:
    """Return whether a position, shape (3,), camera frame, mm, is the camera centre."""
    return float(np.linalg.norm(position_mm)) <= COLOCATED_MM


class Emission(Spec):
    """How a light emits: power colour profile(angle) edge(angle), the angle taken from `direction`."""

    colour: tuple[Gain, Gain, Gain] = Field(
        (1.0, 1.0, 1.0), description="linear RGB factor of the power; mono variants take its luminance"
    )
    profile: Profile = Field(
        CosineProfile(), description="factor over the angle from direction; default the same in all directions"
    )
    direction: tuple[Direction, Direction, Direction] = Field(
        (0.0, 0.0, 1.0), description="axis of profile and spot, camera frame, any length"
    )
    spot_deg: float | None = Field(
        None, gt=0, description="full angle of a spot, at most 180 deg; nothing is emitted beyond half of it"
    )
    soft_edge_deg: float = Field(
        0.0, ge=0, description="the spot's emission falls to 0 over this angle inside its rim, linearly in the angle"
    )
    source: Source | None = Field(
        None,
        description="exit of finite size across direction: disc, ring or crescent, each of its points emits alike; "
        "default a point",
    )
    position_error_mm: float = Field(
        0.0,
        ge=0,
        le=1e3,
        description="standard deviation of the true position about the nominal, along each axis, mm; drawn by rig.seed",
    )

    @model_validator(mode="after")
    def _usable(self) -> "Emission":
        if not any(self.colour):
            raise ValueError(f"colour = {list(self.colour)}: one of the channels must be positive")
        if not any(self.direction):
            raise ValueError(f"direction = {list(self.direction)}: must have a length")
        if self.spot_deg is None:
            if self.soft_edge_deg:
                raise ValueError(f"soft_edge_deg = {self.soft_edge_deg:g}: needs spot_deg")
        elif self.spot_deg > 180:
            raise ValueError(
                f"spot_deg = {self.spot_deg:g}: must be at most 180, the full angle of a half-space; "
                "leave it out for a light that emits everywhere"
            )
        elif self.soft_edge_deg > self.spot_deg / 2:
            raise ValueError(
                f"soft_edge_deg = {self.soft_edge_deg:g}: must be at most half of spot_deg = {self.spot_deg:g}"
            )
        return self

    @property
    def axis(self) -> Array:
        """Unit axis of profile and spot, shape (3,), camera frame."""
        # The squares of a very short direction would underflow.
        axis = np.array(self.direction) / np.abs(self.direction).max()
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def across(self) -> Array:
        """Unit vectors x and y of the source's plane, shape (2, 3), camera frame.

        They are those of the camera, turned with z onto the axis by the shortest rotation; for an axis towards the
        camera's back y is flipped first.
        """
        x, y, z = self.axis
        sign = 1.0 if z >= 0 else -1.0
        a = -1 / (sign + z)
        return np.array([[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]])

    @property
    def is_isotropic(self) -> bool:
        """Whether the light emits alike in all directions."""
        return self.spot_deg is None and self.profile.model().is_uniform

    def factor(self, directions: npt.ArrayLike) -> Array:
        """Return the emission relative to that of an isotropic light of the same power, shape (N,).

        Parameters
        ----------
        directions : array_like, shape (N, 3)
            Unit directions away from the light, camera frame.
        """
        away = np.asarray(directions, dtype=float)
        cosine, sine = away @ self.axis, np.linalg.norm(np.cross(away, self.axis), axis=1)
        value = self.profile.model().at(cosine, sine)
        if self.spot_deg is None:
            return value
        # Angle from the spot's rim, positive inside; a soft edge rises linearly from 0 at the rim.
        inside = math.radians(self.spot_deg / 2) - np.arctan2(sine, cosine)
        edge = math.radians(self.soft_edge_deg)
        return value * (np.clip(inside / edge, 0.0, 1.0) if edge > 0 else (inside >= 0))


class LightSpec(Emission):
    """A light in the camera frame: a point, or a source of finite size.

    It lies at `position_mm`, or at `offset_mm` from the camera centre along `azimuth_deg` in the plane z = 0. Of a
    source of finite size this is the centre of its (outer) disc; its nominal position is the centroid of its area.
    """

    position_mm: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="position in the camera frame, mm"
    )
    offset_mm: float = Field(0.0, ge=0, le=1e6, description="distance from the camera centre, mm")
    azimuth_deg: float = Field(0.0, ge=-360, le=360, description="direction of the offset, deg from x to y")
    power: Power = Field(1.0, description="radiant intensity along direction, mW/sr or any relative unit, one for all")

    @model_validator(mode="after")
    def _one_way(self) -> "LightSpec":
        if self.position_mm is not None and (self.offset_mm or self.azimuth_deg):
            raise ValueError("position_mm and offset_mm exclude each other; give one of them")
        return self

    @property
    def nominal_mm(self) -> Vector:
        """Nominal position in the camera frame, mm, as estimators know it: of a source's centroid."""
        position = self._place_mm
        if self.source is None or not any(self.source.centroid_mm):
            return position
        x, y, z = (np.array(position) + self.source.centroid_mm @ self.across).tolist()
        return (x, y, z)

    @property
    def _place_mm(self) -> Vector:
        """Position as given, mm."""
        if self.position_mm is not None:
            return self.position_mm
        angle = math.radians(self.azimuth_deg)
        return (self.offset_mm * math.cos(angle), self.offset_mm * math.sin(angle), 0.0)

    @property
    def profile_of_view(self) -> CosineProfile | TableProfile | None:
        """The emission as a function of the sightline's angle from the optical axis; None if it is no such function.

        It is one for a light at the camera that shines along the optical axis. A spot is left out: beyond its rim
        there is nothing to divide by. Of a source of finite size it is the profile about its centre: what a disc of
        radius r sends to the distance d differs by terms of (r / d)^2.
        """
        along = not any(self.direction[:2]) and self.direction[2] > 0
        return self.profile if along and self.spot_deg is None and is_at_camera(self.nominal_mm) else None


Preset = Literal["colocated", "laparoscope", "colonoscope_2", "colonoscope_3"]


@dataclass(frozen=True)
class Ring:
    """Number of lights and radius of the ring that they stand on, evenly spaced around the camera."""

    count: int
    radius_mm: float


PRESETS: dict[Preset, Ring] = {
    "colocated": Ring(1, 0.0),
    "laparoscope": Ring(8, 4.0),
    "colonoscope_2": Ring(2, 4.0),
    "colonoscope_3": Ring(3, 4.0),
}
"""Sizes of the class, not of one instrument: in a 10 mm laparoscope the ends of the fibres lie 3 to 5 mm from the axis,
in the 12 to 13 mm tip of a colonoscope the light guides about 4 mm from the lens.
"""


class Rig(Spec):
    """The lights that travel with the camera: a list, or a preset whose numbers can be overridden."""

    lights: tuple[LightSpec, ...] = Field((LightSpec(),), min_length=1, max_length=32)
    preset: Preset | None = Field(None, description="lights on a ring about the optical axis, in place of lights")
    count: int | None = Field(None, ge=1, le=32, description="of a preset: number of lights")
    radius_mm: float | None = Field(None, ge=0, le=1e6, description="of a preset: radius of the ring, mm")
    azimuth_deg: float | None = Field(
        None, ge=-360, le=360, description="of a preset: direction of the first light, deg from x to y"
    )
    axial_mm: Coordinate | None = Field(None, description="of a preset: z of the lights, mm")
    power: Power | None = Field(None, description="of a preset: power of all lights together, shared evenly; default 1")
    each: Emission | None = Field(None, description="of a preset: how each light emits")
    seed: int = Field(0, ge=0, lt=2**63, description="of the position errors; experiments draw one a realisation")

    emission_known: bool = Field(
        True,
        description="whether reconstruction is told, and divides by, the profile of a single light at the camera that "
        "shines along the optical axis and is no spot; that of other rigs it is never told",
    )

    @model_validator(mode="after")
    def _expand(self) -> "Rig":
        if self.preset is None:
            for name in ("count", "radius_mm", "azimuth_deg", "axial_mm", "power", "each"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name}: belongs to a preset; give preset, or the place of each of lights")
            return self
        ring = self._ring()
        # Equal lights are those of an older frame.json, which held both.
        if "lights" in self.model_fields_set and self.lights != ring:
            raise ValueError("preset and lights exclude each other; give one of them")
        # The model is frozen; this is still its construction.
        object.__setattr__(self, "lights", ring)
        return self

    @model_serializer(mode="wrap")
    def _as_given(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out the lights of a preset: beside them none of its numbers could be changed."""
        dumped: dict[str, Any] = dump(self)
        if self.preset is not None:
            dumped.pop("lights", None)
        return dumped

    def _ring(self) -> tuple[LightSpec, ...]:
        """Return the preset's lights."""
        assert self.preset is not None
        ring = PRESETS[self.preset]
        count = ring.count if self.count is None else self.count
        radius = ring.radius_mm if self.radius_mm is None else self.radius_mm
        if count > 1 and radius == 0:
            raise ValueError(f"count = {count}: with radius_mm = 0 all lights would be in one place")
        emission = {} if self.each is None else dict(self.each)
        power = (1.0 if self.power is None else self.power) / count
        first, lights = math.radians(self.azimuth_deg or 0.0), []
        for i in range(count):
            angle = first + 2 * math.pi * i / count
            position = (radius * math.cos(angle), radius * math.sin(angle), self.axial_mm or 0.0)
            lights.append(LightSpec(position_mm=position, power=power, **emission))
        return tuple(lights)

    def known_emission(self) -> CosineProfile | TableProfile | None:
        """Return the profile that reconstruction may divide by: of one light at the camera, along the optical axis.

        None if it is uniform or not known, for a spot, and for other rigs, whose falloff depends on distance too.
        """
        profile = self.lights[0].profile_of_view if len(self.lights) == 1 else None
        usable = self.emission_known and profile is not None and not profile.model().is_uniform
        return profile if usable else None

    @property
    def is_drawn(self) -> bool:
        """Whether the true positions depend on the seed."""
        return any(light.position_error_mm > 0 for light in self.lights)

    def nominal_mm(self) -> Array:
        """Return the nominal light positions, as estimators know them, shape (L, 3), camera frame, mm."""
        return np.array([light.nominal_mm for light in self.lights])

    def true_mm(self) -> Array:
        """Return the rendered light positions, the nominal ones plus their errors, shape (L, 3), camera frame, mm."""
        positions = self.nominal_mm()
        if not self.is_drawn:
            return positions
        # All lights draw, also those without an error, so that a light's error does not depend on the others'.
        deviations = np.array([[light.position_error_mm] for light in self.lights])
        return positions + deviations * from_integer(self.seed).standard_normal(positions.shape)
