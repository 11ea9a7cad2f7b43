"""The scene: surface, reflectance, rig, camera, sensor and rendering effort."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from simtest.calibration import Calibration, NoiseModel, Normal, Priors, Response, exactly
from simtest.calibration.photometry import AngularProfile
from simtest.calibration.priors import NO_FLOORS, OF_PICTURES, UNTOLD_FALLOFF_POWER, Floors
from simtest.errors import InputError
from simtest.runtime.arrays import short_repr
from simtest.runtime.boundary import plain_errors
from simtest.runtime.files import check_limit
from simtest.runtime.resources import find
from simtest.spec.camera import SceneCamera, Views
from simtest.spec.camera_formats.common import read_json
from simtest.spec.keys import replace_values
from simtest.spec.lights import Rig
from simtest.spec.reflectance import (
    Patches,
    PhongReflectance,
    Reflectance,
    TissueColour,
    TissueReflectance,
    Translucency,
)
from simtest.spec.sensor import Overlay, Sensor
from simtest.spec.spec_model import UNSAID, Millimetres, Spec, validate
from simtest.spec.surfaces import MOST_DEFORMATIONS, Deformation, Instrument, Surface
from simtest.spec.toml_files import as_settings, read_toml, source_name

MOST_INSTRUMENTS = 8
"""More than a patient has ports for."""


class Effort(Spec):
    """How much is traced."""

    samples_per_pixel: int = Field(1, ge=1, le=4096, description="1: one ray through the pixel's centre")
    path_depth: int = Field(2, ge=2, le=64, description="2: direct light; more adds inter-reflections")
    ambient: bool = Field(
        False,
        description="whether walls send diffuse light back to each other: an estimate without shadows between them",
        **UNSAID,
    )
    seed: int = Field(0, ge=0, lt=2**32, description="seed of the samples")
    adaptive: bool = Field(
        True,
        description="of 4 samples or more: whether pixels whose mean follows from the rays through the centres around "
        "them get no samples; it errs less than samples do",
    )

    @model_validator(mode="after")
    def _bounce_once(self) -> "Effort":
        if self.ambient and self.path_depth > 2:
            raise ValueError(f"path_depth = {self.path_depth}: traces what ambient estimates; must be 2 with ambient")
        return self


class KnownSpec(Spec):
    """What estimators are told beside the picture and the camera's calibration."""

    exclusive = (("distance_mm", "distance_error"),)

    lights: bool = Field(True, description="whether they are told the lights' nominal positions")
    lobe: bool = Field(
        True,
        description="whether they are told the width of a lobe that has one: Phong's exponent, a Beckmann film's alpha",
    )
    distance_mm: Millimetres | None = Field(None, description="working distance that they are told, mm")
    distance_error: float | None = Field(
        None,
        gt=-1,
        le=10,
        description="they are told the distance of the brightest true highlight, off by this share of it; "
        "default not told",
    )
    distance_sd: float = Field(
        0.0, ge=0, le=10, description="standard deviation that they are told, share of the told distance"
    )


