"""The lights of a scene: their exits, how they emit, and where they stand in the rig.

A source is a disc, a ring or a crescent in the plane across its light's direction. Factors over the angle from an axis
serve calibration files too.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from simtest.calibration.photometry import AngularProfile
from simtest.calibration.priors import AT_CAMERA_MM
from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Coordinate, Spec


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


LEAST_SHARE = 0.01
"""A crescent keeps at least this share of its disc: of a thinner one nothing reliable could be said."""

RIM_POINTS = 180
"""Points on a whole circle of the rim."""

Radius = Annotated[float, Field(ge=0.5, le=6)]


class _Source(Spec):
    """A part of a disc around the origin of the source's plane; lengths in mm, coordinates (side, up)."""

    @property
    @abstractmethod
    def area_mm2(self) -> float:
        """Area, mm^2."""

    @property
    def centroid_mm(self) -> tuple[float, float]:
        """Centroid of the area, mm, in the source's plane."""
        return (0.0, 0.0)

    @abstractmethod
    def rim(self) -> Array:
        """Return points of the rim, shape (N, 2), mm, in the source's plane."""


class DiscSource(_Source):
    """A disc."""

    type: Literal["disc"]
    radius_mm: float = Field(ge=0.5, le=3, description="radius, mm")

    @property
    def area_mm2(self) -> float:
        """Area, mm^2."""
        return math.pi * self.radius_mm**2

    def rim(self) -> Array:
        """Return points of the rim, shape (N, 2), mm, in the source's plane."""
        return _circle(self.radius_mm)


class RingSource(_Source):
    """A disc without a smaller one of the same centre."""

    type: Literal["ring"]
    radius_mm: Radius = Field(description="outer radius, mm")
    inner_mm: float = Field(gt=0, description="inner radius, mm; below radius_mm")

    @model_validator(mode="after")
    def _has_area(self) -> "RingSource":
        if self.inner_mm >= self.radius_mm:
            raise ValueError(f"inner_mm = {self.inner_mm:g}: must be below radius_mm = {self.radius_mm:g}")
        return self

    @property
    def area_mm2(self) -> float:
        """Area, mm^2."""
        return math.pi * (self.radius_mm**2 - self.inner_mm**2)

    def rim(self) -> Array:
        """Return points of the rim, shape (N, 2), mm, in the source's plane."""
        return np.concatenate([_circle(self.radius_mm), _circle(self.inner_mm)])


