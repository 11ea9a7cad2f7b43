"""Recipes of the generated anatomies: the sizes that a colon or a liver is made from."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec.spec_model import UNSAID, Share, Spec, unsaid_at, validate
from simtest.spec.toml_files import apply_settings, read_toml, source_name

Coordinate = Annotated[float, Field(ge=-1e3, le=1e3)]
Vector = tuple[Coordinate, Coordinate, Coordinate]
FossaExtent = Annotated[float, Field(ge=3, le=100)]
NECK_SHARES = (0.3, 0.8)
"""Width of a pedunculated polyp's neck over its head's: narrower ones bend too sharply to be meshed."""

HalfExtent = Annotated[float, Field(ge=10, le=200)]


class Polyp(Spec):
    """A polyp, at its position whatever folds are there.

    Sessile: a round bump on the wall. With a neck it is pedunculated: a head on a stalk.
    """

    along_mm: float = Field(ge=0, le=500, description="position along the centreline, mm")
    around_deg: float = Field(ge=-360, le=360, description="position around the tube, deg")
    height_mm: float = Field(4.0, ge=0.2, le=20, description="height over the wall, mm")
    width_mm: float = Field(8.0, ge=1, le=40, description="width at half height; of a pedunculated one its head's, mm")
    steepness: float = Field(
        0.0, ge=0, le=10, description="of a sessile one's side; 0: Gaussian, above: more of a dome", **UNSAID
    )
    neck_mm: float | None = Field(None, ge=0.5, le=30, description="width of the neck, mm; none given: sessile")

    @model_validator(mode="after")
    def _shaped(self) -> "Polyp":
        if self.neck_mm is None:
            return self
        if self.steepness:
            raise ValueError(f"steepness = {self.steepness:g}: is of a sessile polyp; leave it out with a neck")
        low, high = (share * self.width_mm for share in NECK_SHARES)
        if not low <= self.neck_mm <= high:
            raise ValueError(f"neck_mm = {self.neck_mm:g}: must be {low:g} to {high:g}, of a head of {self.width_mm:g}")
        if self.height_mm < self.width_mm:
            raise ValueError(
                f"height_mm = {self.height_mm:g}: must be at least width_mm, {self.width_mm:g}, with a neck"
            )
        return self


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
    taenia_ridge_mm: float = Field(0.0, ge=0, le=5, description="height of a ridge along each taenia, mm", **UNSAID)
    fold_depth_mm: float = Field(7.0, ge=0, le=30, description="mean height of a fold over the wall, mm")
    # Where two folds run into each other the edge is sharper than either's own: about half of this at worst.
    fold_edge_mm: float = Field(4.5, ge=0.5, le=10, description="mean radius of curvature of a lone fold's edge, mm")
    fold_spacing_mm: float = Field(22.0, ge=5, le=100, description="mean distance between rings of folds, mm")
    fold_stagger: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="how far along each row of folds stands from its neighbour, over fold_spacing_mm",
        **UNSAID,
    )
    fold_concentration: float = Field(4.0, ge=0, le=50, description="how short a fold is around the tube; 0: a ring")
    irregularity: float = Field(0.25, ge=0, le=0.5, description="relative spread of depth, edge radius and position")
    closed: bool = Field(
        False, description="whether rounded ends, radius_mm deep, close the tube beyond length_mm", **UNSAID
    )
    crease_mm: float = Field(
        0.0, ge=0, le=3, description="mean height of the fine folds between the large ones, mm", **UNSAID
    )
    crease_spacing_mm: float = Field(
        6.0, ge=2, le=50, description="mean distance between fine folds along the tube, mm", **unsaid_at(6.0)
    )
    polyps: tuple[Polyp, ...] = Field((), max_length=20, description="polyps")
    polyp_count: int = Field(0, ge=0, le=20, description="further polyps, whose places and sizes are drawn", **UNSAID)
    polyp_smallest_mm: float = Field(
        3.0, ge=1, le=20, description="least width_mm of those, even in the logarithm", **unsaid_at(3.0)
    )
    polyp_largest_mm: float = Field(
        15.0, ge=1, le=20, description="largest width_mm of those, where there is room", **unsaid_at(15.0)
    )
    polyp_stalked: Share = Field(0.3, description="share of those that are pedunculated", **unsaid_at(0.3))
    relief_mm: float = Field(0.0, ge=0, le=0.2, description="amplitude of each wave of the mucosa's fine relief, mm")
    relief_length_mm: float = Field(4.0, ge=2, le=30, description="mean wavelength of the relief, mm")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the irregularities")

    @model_validator(mode="after")
    def _embedded(self) -> "ColonRecipe":
        for i, polyp in enumerate(self.polyps):
            if polyp.along_mm > self.length_mm:
                raise ValueError(
                    f"polyps.{i}.along_mm = {polyp.along_mm:g}: must be at most length_mm = {self.length_mm:g}"
                )
        if self.polyp_smallest_mm > self.polyp_largest_mm:
            raise ValueError(
                f"polyp_smallest_mm = {self.polyp_smallest_mm:g}: must be at most polyp_largest_mm = "
                f"{self.polyp_largest_mm:g}"
            )
        # Of a ridge and a fold, only one is high where the other is.
        deepest = self.taenia_mm + max(self.taenia_ridge_mm, self.fold_depth_mm * (1 + self.irregularity))
        deepest += max((polyp.height_mm for polyp in self.polyps), default=0.0)
        if deepest > 0.8 * self.radius_mm:
            raise ValueError(
                f"folds, taeniae and polyps reach {deepest:g} mm into the lumen; at most 0.8 radius_mm = "
                f"{0.8 * self.radius_mm:g} mm is allowed"
            )
        return self


class LiverLobe(Spec):
    """An ellipsoid of the liver's body; x to the left of the patient, y up, z to the front."""

    centre_mm: Vector = Field(description="centre, mm")
    semi_axes_mm: tuple[HalfExtent, HalfExtent, HalfExtent] = Field(description="half extents along its axes, mm")
    turn_deg: float = Field(0.0, ge=-180, le=180, description="turn about z, deg from x to y")


