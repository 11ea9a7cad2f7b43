"""What stands before the camera: surfaces with their relief, how these deform in time, and surgical instruments."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from simtest.runtime.arrays import Array
from simtest.runtime.fitted import fitted_number
from simtest.runtime.resources import find
from simtest.spec.spec_model import Coordinate, Curvature, Millimetres, Share, Spec

MAX_HEIGHT_MM = 0.3
"""Tissue's relief stays below this; higher forms are shape, not relief."""

MAX_DEVIATIONS = 3.0
"""Standard deviations of a gaussian height that are taken as its peak: 99.7 % of the surface stay within."""

PEAK_PER_SLOPE = {"ridged": fitted_number("relief_peak.ridged"), "pits": fitted_number("relief_peak.pits")}

Component = Annotated[float, Field(ge=-1e3, le=1e3)]
Direction = tuple[Component, Component, Component]


class ReliefBand(Spec):
    """One band of wavelengths of the relief, a random field in the space around the surface."""

    directions = ("direction",)

    kind: Literal["gaussian", "ridged", "pits"] = Field(
        "gaussian", description="gaussian; ridged: crests and grooves; pits: a level surface with dimples"
    )
    slope_deg: float = Field(
        gt=0, le=20, description="standard deviation of the slope along one direction (across `direction`), deg"
    )
    wavelength_mm: float = Field(
        ge=0.02, le=20, description="2 pi sqrt(m2/m4) of the spectrum's moments on the surface, across `direction`, mm"
    )
    width: float = Field(0.25, ge=0.05, le=0.5, description="relative width of the band of wave numbers")
    anisotropy: float = Field(1.0, ge=1, le=5, description="wavelength along `direction` over that across it")
    direction: Direction = Field(
        (1.0, 0.0, 0.0), description="along which the relief is drawn out, model frame, any length"
    )


class Relief(Spec):
    """The relief of a surface: the sum of its bands, applied to the normal and not to the position."""

    bands: tuple[ReliefBand, ...] = Field(min_length=1, max_length=4)
    seed: int = Field(0, ge=0, lt=2**32, description="of the random field")
    diffusion_mm: float = Field(
        1.0,
        ge=0,
        le=10,
        description="diffuse light follows the normal of the relief smoothed by a Gaussian of this standard "
        "deviation, mm: it has travelled below the surface",
    )

    @property
    def slope_deg(self) -> float:
        """Standard deviation of the slope of all bands along one direction, deg; bands are independent."""
        return math.hypot(*(band.slope_deg for band in self.bands))

    @model_validator(mode="after")
    def _low(self) -> "Relief":
        # Bands are independent: their variances add.
        height = math.hypot(*(_peak(band) for band in self.bands))
        if height > MAX_HEIGHT_MM:
            raise ValueError(
                f"slopes and wavelengths make a relief of about {height:.2g} mm (99.7 % of its heights stay within); "
                f"must stay below {MAX_HEIGHT_MM:g} mm: lower slope_deg or wavelength_mm"
            )
        return self


def _peak(band: ReliefBand) -> float:
    """Return about what 99.7 % of a band's heights stay within, mm.

    The wave numbers of a gaussian band spread about k0 with the standard deviation w k0. On a section of the isotropic
    field m0 = 1, m2 = 2/3 E k^2 and m4 = 8/15 E k^4, so the height's deviation over slope and wavelength is
    sqrt(m0) / (sqrt(m2/2) 2 pi sqrt(m2/m4)) = sqrt(2.4 E k^4) / (2 pi E k^2).
    """
    w2 = band.width**2
    deviation = math.sqrt(2.4 * (1 + 6 * w2 + 3 * w2**2)) / (2 * math.pi * (1 + w2))
    per_slope = PEAK_PER_SLOPE.get(band.kind, MAX_DEVIATIONS * deviation)
    return per_slope * math.radians(band.slope_deg) * band.wavelength_mm


MOST_DEFORMATIONS = 4

