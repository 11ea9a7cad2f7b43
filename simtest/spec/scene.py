"""The scene: surface, reflectance, rig, camera, sensor and rendering effort (design.md's `spec`)."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.resources import find
from simtest.spec.reading import Spec, apply_settings, place, read_toml, validate

Share = Annotated[float, Field(ge=0, le=1)]
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
Millimetres = Annotated[float, Field(ge=1e-3, le=1e6)]
Curvature = Annotated[float, Field(ge=-10, le=10)]


class _Placed(Spec):
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
        if self.side == "inside" and self._camera_from_centre() >= self.radius_mm:
            raise ValueError(
                f"distance_mm = {self.distance_mm:g} puts the camera outside a radius of {self.radius_mm:g} mm; "
                "must be small enough for the camera to lie inside when side is inside"
            )
        return self

    def _camera_from_centre(self) -> float:
        """Distance of the camera from the centre, for side inside, mm: across the axis for a cylinder."""
        tilt = math.radians(self.tilt_deg)
        return math.hypot(self.radius_mm - self.distance_mm * math.cos(tilt), self._sideways() * math.sin(tilt))

    def _sideways(self) -> float:
        """Part of the camera's distance from the anchor that counts when it is seen aslant, mm."""
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


class AnatomySurface(Spec):
    """A colon or liver made from a recipe in meshes/, or a mesh that the user names."""

    type: Literal["anatomy"] = "anatomy"
    path: str = Field(min_length=1, description="recipe by name or path (TOML), or a mesh file: PLY, OBJ, STL, VTK")
    kind: Literal["auto", "lumen", "organ"] = Field("auto", description="lumen: camera inside; organ: camera outside")
    viewpoint: int = Field(0, ge=0, le=10**6, description="number of the automatically chosen camera pose")
    subdivisions: int = Field(1, ge=0, le=3, description="Loop subdivisions of a user's mesh")

    @property
    def label(self) -> str:
        """Name of the surface in the results."""
        return Path(self.path).stem

    def file(self) -> Path:
        """Give the recipe's or mesh's file; raise `InputError` where there is none."""
        return find(self.path, "meshes")


Surface = Annotated[
    PlaneSurface | SphereSurface | CylinderSurface | QuadricSurface | AnatomySurface, Field(discriminator="type")
]


class _Reflectance(Spec):
    diffuse: Share = Field(0.0, description="share of the diffuse base, its albedo")
    colour: tuple[Share, Share, Share] = Field((1.0, 1.0, 1.0), description="linear RGB colour of the diffuse base")


class PhongReflectance(_Reflectance):
    """Phong: specular c cos^n(beta) as published, or the energy-conserving form."""

    type: Literal["phong"] = "phong"
    exponent: float = Field(50.0, gt=0, le=1e5, description="roughness exponent n")
    specular: float = Field(1.0, ge=0, le=1e6, description="scale c of the specular lobe")
    normalised: bool = Field(False, description="energy-conserving form: (n + 2)/(2 pi) cos^n(beta) cos(theta)")


class RoughPlasticReflectance(_Reflectance):
    """Mitsuba's rough plastic, GGX."""

    type: Literal["rough_plastic"] = "rough_plastic"
    alpha: float = Field(0.15, gt=0, le=1, description="GGX roughness")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")


class PrincipledReflectance(_Reflectance):
    """Mitsuba's principled material, not metallic."""

    type: Literal["principled"] = "principled"
    roughness: float = Field(0.3, gt=0, le=1, description="roughness (alpha is its square)")
    diffuse: Share = Field(0.5, description="share of the diffuse base, its albedo")


class RoughConductorReflectance(_Reflectance):
    """Mitsuba's rough conductor, GGX, blended with a diffuse base by its share."""

    type: Literal["rough_conductor"] = "rough_conductor"
    alpha: float = Field(0.2, gt=0, le=1, description="GGX roughness")


Reflectance = Annotated[
    PhongReflectance | RoughPlasticReflectance | PrincipledReflectance | RoughConductorReflectance,
    Field(discriminator="type"),
]