class LiverFossa(LiverLobe):
    """The bed of the gallbladder: an ellipsoid taken out of the visceral face."""

    semi_axes_mm: tuple[FossaExtent, FossaExtent, FossaExtent] = Field(description="half extents, mm")
    edge_mm: float = Field(2.5, ge=0.5, le=20, description="length over which its rim is rounded, mm")


class LiverRecipe(Spec):
    """Lobes joined smoothly, cut from below by a smooth concave visceral face, with a fossa and a faint relief."""

    type: Literal["liver"] = "liver"
    lobes: tuple[LiverLobe, ...] = Field(min_length=1, max_length=6)
    blend_mm: float = Field(8.0, ge=2, le=40, description="length over which lobes melt into each other, mm")
    visceral_normal: Vector = Field((0.25, -0.85, -0.45), description="direction that the visceral face looks along")
    visceral_offset_mm: float = Field(28.0, ge=-100, le=200, description="distance of the face from the origin, mm")
    visceral_radius_mm: float = Field(260.0, ge=60, le=1e4, description="radius of the organs' hollow in it, mm")
    edge_mm: float = Field(2.5, ge=0.5, le=20, description="length over which the inferior edge is rounded, mm")
    fossa: LiverFossa | None = Field(None, description="bed of the gallbladder")
    relief_mm: float = Field(0.35, ge=0, le=3, description="amplitude of each wave of the surface's relief, mm")
    relief_length_mm: float = Field(48.0, ge=15, le=300, description="mean wavelength of the relief, mm")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the relief")

    @model_validator(mode="after")
    def _direction(self) -> "LiverRecipe":
        if sum(part * part for part in self.visceral_normal) < 1e-12:
            raise ValueError("visceral_normal = (0, 0, 0): must have a direction")
        return self


RECIPES: dict[str, type[ColonRecipe] | type[LiverRecipe]] = {"colon": ColonRecipe, "liver": LiverRecipe}


def load_recipe(path: str | Path, settings: Mapping[str, Any] | None = None) -> ColonRecipe | LiverRecipe:
    """Read a recipe, whose ``type`` is colon or liver; `settings` by key path or as tables replace its values."""
    path, values = Path(path), dict(_flat(settings or {}))
    data, where = apply_settings(read_toml(path), values, str(path)), source_name(path, values)
    kind = data.get("type")
    if kind not in list(RECIPES):
        got = f"type = {kind!r}" if "type" in data else "type: missing"
        raise InputError(f"{where}: {got}; allowed: {', '.join(RECIPES)}")
    return validate(RECIPES[kind], data, where)


def _flat(tables: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested tables by key path."""
    for key, value in tables.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def load_anatomy(
    kind: str, recipe: str | Path | None = None, seed: int | None = None, settings: Mapping[str, Any] | None = None
) -> ColonRecipe | LiverRecipe:
    """Read a recipe of one kind, by default the shipped one; `seed` and `settings` replace its values."""
    path = find(recipe if recipe is not None else kind, "meshes")
    described = load_recipe(path, {**(settings or {}), **({} if seed is None else {"seed": seed})})
    if described.type != kind:
        raise InputError(f"{path}: type = {described.type!r}; simtest mesh {kind} needs {kind!r}")
    return described