class CrescentSource(_Source):
    """A disc without what a second disc covers, as light guides leave room for the lens."""

    type: Literal["crescent"]
    radius_mm: Radius = Field(description="radius of the disc, mm")
    cut_radius_mm: float = Field(gt=0, le=20, description="radius of the disc that is cut out, mm")
    cut_offset_mm: float = Field(ge=0, le=20, description="from the disc's centre to that of the cut, mm")
    azimuth_deg: float = Field(
        0.0, ge=-360, le=360, description="direction to the cut's centre in the source's plane, deg from x to y"
    )

    @model_validator(mode="after")
    def _has_area(self) -> "CrescentSource":
        cut = f"cut_radius_mm = {self.cut_radius_mm:g} at cut_offset_mm = {self.cut_offset_mm:g}"
        if self.cut_offset_mm >= self.radius_mm + self.cut_radius_mm:
            raise ValueError(f"{cut}: must overlap the disc of radius_mm = {self.radius_mm:g}; else give a disc")
        if self.area_mm2 < LEAST_SHARE * math.pi * self.radius_mm**2:
            raise ValueError(
                f"{cut}: must leave at least {100 * LEAST_SHARE:g} % of the disc of radius_mm = {self.radius_mm:g}"
            )
        return self

    def _cut(self) -> tuple[float, float]:
        """Compute area, mm^2, and first moment towards the cut, mm^3, of what the cut takes of the disc.

        Both circles meet on the line x = x0. The cut's circle bounds the lens before it, the disc's beyond it, and the
        moment of the lens about the disc's centre is the offset times the area of the first part.
        """
        outer, cut, offset = self.radius_mm, self.cut_radius_mm, self.cut_offset_mm
        if offset == 0:
            return math.pi * min(outer, cut) ** 2, 0.0
        x0 = (offset**2 + outer**2 - cut**2) / (2 * offset)
        before = _beyond(cut, offset - x0)
        beyond = _beyond(outer, x0)
        return before + beyond, offset * before

    @property
    def area_mm2(self) -> float:
        """Area, mm^2."""
        return math.pi * self.radius_mm**2 - self._cut()[0]

    @property
    def centroid_mm(self) -> tuple[float, float]:
        """Centroid of the area, mm, in the source's plane, from the disc's centre."""
        along = -self._cut()[1] / self.area_mm2
        return (along * self.towards_cut[0], along * self.towards_cut[1])

    @property
    def towards_cut(self) -> tuple[float, float]:
        """Unit direction from the disc's centre to the cut's, in the source's plane."""
        angle = math.radians(self.azimuth_deg)
        return (math.cos(angle), math.sin(angle))

    def chord(self, along: Array) -> tuple[Array, Array]:
        """Return half chords, mm, of the cut (at most the disc's) and of the disc, at `along`, mm towards the cut."""
        outer = np.sqrt(np.maximum(self.radius_mm**2 - along**2, 0))
        cut = np.sqrt(np.maximum(self.cut_radius_mm**2 - (along - self.cut_offset_mm) ** 2, 0))
        return np.minimum(cut, outer), outer

    def quantiles(self, count: int) -> Array:
        """Return positions towards the cut, mm, that bound `count` slices of about equal area, shape (count + 1,)."""
        # Equal steps of the angle resolve both ends of the disc.
        along = -self.radius_mm * np.cos(np.linspace(0, np.pi, 16 * count + 1))
        inner, outer = self.chord((along[1:] + along[:-1]) / 2)
        whole = np.concatenate([[0.0], np.cumsum((outer - inner) * np.diff(along))])
        bright = np.flatnonzero(np.diff(whole) > 0)
        kept = np.concatenate([bright, bright[-1:] + 1])
        knots = np.interp(np.linspace(0, 1, count + 1), whole[kept] / whole[-1], along[kept])
        # No part of the source may lie beyond the outermost knots.
        knots[0], knots[-1] = along[bright[0] - (bright[0] > 0)], along[min(bright[-1] + 2, len(along) - 1)]
        return np.asarray(knots)

    def rim(self) -> Array:
        """Return points of the rim, shape (N, 2), mm, in the source's plane."""
        cut = np.array(self.towards_cut) * self.cut_offset_mm
        outer, inner = _circle(self.radius_mm), cut + _circle(self.cut_radius_mm)
        outer = outer[np.linalg.norm(outer - cut, axis=1) >= self.cut_radius_mm]
        return np.concatenate([outer, inner[np.linalg.norm(inner, axis=1) <= self.radius_mm]])


Source = Annotated[DiscSource | RingSource | CrescentSource, Field(discriminator="type")]


def _circle(radius: float) -> Array:
    angle = np.linspace(0, 2 * np.pi, RIM_POINTS, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _beyond(radius: float, distance: float) -> float:
    """Return the area of the part of a disc that lies beyond a line at a signed distance from its centre."""
    t = min(max(distance / radius, -1.0), 1.0)
    return radius**2 * (math.acos(t) - t * math.sqrt(1 - t * t))


Direction = Annotated[float, Field(ge=-1e6, le=1e6)]
Gain = Annotated[float, Field(ge=0, le=1e6)]
Power = Annotated[float, Field(gt=0, le=1e12)]
Vector = tuple[float, float, float]


def is_at_camera(position_mm: npt.ArrayLike) -> bool:
    """Return whether a position, shape (3,), camera frame, mm, is the camera centre: it sees what the camera sees."""
    return float(np.linalg.norm(position_mm)) <= AT_CAMERA_MM


class Emission(Spec):
    """How a light emits: power colour profile(angle) edge(angle), the angle taken from `direction`."""

    directions = ("direction",)

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
        return basis_across(self.axis)

    @property
    def is_isotropic(self) -> bool:
        """Whether the light emits alike in all directions."""
        return self.spot_deg is None and self.profile.model().is_uniform

    def factor(self, directions: npt.ArrayLike) -> Array:
        """Return the emission along unit directions away from the light, (N, 3), camera frame; shape (N,).

        It is relative to that of an isotropic light of the same power.
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
        # Imported here: calibration files, which have falloffs too, need no generator, which is slow to load.
        from simtest.runtime.seeds import from_integer

        # All lights draw, also those without an error, so that a light's error does not depend on the others'.
        deviations = np.array([[light.position_error_mm] for light in self.lights])
        return positions + deviations * from_integer(self.seed).standard_normal(positions.shape)