class Scene(Spec):
    """Everything that determines a rendered frame.

    Examples
    --------
    >>> import simtest
    >>> scene = simtest.load_scene("cylinder")
    >>> scene.surface.radius_mm, scene.reflectance.exponent
    (10.0, 50.0)
    """

    name: str = Field("scene", min_length=1, max_length=80)
    surface: Surface
    reflectance: Reflectance = PhongReflectance()
    rig: Rig = Rig()
    camera: SceneCamera = SceneCamera()
    sensor: Sensor = Sensor()
    render: Effort = Effort()
    known: KnownSpec = KnownSpec()
    instruments: tuple[Instrument, ...] = Field(
        (), max_length=MOST_INSTRUMENTS, description="metal instruments in the picture, in the camera frame", **UNSAID
    )
    deformation: tuple[Deformation, ...] = Field(
        (), max_length=MOST_DEFORMATIONS, description="how the surface deforms in time, applied in this order", **UNSAID
    )
    time_s: float = Field(0.0, ge=-1e6, le=1e6, description="moment of the deformation, s", **UNSAID)
    views: Views | None = Field(None, description="further views, for an experiment on motion; default none", **UNSAID)

    __repr__ = short_repr
    __str__ = short_repr

    @property
    def shown_instruments(self) -> dict[int, Instrument]:
        """The instruments that are present, by their index in `instruments`."""
        return {i: instrument for i, instrument in enumerate(self.instruments) if instrument.present}

    @property
    def placement(self) -> tuple[object, ...]:
        """What determines the surface and the camera's place before it."""
        return self.surface, self.film_level, self.film_patches, self.camera.moved, self.deformation, self.time_s

    @property
    def film_level(self) -> float | None:
        """Up to where a liquid film fills the valleys of the relief, in standard deviations of its height."""
        return self.reflectance.film.level if isinstance(self.reflectance, TissueReflectance) else None

    @property
    def film_patches(self) -> Patches | None:
        """How that level varies over the surface; None where it does not."""
        return self.reflectance.film.patches if isinstance(self.reflectance, TissueReflectance) else None

    @property
    def translucency(self) -> Translucency | None:
        """How diffuse light spreads below the surface; None where it leaves where it entered."""
        return self.reflectance.translucency if isinstance(self.reflectance, TissueReflectance) else None

    @model_validator(mode="after")
    def _affordable(self) -> "Scene":
        width, height, samples = self.camera.width, self.camera.height, self.render.samples_per_pixel
        what = f"camera.width = {width}, camera.height = {height}"
        check_limit("frame_pixels", width * height, what, "px")
        what += f", render.samples_per_pixel = {samples}"
        check_limit("frame_samples", width * height * samples, what, "rays a frame")
        return self

    @model_validator(mode="after")
    def _has_valleys(self) -> "Scene":
        if self.film_level is not None and self.surface.relief is None:
            raise ValueError(
                f"reflectance.film.level = {self.film_level:g}: there are no valleys to fill; must be left out where "
                "surface.relief is not given"
            )
        return self

    @model_validator(mode="after")
    def _lights_instruments(self) -> "Scene":
        if self.shown_instruments and self.render.path_depth > 2:
            raise ValueError(
                f"render.path_depth = {self.render.path_depth}: light that bounces is not traced between instruments "
                "and tissue; must be 2 where instruments are present"
            )
        return self

    @property
    def albedo(self) -> TissueColour | None:
        """The colour of the tissue, where the albedo varies over the surface."""
        return getattr(self.reflectance, "albedo", None)

    @property
    def is_coloured(self) -> bool:
        """Whether it takes three channels: the colour of tissue, or a base, light or instrument that is not grey."""
        colours = [self.reflectance.colour, *(light.colour for light in self.rig.lights)]
        for instrument in self.shown_instruments.values():
            colours += [instrument.metal, instrument.colour]
        painted = self.albedo is not None or self.sensor.fringe is not None
        return painted or any(len(set(colour)) > 1 for colour in colours)

    @property
    def is_covered(self) -> bool:
        """Whether debris lies on the tissue, or something is drawn over it."""
        drawn = self.sensor.overlay or Overlay()
        return bool(drawn.captions or drawn.boxes or drawn.insets or (self.albedo and self.albedo.debris))

    def calibration(self, distance_mm: float | None = None) -> Calibration:
        """Return what reconstruction knows of the scene's camera, sensor, lights and surface.

        See the keys ``sensor.*_known``, ``rig.emission_known`` and ``known``. White noise is not part of it: it is
        estimated from each frame.

        Parameters
        ----------
        distance_mm : float, optional
            True distance of the brightest highlight, mm, to which ``known.distance_error`` is relative.
        """
        # What is not known is assumed to be linear and uniform.
        sensor, emission = self.sensor, self.rig.known_emission()
        response = sensor.response.model() if sensor.response_known else Response()
        return Calibration(
            self.camera.model(),
            response=response,
            vignetting=sensor.vignetting.model() if sensor.vignetting_known else AngularProfile(),
            emission=emission.model() if emission else AngularProfile(),
            noise=NoiseModel(0.0, sensor.full_well, sensor.read_noise, sensor.bits, response),
            saturation_level=1.0 if sensor.clips else None,
            priors=self._priors(distance_mm),
        )

    def _priors(self, distance_mm: float | None) -> Priors:
        mean = self.known.distance_mm
        # distance, off by a stated share of the truth
        if self.known.distance_error is not None and distance_mm is not None:
            mean = distance_mm * (1 + self.known.distance_error)
        # lobe, where one number states it
        curvature = self.reflectance.lobe_curvature if self.known.lobe else None
        # A falloff that they are not told is still in the frame.
        emitted = self.rig.known_emission() is not None or all(light.is_isotropic for light in self.rig.lights)
        told = self.sensor.vignetting_known and self.rig.emission_known and emitted
        # On a relief as steep as near misses are off any highlight may be one, however few there are.
        relief = self.surface.relief
        steep = relief is not None and math.radians(relief.slope_deg) > OF_PICTURES.near_miss_sd
        return Priors(
            tuple(light.nominal_mm for light in self.rig.lights) if self.known.lights else (),
            None if mean is None else Normal(mean, mean * self.known.distance_sd),
            None if curvature is None else exactly(curvature),
            falloff_power=None if told else UNTOLD_FALLOFF_POWER,
            floors=Floors(near_miss_sd=OF_PICTURES.near_miss_sd) if steep else NO_FLOORS,
        )


