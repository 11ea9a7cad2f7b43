"""The exits of light guides: discs, rings and crescents in the plane across a light's direction."""

import math
from abc import abstractmethod
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from simtest.runtime.arrays import Array
from simtest.spec.spec_model import Spec

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
