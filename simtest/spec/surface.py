"""The surfaces of a scene."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from simtest.runtime.resources import find
from simtest.spec.relief import Relief
from simtest.spec.spec_model import Curvature, Millimetres, Spec

EdgeLength = Annotated[float, Field(ge=0.01, le=100)]


class _Rough(Spec):
    """A surface that may carry a relief."""

    relief: Relief | None = Field(None, description="fine relief of the surface; default smooth")


class _Placed(_Rough):
    """An analytic surface whose anchor point lies on the optical axis, its normal tilted away from the camera's axis.

    The anchor is (0, 0, distance_mm); at tilt 0 its normal is (0, 0, -1).
    """

    distance_mm: Millimetres = Field(10.0, description="depth of the anchor point on the optical axis, mm")
    tilt_deg: float = Field(0.0, ge=0, lt=90, description="angle between the anchor's normal and the optical axis, deg")
    azimuth_deg: float = Field(
        0.0, ge=-360, le=360, description="image direction towards which the normal leans, deg from x to y"
    )
    spin_deg: float = Field(
        0.0, ge=-360, le=360, description="direction of the first principal direction in the tangent plane, deg"
    )

    @property
    def label(self) -> str:
        """Name of the surface in the results."""
        return str(getattr(self, "type"))  # noqa: B009 - declared by each subclass as a Literal


class PlaneSurface(_Placed):
    """A plane."""

    type: Literal["plane"] = "plane"


class _Round(_Placed):
    radius_mm: Millimetres = Field(10.0, description="radius, mm")
    side: Literal["outside", "inside"] = Field("outside", description="which side the camera is on")

    @model_validator(mode="after")
    def _camera_inside(self) -> "_Round":
        # An inside view from outside the radius would look at the surface's other side.
        if self.side == "inside" and self._camera_from_centre() >= self.radius_mm:
            raise ValueError(
                f"distance_mm = {self.distance_mm:g} puts the camera outside a radius of {self.radius_mm:g} mm; "
                "must be small enough for the camera to lie inside when side is inside"
            )
        return self

    def _camera_from_centre(self) -> float:
        """Return the camera's distance from the centre, mm, for side inside: across the axis for a cylinder."""
        tilt = math.radians(self.tilt_deg)
        return math.hypot(self.radius_mm - self.distance_mm * math.cos(tilt), self._sideways() * math.sin(tilt))

    def _sideways(self) -> float:
        """Return the part of the camera's distance from the anchor, mm, that counts when it is seen aslant."""
        return self.distance_mm


class SphereSurface(_Round):
    """A sphere, seen from outside (k = 1/R) or from inside (k = -1/R)."""

    type: Literal["sphere"] = "sphere"


class CylinderSurface(_Round):
    """A cylinder; at spin 0 it is curved along image x and straight along image y."""

    type: Literal["cylinder"] = "cylinder"

    def _sideways(self) -> float:
        return self.distance_mm * math.cos(math.radians(self.azimuth_deg - self.spin_deg))


class QuadricSurface(_Placed):
    """The quadric patch z = -(k1 x^2 + k2 y^2)/2 over its tangent plane; k1, k2 are the curvatures at the anchor."""

    type: Literal["quadric"] = "quadric"
    k1_per_mm: Curvature = Field(description="curvature along the first principal direction, 1/mm, convex positive")
    k2_per_mm: Curvature = Field(description="curvature along the second principal direction, 1/mm, convex positive")


class AnatomySurface(_Rough):
    """A colon or liver made from a recipe in meshes/, or a mesh that the user names."""

    type: Literal["anatomy"] = "anatomy"
    path: str = Field(min_length=1, description="recipe by name or path (TOML), or a mesh file: PLY, OBJ, STL, VTK")
    kind: Literal["auto", "lumen", "organ"] = Field("auto", description="lumen: camera inside; organ: camera outside")
    seed: int | None = Field(
        None, ge=0, lt=2**32, description="seed of a recipe's irregularities, for another anatomy; default the recipe's"
    )
    recipe: dict[str, Any] = Field(
        default_factory=dict, description="values that replace those of the recipe, by key path"
    )
    viewpoint: int = Field(0, ge=0, le=10**6, description="number of the automatically chosen camera pose")
    subdivisions: int = Field(1, ge=0, le=3, description="Loop subdivisions of a user's mesh")
    edge_mm: EdgeLength | Literal["auto"] | None = Field(
        None,
        description="in place of subdivisions: a user's mesh is subdivided until 95 % of its edges are at most so "
        "long, mm; auto: as highlights of exponent 200 need from the nearest viewpoints",
    )
    smoothing_mm: float | None = Field(
        None,
        ge=0,
        le=100,
        description="wavelength of which fair smoothing leaves half the height, mm; default twice the median edge "
        "with edge_mm, else 0",
    )
    view: Literal["auto", "path", "off_axis", "wall"] = Field(
        "auto",
        description="auto: the pose numbered by viewpoint; in a lumen also path: on the camera path, looking ahead; "
        "off_axis: the same from beside it; wall: on it, looking across",
    )
    path_share: float = Field(0.5, ge=0, le=1, description="position along the camera path, from one end to the other")
    look_ahead_mm: float = Field(
        30.0, ge=1, le=200, description="how far on along the path the camera looks, mm; for path and off_axis"
    )
    around_deg: float = Field(0.0, ge=-360, le=360, description="direction across the path, deg; for off_axis and wall")
    off_axis_share: float = Field(
        0.6, ge=0, le=1, description="how far beside the path, as a share of the room that there is; for off_axis"
    )

    @model_validator(mode="after")
    def _one_fineness(self) -> "AnatomySurface":
        # Its default stands in a scene's dump, too.
        if self.edge_mm is not None and self.subdivisions != 1:
            raise ValueError(
                f"subdivisions = {self.subdivisions} and edge_mm = {self.edge_mm}: only one of them may be given"
            )
        return self

    @property
    def label(self) -> str:
        """Name of the surface in the results."""
        return Path(self.path).stem

    @property
    def recipe_values(self) -> dict[str, Any]:
        """Values that replace those of the recipe, the seed among them."""
        return {**self.recipe, **({} if self.seed is None else {"seed": self.seed})}

    def file(self) -> Path:
        """Return the path of the recipe or mesh; raise `InputError` if there is no such file."""
        return find(self.path, "meshes")


Surface = Annotated[
    PlaneSurface | SphereSurface | CylinderSurface | QuadricSurface | AnatomySurface, Field(discriminator="type")
]
