"""Recipes of the generated anatomies: the sizes a colon or a liver is made from."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.spec.reading import Spec, read_toml, validate

Coordinate = Annotated[float, Field(ge=-1e3, le=1e3)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
HalfExtent = Annotated[float, Field(ge=10, le=200)]


class ColonRecipe(Spec):
    """A bent tube with haustral folds, seen from inside.

    The centreline bends in a plane with a heading that changes smoothly; the folds sit in rings of three, one
    between each two taeniae, and each is interrupted, slanted and sized by its own random numbers.
    """

    type: Literal["colon"] = "colon"
    length_mm: float = Field(115.0, ge=20, le=500, description="length of the centreline, mm")
    radius_mm: float = Field(22.0, ge=5, le=60, description="base radius, mm")
    bend_deg: float = Field(70.0, ge=-180, le=180, description="heading gained over the whole length, deg")
    sway_deg: float = Field(8.0, ge=0, le=45, description="amplitude of the heading's oscillation, deg")
    sway_length_mm: float = Field(90.0, ge=20, le=1000, description="period of the heading's oscillation, mm")
    taenia_mm: float = Field(0.8, ge=0, le=5, description="amplitude of the three-fold modulation of the radius, mm")
    fold_depth_mm: float = Field(7.0, ge=0, le=30, description="mean height of a fold over the wall, mm")
    # Where two folds run into each other the edge is sharper than either's own: about half of this at worst.
    fold_edge_mm: float = Field(4.5, ge=0.5, le=10, description="mean radius of curvature of a lone fold's edge, mm")
    fold_spacing_mm: float = Field(22.0, ge=5, le=100, description="mean distance between rings of folds, mm")
    fold_concentration: float = Field(4.0, ge=0, le=50, description="how short a fold is around the tube; 0: a ring")
    irregularity: float = Field(0.25, ge=0, le=0.5, description="relative spread of depth, edge radius and place")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the irregularities")

    @model_validator(mode="after")
    def _embedded(self) -> "ColonRecipe":
        deepest = self.taenia_mm + self.fold_depth_mm * (1 + self.irregularity)
        if deepest > 0.8 * self.radius_mm:
            raise ValueError(
                f"folds and taeniae reach {deepest:g} mm into the lumen; at most 0.8 radius_mm = "
                f"{0.8 * self.radius_mm:g} mm is allowed"
            )
        return self


class LiverLobe(Spec):
    """An ellipsoid of the liver's body; x to the left of the patient, y up, z to the front."""

    centre_mm: Vector = Field(description="centre, mm")
    semi_axes_mm: tuple[HalfExtent, HalfExtent, HalfExtent] = Field(description="half extents along its axes, mm")
    turn_deg: float = Field(0.0, ge=-180, le=180, description="turn about z, deg from x to y")


class LiverRecipe(Spec):
    """Lobes joined smoothly, cut from below by a smooth concave visceral face, with a faint relief."""

    type: Literal["liver"] = "liver"
    lobes: tuple[LiverLobe, ...] = Field(min_length=1, max_length=6)
    blend_mm: float = Field(8.0, ge=2, le=40, description="length over which lobes melt into each other, mm")
    visceral_normal: Vector = Field((0.25, -0.85, -0.45), description="direction that the visceral face looks along")
    visceral_offset_mm: float = Field(28.0, ge=-100, le=200, description="distance of the face from the origin, mm")
    visceral_radius_mm: float = Field(260.0, ge=60, le=1e4, description="radius of the organs' hollow in it, mm")
    edge_mm: float = Field(2.5, ge=0.5, le=20, description="length over which the inferior edge is rounded, mm")
    relief_mm: float = Field(0.35, ge=0, le=3, description="amplitude of each wave of the surface's relief, mm")
    relief_length_mm: float = Field(48.0, ge=15, le=300, description="mean wavelength of the relief, mm")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the relief")

    @model_validator(mode="after")
    def _direction(self) -> "LiverRecipe":
        if sum(part * part for part in self.visceral_normal) < 1e-12:
            raise ValueError("visceral_normal = (0, 0, 0): must have a direction")
        return self


def load_recipe(path: str | Path) -> ColonRecipe | LiverRecipe:
    """Read a recipe file.

    Parameters
    ----------
    path : str or Path
        A TOML file with the keys of `ColonRecipe` or `LiverRecipe`; ``type`` says which. Lengths in mm.

    Returns
    -------
    ColonRecipe or LiverRecipe

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    data = read_toml(Path(path))
    kind = data.get("type")
    if kind == "colon":
        return validate(ColonRecipe, data, str(path))
    if kind == "liver":
        return validate(LiverRecipe, data, str(path))
    got = f"type = {kind!r}" if "type" in data else "type: missing"
    raise InputError(f"{path}: {got}; allowed: colon, liver")
