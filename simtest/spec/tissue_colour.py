"""The colour of tissue: a ground that is mottled by its blood, vessels that branch, and a net of capillaries."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from simtest.spec.spec_model import Share, Spec, with_preset

Preset = Literal["colon_mucosa", "liver_capsule", "gallbladder", "stomach"]

MAX_CALIBRE_RATIO = 30.0
"""Largest over smallest calibre: a tree has its cube of twigs (Murray's law), more than fit on any surface here."""

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "colon_mucosa": {
            "base": (0.66, 0.29, 0.19),
            "blood": 0.04,
            "mottling": {"amplitude": 0.10, "wavelength_mm": 7.0},
            "vessels": {"largest_mm": 0.5, "smallest_mm": 0.06, "spacing_mm": 1.3, "depth_mm": 0.12},
            "capillaries": {"spacing_mm": 0.11, "strength": 0.10},
        },
        "liver_capsule": {
            "base": (0.20, 0.040, 0.033),
            "blood": 0.15,
            "mottling": {"amplitude": 0.10, "wavelength_mm": 10.0},
            "vessels": {"largest_mm": 0.5, "smallest_mm": 0.08, "spacing_mm": 4.5, "depth_mm": 0.15},
            "capillaries": {"spacing_mm": 1.2, "strength": 0.10},
        },
        "gallbladder": {
            "base": (0.72, 0.47, 0.31),
            "blood": 0.015,
            "mottling": {"amplitude": 0.08, "wavelength_mm": 9.0},
            "vessels": {"largest_mm": 0.7, "smallest_mm": 0.07, "spacing_mm": 2.2, "depth_mm": 0.15},
            "capillaries": {"spacing_mm": 0.4, "strength": 0.05},
        },
        "stomach": {
            "base": (0.66, 0.28, 0.17),
            "blood": 0.05,
            "mottling": {"amplitude": 0.13, "wavelength_mm": 5.0},
            "vessels": {"largest_mm": 0.4, "smallest_mm": 0.06, "spacing_mm": 2.5, "depth_mm": 0.25},
            "capillaries": {"spacing_mm": 0.3, "strength": 0.16},
        },
    }
)
"""Numbers of the presets; docs/concepts/tissue.md gives their sources."""

_COLON = PRESETS["colon_mucosa"]


class Mottling(Spec):
    """Blood content that varies from place to place."""

    amplitude: float = Field(ge=0, le=1, description="standard deviation of the ground's absorbance in green; 0: none")
    wavelength_mm: float = Field(ge=0.2, le=200, description="mean wavelength, mm")


class Vessels(Spec):
    """Trees of vessels, arteries and veins, whose radii obey Murray's law."""

    largest_mm: float = Field(ge=0.02, le=5, description="calibre (diameter) of a whole tree's trunk, about, mm")
    smallest_mm: float = Field(ge=0.005, le=2, description="calibre of the twigs, mm")
    spacing_mm: float = Field(ge=0.2, le=50, description="mean distance between the ends of neighbouring twigs, mm")
    depth_mm: float = Field(ge=0, le=3, description="depth of the vessels below the surface, mm")
    arterial_saturation: Share = Field(0.97, description="share of oxygenated haemoglobin in arteries")
    venous_saturation: Share = Field(0.75, description="the same in veins")
    tortuosity: float = Field(0.6, ge=0, le=1, description="how much vessels wind; 0: straight")
    strength: float = Field(1.0, ge=0, le=2, description="haemoglobin over that of normal blood; 0: no vessels")

    @model_validator(mode="after")
    def _ordered(self) -> "Vessels":
        if not self.smallest_mm < self.largest_mm <= MAX_CALIBRE_RATIO * self.smallest_mm:
            raise ValueError(
                f"largest_mm = {self.largest_mm:g} and smallest_mm = {self.smallest_mm:g}: the largest calibre must "
                f"be more than the smallest and at most {MAX_CALIBRE_RATIO:g} times as much"
            )
        if self.largest_mm > self.spacing_mm:
            raise ValueError(
                f"largest_mm = {self.largest_mm:g} and spacing_mm = {self.spacing_mm:g}: vessels must not be wider "
                "than their spacing"
            )
        return self


class Capillaries(Spec):
    """The net of capillaries between the vessels, such as the honeycomb around the pits of mucosa."""

    spacing_mm: float = Field(ge=0.05, le=20, description="mean width of the net's meshes, mm")
    strength: float = Field(ge=0, le=1, description="absorbance of the net in green; 0: none")


class TissueColour(Spec):
    """The albedo of tissue. A preset gives all numbers; each may be replaced."""

    preset: Preset = Field("colon_mucosa", description="whose numbers hold where none is given")
    base: tuple[Share, Share, Share] = Field(_COLON["base"], description="albedo of the ground, linear RGB")
    blood: Annotated[float, Field(ge=0.001, le=1)] = Field(
        _COLON["blood"], description="share of the ground's volume that is blood: how deep light reaches"
    )
    mottling: Mottling = Mottling(**_COLON["mottling"])
    vessels: Vessels = Vessels(**_COLON["vessels"])
    capillaries: Capillaries = Capillaries(**_COLON["capillaries"])
    seed: int = Field(0, ge=0, lt=2**32, description="of the pattern")

    @model_validator(mode="before")
    @classmethod
    def _from_preset(cls, data: Any) -> Any:
        """Fill in the preset's numbers; an unknown preset is refused by its field."""
        if not isinstance(data, Mapping):
            return data
        named = data.get("preset", "colon_mucosa")
        preset = PRESETS.get(named) if isinstance(named, str) else None
        return data if preset is None else with_preset(data, preset)