SHORTEST = 1e-6
"""Least length of a direction that is given."""

MAX_STRETCH = 0.9
"""Lipschitz bound that a displacement must stay below.

A map X -> X + u(X) is invertible where u has a Lipschitz constant below 1. The rest keeps its inverse well-conditioned.
"""

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

    lengths: ClassVar[tuple[str, ...]]
    """Names of the lengths over which the displacement varies."""

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
                f"{' or '.join(self.lengths)}"
            )
        return self


class _Centred(_Periodic):
    centre_mm: Point = Field((0.0, 0.0, 0.0), description="point of the model frame, mm")


class Peristalsis(_Centred):
    """Contractions that travel along a straight axis.

    With z along the axis and r the distance from it, points move inward by
    A w(z, t) (r/R) exp((1 - (r/R)^2)/2), w = (1 + cos(2 pi (z/wavelength - t/period)))/2: by A at most, at r = R.
    """

    lengths = ("radius_mm", "wavelength_mm")

    type: Literal["peristalsis"] = "peristalsis"
    axis: Direction = Field(description="along which the waves travel, model frame, any length; through centre_mm")
    radius_mm: Size = Field(description="distance from the axis at which the displacement is largest, mm")
    wavelength_mm: Size = Field(description="distance between contractions along the axis, mm")

    @property
    def stretch(self) -> float:
        """Bound sqrt((A sqrt(e)/R)^2 + (pi A/wavelength)^2): of the parts across the axis and along it."""
        amplitude = abs(self.amplitude_mm)
        return math.hypot(amplitude * math.exp(0.5) / self.radius_mm, math.pi * amplitude / self.wavelength_mm)


class Breathing(_Centred):
    """A slow motion to and fro, with a turn, that does not reach everything alike.

    With s = (1 - cos(2 pi t/period))/2 and b the coordinate along `along` from centre_mm, points move along `direction`
    by A s (1 - warp (1 - cos(2 pi b/wavelength))/2); then all is turned by s turn_deg about `axis`, through centre_mm.
    """

    lengths = ("wavelength_mm",)

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


class Dent(_Centred):
    """The dent of a probe that presses and lets go.

    Points move along `direction` by A s exp(-|X - centre|^2/(2 radius^2)), s = (1 - cos(2 pi t/period))/2.
    """

    lengths = ("radius_mm",)

    type: Literal["dent"] = "dent"
    direction: Direction = Field(description="in which the probe presses, model frame, any length")
    radius_mm: Size = Field(description="standard deviation of the dent, mm")

    @property
    def stretch(self) -> float:
        """Bound A exp(-1/2)/radius: the steepest slope of the Gaussian."""
        return abs(self.amplitude_mm) * math.exp(-0.5) / self.radius_mm


class Contractions(_Periodic):
    """Rings of contraction that travel along a curved path, such as the centreline of a colon with bends.

    Each ring stands across the path. With z along the path's tangent there and r the distance from it, points move
    inward by A (r/R) exp((1 - (r/R)^2 - (z/width)^2)/2): by A at most, at r = R. The rings are `spacing_mm` apart, move
    on by as much in each period, and grow and fade within half of it from the path's ends. The maps of the rings are
    applied one after the other, so rings that overlap at a bend do not fold space.
    """

    lengths = ("radius_mm", "width_mm")

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


Deformation = Annotated[Peristalsis | Breathing | Dent | Contractions, Field(discriminator="type")]


DEFAULT_DEPTH_SHARE = 0.8
"""Where a tip is that has neither depth: clear of the tissue, and near it."""

_OF_GRASPERS = ("jaw_mm", "opening_deg", "roll_deg")

PictureShare = Annotated[float, Field(ge=-0.5, le=1.5)]
Angle = Annotated[float, Field(ge=-360, le=360)]