def scene_from_dict(data: Mapping[str, Any], where: str = "scene") -> Scene:
    """Validate a scene given as nested tables; `where` names it in the `InputError` if they do not fit the schema."""
    return validate(Scene, data, where)


PRESETS: tuple[tuple[str, type[Spec]], ...] = (("sensor", Sensor), ("reflectance.albedo", TissueColour))
"""Tables whose key ``preset`` gives numbers of theirs."""


def without_presets(data: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the dump of a scene without the numbers of the presets that settings replace.

    A dump names all numbers, those of a preset too, which would stand over those of another.
    """
    left = dict(data)
    for path, model in PRESETS:
        *parents, name = path.split(".")
        table = left.get(parents[0], {}) if parents else left
        if f"{path}.preset" in settings and isinstance(given := table.get(name), Mapping):
            plain = validate(model, {"preset": given["preset"]} if given.get("preset") else {}, path)
            kept = _differing(given, plain.model_dump(mode="json"))
            left = {**left, parents[0]: {**table, name: kept}} if parents else {**left, name: kept}
    return left


def _differing(table: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a table differs from another, and its type."""
    both = {key: (value, other.get(key)) for key, value in table.items()}
    return {
        key: _differing(value, twin) if isinstance(value, dict) and isinstance(twin, dict) else value
        for key, (value, twin) in both.items()
        if key == "type" or value != twin or key not in other
    }


@plain_errors
def load_scene(name: str | Path, settings: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    name : str or Path
        A path, or the name of a shipped scene; of JSON, such as a dataset's sample or frame.json, the key ``scene``.
    settings : mapping, optional
        Values that replace those of the file, by key path; a new type of a table drops the keys of the former one.

    Raises
    ------
    InputError
        If the file is missing or malformed.

    Examples
    --------
    >>> import simtest
    >>> simtest.load_scene("cylinder", {"surface.radius_mm": 5.0}).surface.radius_mm
    5.0
    """
    path, values = find(name, "scenes"), as_settings(settings)
    tables = _tables(path)
    if path.suffix.lower() == ".json":
        tables = without_presets(tables, values)
    data = replace_values(Scene, tables, values, str(path))
    data.setdefault("name", path.stem[:80])
    return scene_from_dict(data, source_name(path, settings))


def _tables(path: Path) -> dict[str, Any]:
    """Return the tables of a scene file, or those under ``scene`` in a JSON file."""
    if path.suffix.lower() != ".json":
        return read_toml(path)
    scene = read_json(path, "scene").get("scene")
    if not isinstance(scene, dict):
        raise InputError(f"{path}: scene: must be a table, as in a dataset's sample or in frame.json")
    return scene