class LightSpec(Spec):
    """An isotropic point light, placed in the camera frame.

    Its place is `position_mm`, or `offset_mm` from the camera centre along `azimuth_deg` in the plane z = 0.
    """

    position_mm: tuple[Coordinate, Coordinate, Coordinate] | None = Field(
        None, description="place in the camera frame, mm"
    )
    offset_mm: float = Field(0.0, ge=0, le=1e6, description="distance from the camera centre, mm")
    azimuth_deg: float = Field(0.0, ge=-360, le=360, description="direction of the offset, deg from x to y")
    power: float = Field(1.0, gt=0, le=1e12, description="radiant intensity, relative")

    @model_validator(mode="after")
    def _one_way(self) -> "LightSpec":
        if self.position_mm is not None and self.model_fields_set & {"offset_mm", "azimuth_deg"}:
            raise ValueError("position_mm and offset_mm exclude each other; give one of them")
        return self

    @property
    def place_mm(self) -> tuple[float, float, float]:
        """Position in the camera frame, mm."""
        if self.position_mm is not None:
            return self.position_mm
        angle = math.radians(self.azimuth_deg)
        return (self.offset_mm * math.cos(angle), self.offset_mm * math.sin(angle), 0.0)


class Rig(Spec):
    """The lights that travel with the camera."""

    lights: tuple[LightSpec, ...] = Field((LightSpec(),), min_length=1, max_length=32)


class CameraSpec(Spec):
    """A pinhole camera; pixel centres at integer + 0.5."""

    width: int = Field(406, ge=1, le=16384, description="px")
    height: int = Field(406, ge=1, le=16384, description="px")
    fx: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along x, px")
    fy: float = Field(406.0, ge=1e-3, le=1e6, description="focal length along y, px")
    cx: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, px; default the image's centre")
    cy: float | None = Field(None, ge=-1e6, le=1e6, description="principal point, px; default the image's centre")
    skew: float = Field(0.0, ge=-1e6, le=1e6, description="px")

    def model(self) -> Camera:
        """Give the camera as the geometry package uses it."""
        cx = self.width / 2 if self.cx is None else self.cx
        cy = self.height / 2 if self.cy is None else self.cy
        return Camera(self.width, self.height, self.fx, self.fy, cx, cy, self.skew)


class Sensor(Spec):
    """Noise of the frame."""

    noise_sigma: float = Field(0.0, ge=0, le=1, description="standard deviation of the noise, share of full scale")
    seed: int = Field(0, ge=0, lt=2**63, description="seed of the noise; experiments draw one for each realisation")


class Effort(Spec):
    """How much is traced."""

    samples_per_pixel: int = Field(1, ge=1, le=4096, description="1: one ray through the pixel's centre")
    path_depth: int = Field(2, ge=2, le=64, description="2: direct light; more adds inter-reflections")
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the samples")


class Scene(Spec):
    """Everything that determines a rendered frame."""

    name: str = Field("scene", min_length=1, max_length=80)
    surface: Surface
    reflectance: Reflectance = PhongReflectance()
    rig: Rig = Rig()
    camera: CameraSpec = CameraSpec()
    sensor: Sensor = Sensor()
    render: Effort = Effort()


def scene_from_dict(data: Mapping[str, Any], where: str = "scene") -> Scene:
    """Validate a scene given as nested tables.

    Parameters
    ----------
    data : mapping
        The tables of a scene file.
    where : str
        Name for messages.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If the data do not fit the schema.
    """
    return validate(Scene, data, where)


def load_scene(name: str | Path, settings: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    name : str or Path
        A path, or the name of a shipped scene.
    settings : mapping, optional
        Values that replace those of the file, by key path.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    path = find(name, "scenes")
    data = apply_settings(read_toml(path), settings or {}, str(path))
    data.setdefault("name", path.stem[:80])
    return scene_from_dict(data, place(path, settings or {}))


def load_camera(path: str | Path) -> Camera:
    """Read a camera file: a TOML table with the keys of `CameraSpec`, at top level or under ``[camera]``.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    Camera

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    data = read_toml(Path(path))
    table = data.get("camera", data)
    missing = [key for key in ("width", "height", "fx", "fy") if not isinstance(table, Mapping) or key not in table]
    if missing:
        raise InputError(f"{path}: {missing[0]}: missing; a camera needs width, height, fx, fy")
    return validate(CameraSpec, table, str(path)).model()