class Instrument(Spec):
    """A metal shaft or grasper, placed in the camera frame.

    The tip is seen at a share of the picture. From there the shaft leaves the picture along `azimuth_deg`, and comes
    towards the camera by `tilt_deg`.
    """

    exclusive = (("depth_mm", "depth_share"),)

    kind: Literal["shaft", "grasper"] = Field("shaft", description="a round shaft, or one with a wrist and two jaws")
    present: bool = Field(True, description="whether it is in the picture: a dataset draws in how many frames it is")
    diameter_mm: float = Field(5.0, ge=1, le=20, description="of the shaft, mm; usual are 5 and 10")
    tip: tuple[PictureShare, PictureShare] = Field(
        (0.5, 0.5), description="where the tip is seen, shares of the picture's width and height from its upper left"
    )
    depth_mm: Millimetres | None = Field(None, description="distance of the tip along its sightline, mm")
    depth_share: float | None = Field(
        None,
        gt=0,
        le=2,
        description="the same as a share of the surface's distance there, beyond which the surface hides it; default "
        f"{DEFAULT_DEPTH_SHARE:g}",
    )
    azimuth_deg: Angle = Field(
        0.0, description="direction in which the shaft leaves the tip, across the optical axis, deg from x to y"
    )
    tilt_deg: float = Field(20.0, ge=-80, le=80, description="by which the shaft comes towards the camera, deg")
    length_mm: float = Field(300.0, ge=10, le=2000, description="from the tip to the shaft's end, out of the picture")
    jaw_mm: float | None = Field(
        None, gt=0, le=60, description="of a grasper: length of its jaws, mm; default 3 diameters"
    )
    opening_deg: float | None = Field(
        None, ge=0, le=90, description="of a grasper: angle between its jaws, deg; default 30"
    )
    roll_deg: Angle | None = Field(
        None,
        description="of a grasper: turn of the jaws about the shaft, deg; default 0, where they open across the "
        "optical axis",
    )
    alpha: float = Field(0.15, ge=0.02, le=1, description="GGX roughness of the metal")
    metal: tuple[Share, Share, Share] = Field(
        (0.62, 0.59, 0.56), description="reflectance of the metal at normal incidence, linear RGB"
    )
    diffuse: Share = Field(
        0.1, description="share of a matt base that is blended in: scratches, and the tissue that the metal mirrors"
    )
    colour: tuple[Share, Share, Share] = Field((0.6, 0.52, 0.5), description="linear RGB albedo of the matt base")

    @model_validator(mode="after")
    def _possible(self) -> "Instrument":
        for name in _OF_GRASPERS if self.kind == "shaft" else ():
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: belongs to a grasper; must be left out where kind is shaft")
        if self.length_mm < self.head_mm + 2 * self.diameter_mm:
            raise ValueError(
                f"length_mm = {self.length_mm:g}: must be at least {self.head_mm + 2 * self.diameter_mm:g} with "
                f"diameter_mm = {self.diameter_mm:g}"
            )
        return self

    @property
    def jaw_length_mm(self) -> float:
        """Length of a grasper's jaws, mm; 0 for a shaft."""
        if self.kind == "shaft":
            return 0.0
        return 3 * self.diameter_mm if self.jaw_mm is None else self.jaw_mm

    @property
    def head_mm(self) -> float:
        """Length before the shaft, mm: jaws and wrist."""
        return 0.0 if self.kind == "shaft" else self.jaw_length_mm + 1.2 * self.diameter_mm

    @property
    def back(self) -> Array:
        """Unit vector from the tip along the shaft, shape (3,), camera frame."""
        azimuth, tilt = math.radians(self.azimuth_deg), math.radians(self.tilt_deg)
        across = math.cos(tilt)
        return np.array([across * math.cos(azimuth), across * math.sin(azimuth), -math.sin(tilt)])

    @property
    def side(self) -> Array:
        """Unit vector across the shaft towards which a grasper's first jaw opens, shape (3,), camera frame."""
        azimuth, roll = math.radians(self.azimuth_deg), math.radians(self.roll_deg or 0.0)
        level = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        return np.asarray(math.cos(roll) * level + math.sin(roll) * np.cross(self.back, level))


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
