"""The tables of a calibration file: a camera with its response, falloff, noise and priors; and the way back."""

import math
from collections.abc import Iterator
from dataclasses import astuple, fields, is_dataclass, replace
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from simtest.calibration import (
    Calibration,
    CameraPrior,
    Distribution,
    NoiseModel,
    Normal,
    Priors,
    Response,
    Uniform,
    exactly,
)
from simtest.calibration.calibration import OPTICAL_AXIS
from simtest.calibration.photometry import AngularProfile
from simtest.calibration.priors import (
    OF_PICTURES,
    UNTOLD_FALLOFF_POWER,
    UNTOLD_OFFSET_MM,
    UNTOLD_SLOPE_RAD,
    Floors,
    Matrix,
    check_light_covariances,
)
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.spec.camera import CameraSpec
from simtest.spec.camera_tables import camera_table
from simtest.spec.lights import CosineProfile, Profile, TableProfile
from simtest.spec.sensor import Bits, FullWell, ReadNoise, ResponseSpec, check_electrons
from simtest.spec.spec_model import Millimetres, Spec, validate
from simtest.spec.toml_files import toml_tables

Bound = Annotated[float, Field(ge=0, le=1e6)]
Interval = tuple[Bound, Bound]
"""Ends of a uniform distribution; equal ones are an exact value."""


def _check_interval(name: str, interval: Interval | float | None, above: float | None = None) -> None:
    """Raise `ValueError` where the ends of an interval are not in order, or the lower one is not more than `above`."""
    if not isinstance(interval, tuple):
        return
    low, high = interval
    if low > high or (above is not None and low <= above):
        least = "" if above is None else f" above {above:g}"
        raise ValueError(f"{name} = [{low:g}, {high:g}]: must be a lower and an upper end{least}, in this order")


class SensorCalibration(Spec):
    """What is known of the sensor's noise and range."""

    noise_sigma: float = Field(
        0.0,
        ge=0,
        le=1,
        description="standard deviation of white noise, share of full scale, at least; default as the frame shows",
    )
    full_well: FullWell | None = Field(None, description="electrons at full scale")
    read_noise: ReadNoise = Field(0.0, description="standard deviation, electrons")
    bits: Bits | None = Field(None, description="of the values")
    saturation_level: float | None = Field(
        None, gt=0, le=1e6, description="value, share of the largest, at and above which a pixel counts as clipped"
    )

    @model_validator(mode="after")
    def _electrons(self) -> "SensorCalibration":
        check_electrons(self.full_well, self.read_noise)
        return self


LightCoordinate = Annotated[float, Field(ge=-1000.0, le=1000.0)]
"""mm; lights of an endoscope, or of a bench, are no farther from its camera."""


class RigCalibration(Spec):
    """What is known of the lights and of the working distance."""

    exclusive = (("distance_range_mm", "distance_mm"), ("light_offset_mm", "lights_mm"))

    lights_mm: tuple[tuple[LightCoordinate, LightCoordinate, LightCoordinate], ...] = Field(
        (), max_length=32, description="positions of the lights, camera frame, mm; default not known"
    )
    lights_covariance_mm2: tuple[Matrix, ...] = Field(
        (),
        max_length=32,
        description="covariance of each light's position, a 3 x 3 matrix a light, mm^2, as `simtest calibrate light` "
        "writes it; default: as `uncertainty.light_floor_mm` has them",
    )
    distance_mm: Millimetres | None = Field(
        None, description="working distance along the sightline, mm: measured, or the middle of what is expected"
    )
    distance_sd_mm: float = Field(0.0, ge=0, le=1e6, description="standard deviation of the true distance, mm")
    distance_range_mm: Interval | None = Field(
        None, description="instead of distance_mm: the working distance lies anywhere in between, mm; default [5, 80]"
    )
    light_offset_mm: Interval | None = Field(
        None,
        description="where lights_mm is not known: a light lies this far from the camera, anywhere in between, across "
        "the optical axis, mm; default [0, 6]",
    )

    @model_validator(mode="after")
    def _about_a_distance(self) -> Self:
        if self.distance_sd_mm > 0 and self.distance_mm is None:
            raise ValueError(f"distance_sd_mm = {self.distance_sd_mm:g}: needs distance_mm")
        check_light_covariances(self.lights_covariance_mm2, len(self.lights_mm))
        _check_interval("distance_range_mm", self.distance_range_mm, above=0.0)
        _check_interval("light_offset_mm", self.light_offset_mm)
        return self


Floor = Annotated[float | None, Field(ge=0, le=100)]
"""A least standard deviation; none below it is reported of a picture, whatever else is given."""

FLOORS = {
    "light_sd_mm": ("light_floor_mm", None), "light_sd": ("light_floor_deg", "deg"),
    "distance_sd": ("distance_floor", None), "feature_sd": ("feature_floor_deg", "deg"),
    "response_sd": ("response_floor", None), "near_miss_sd": ("near_miss_floor_deg", "deg"),
    "off_peak": ("off_peak", None),
}  # fmt: skip
"""Key and unit of each number of `Floors`."""


class UncertaintyCalibration(Spec):
    """How far what the other tables state may be off."""

    focal_sd: float = Field(0.0, ge=0, le=1, description="standard deviation of the focal length, share of it")
    centre_sd_px: float = Field(0.0, ge=0, le=1e6, description="standard deviation of the principal point an axis, px")
    distortion_sd: float = Field(
        0.0, ge=0, le=10, description="standard deviation of the radial distortion k1, about the camera's or none"
    )
    edge_reach: float = Field(
        0.0,
        ge=0,
        le=10,
        description="distance from the principal point, focal lengths, at which a lens of another k1 images alike, as "
        "the edge of a given field of view; default 0, the principal point",
    )
    falloff_power: Interval | None = Field(
        None,
        description="a falloff cos^k over the angle from the optical axis is left in the frame, k anywhere in between; "
        "default none where vignetting and emission are both given (power = 0 where it is uniform) and an emission "
        "that is not uniform has no lights_mm beside the camera; else [0, 4]",
    )
    light_floor_mm: Floor = Field(
        None, description="of a light without lights_covariance_mm2, an axis, mm; default in pictures 0.2"
    )
    light_floor_deg: Floor = Field(None, description="the same as seen from the camera, deg; default in pictures 0.5")
    distance_floor: Floor = Field(None, description="of a given distance, share of it; default in pictures 0.03")
    feature_floor_deg: Floor = Field(
        None, description="of the normal by features finer than a pixel, an axis, deg; default in pictures 0.4"
    )
    response_floor: Floor = Field(
        None, description="of a highlight's centre by the response, share of its size; default in pictures 0.05"
    )
    near_miss_floor_deg: Floor = Field(
        None,
        description="of the normal by near misses in a picture of few highlights, an axis, deg, where a highlight is "
        "as high as the diffuse light beside it; default in pictures 2.9",
    )
    off_peak: Floor = Field(
        None,
        description="an answer that looks farther off its peak than this share of its highlight's size is given at the "
        "peak or refused; default in pictures 0.05, 0: none is",
    )

    @property
    def floors(self) -> Floors | None:
        """The floors, those that are not given as in pictures; None where none is."""
        given = {
            name: value if unit is None else math.radians(value)
            for name, (key, unit) in FLOORS.items()
            if (value := getattr(self, key)) is not None
        }
        return replace(OF_PICTURES, **given) if given else None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check_interval("falloff_power", self.falloff_power)
        return self


class SurfaceCalibration(Spec):
    """What is known of the surface's lobe and relief."""

    exclusive = (("phong_exponent", "lobe_curvature"),)

    phong_exponent: float | None = Field(None, gt=0, le=1e5, description="roughness exponent n; default not known")
    lobe_curvature: float | None = Field(
        None,
        gt=0,
        le=1e9,
        description="instead of phong_exponent: -(log f)'' of the lobe f where normal and view agree, rad^-2",
    )
    relief_slope_deg: Annotated[float, Field(ge=0, le=45)] | Interval | None = Field(
        None,
        description="slope of the relief an axis, deg: a number, or the interval that it lies in; default [3, 20]",
    )

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        _check_interval("relief_slope_deg", self.relief_slope_deg)
        return self


Direction = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Emission(Spec):
    """Where an emission's axis points."""

    directions = ("direction",)

    direction: tuple[Direction, Direction, Direction] = Field(
        OPTICAL_AXIS, description="in which the light shines, camera frame, any length; default the optical axis"
    )

    @property
    def axis(self) -> tuple[float, float, float]:
        """The direction as a unit vector."""
        length = math.hypot(*self.direction)
        # A unit vector keeps its digits, so that what is written reads back the same.
        x, y, z = self.direction if math.isclose(length, 1, abs_tol=1e-12) else (v / length for v in self.direction)
        return (x, y, z)


class CosineEmission(_Emission, CosineProfile):
    """cos^power of the angle from the direction in which the light shines."""


class TableEmission(_Emission, TableProfile):
    """A table over the angle from the direction in which the light shines."""


class CalibrationSpec(Spec):
    """A calibration file; all tables but the camera may be left out."""

    camera: CameraSpec
    response: ResponseSpec | None = Field(None, description="how light became values; default: not stated")
    vignetting: Profile = Field(
        CosineProfile(), description="share of the light that the lens passes, over the angle from the optical axis"
    )
    emission: Annotated[CosineEmission | TableEmission, Field(discriminator="type")] = Field(
        CosineEmission(), description="of a light at the camera, over the angle from the direction in which it shines"
    )
    sensor: SensorCalibration = SensorCalibration()
    rig: RigCalibration = RigCalibration()
    surface: SurfaceCalibration = SurfaceCalibration()
    uncertainty: UncertaintyCalibration = UncertaintyCalibration()

    def calibration(self, camera: Camera) -> Calibration:
        """Return a camera with all that the file states beside it; the camera's own table has been read before."""
        # A response that is not stated counts as linear in the noise model, but stays unknown in the calibration.
        response = self.response.model() if self.response is not None else None
        sensor = self.sensor
        noise = NoiseModel(sensor.noise_sigma, sensor.full_well, sensor.read_noise, sensor.bits, response or Response())
        falloff = (self.vignetting.model(), self.emission.model())
        level, axis = sensor.saturation_level, self.emission.axis
        made = Calibration(camera, response, *falloff, noise, level, self.priors(), axis)
        # None is left in the frame where both of its parts are given and undone.
        known = {"vignetting", "emission"} <= self.model_fields_set and made.is_emission_undone
        if known and self.uncertainty.falloff_power is None:
            made = replace(made, priors=replace(made.priors, falloff_power=None))
        return made

    def priors(self) -> Priors:
        """Return the priors on lights, distance, lobe, camera, falloff and relief."""
        rig, surface, told = self.rig, self.surface, self.uncertainty
        distance = _distribution(rig.distance_range_mm)
        if rig.distance_mm is not None:
            distance = Normal(rig.distance_mm, rig.distance_sd_mm)
        lobe = None if surface.lobe_curvature is None else exactly(surface.lobe_curvature)
        if surface.phong_exponent is not None:
            # Imported here: the reflectances are slower to load than the whole calibration.
            from simtest.spec.reflectance import PhongReflectance

            lobe = exactly(PhongReflectance(exponent=surface.phong_exponent).lobe_curvature)
        slope = surface.relief_slope_deg
        slopes = (slope, slope) if isinstance(slope, float) else slope
        return Priors(
            rig.lights_mm,
            distance,
            lobe,
            light_offset_mm=_distribution(rig.light_offset_mm) or UNTOLD_OFFSET_MM,
            camera=CameraPrior(told.focal_sd, told.centre_sd_px, told.distortion_sd, told.edge_reach),
            falloff_power=_distribution(told.falloff_power) or UNTOLD_FALLOFF_POWER,
            relief_slope=_distribution(slopes, math.radians(1.0)) or UNTOLD_SLOPE_RAD,
            lights_covariance_mm2=rig.lights_covariance_mm2,
            floors=told.floors,
        )


def _distribution(interval: Interval | None, unit: float = 1.0) -> Distribution | None:
    """Return the uniform distribution over an interval, or the exact value of one without length."""
    if interval is None:
        return None
    low, high = interval
    return exactly(low * unit) if low == high else Uniform(low * unit, high * unit)


Tables = dict[str, dict[str, Any]]

HEADER = "# What is known of a camera, its light and its tissue; pixel centres at integer + 0.5, camera frame.\n"

CLOSE = 1e-14
"""Relative rounding of an angle between radians and degrees."""


def calibration_toml(calibration: Calibration, note: str = "") -> str:
    """Return a calibration as the text of a calibration file, after a line of comment.

    Raises
    ------
    InputError
        If it holds what a calibration file cannot state, such as a log-uniform distance.
    """
    tables = calibration_tables(calibration)
    _check_read_back(calibration, tables)
    return f"{HEADER}{note and f'# {note}{chr(10)}'}\n{toml_tables(tables)}"


def calibration_tables(calibration: Calibration) -> Tables:
    """Return a calibration as the tables that `CalibrationSpec` reads; what it does not know is left out."""
    priors, noise = calibration.priors, calibration.noise
    tables: Tables = {"camera": camera_table(calibration.camera)}
    if calibration.response is not None:
        tables["response"] = _response(calibration.response)
    # That no falloff is left in the frame a file says by giving both, even where they are uniform.
    for name in ("vignetting", "emission"):
        if not (profile := getattr(calibration, name)).is_uniform or priors.falloff_power is None:
            tables[name] = _profile(profile)
    if calibration.emission_axis != OPTICAL_AXIS and "emission" in tables:
        tables["emission"]["direction"] = list(calibration.emission_axis)
    is_known = {"vignetting", "emission"} <= set(tables)
    # Defaults and what is not known are left out; an empty table says nothing.
    further: Tables = {
        "sensor": {
            "noise_sigma": noise.sigma or None, "full_well": noise.full_well, "read_noise": noise.read_noise or None,
            "bits": noise.bits, "saturation_level": calibration.saturation_level,
        },
        "rig": _rig(priors),
        "surface": _surface(priors),
        "uncertainty": _uncertainty(priors, is_known and calibration.is_emission_undone),
    }  # fmt: skip
    for name, table in further.items():
        if stated := {key: value for key, value in table.items() if value is not None}:
            tables[name] = stated
    return tables


def _response(response: Response) -> dict[str, Any]:
    keys = {"gamma": ("gamma",), "table": ("light", "value")}.get(response.kind, ())
    return {"type": response.kind, **{key: getattr(response, key) for key in keys}}


def _profile(profile: AngularProfile) -> dict[str, Any]:
    if not profile.angles:
        return {"type": "cosine", "power": profile.power}
    return {"type": "table", "angle_deg": [degrees_of(angle) for angle in profile.angles], "value": profile.values}


def _rig(priors: Priors) -> dict[str, Any]:
    rig: dict[str, Any] = {
        "lights_mm": priors.lights_mm or None,
        "lights_covariance_mm2": priors.lights_covariance_mm2 or None,
    }
    if isinstance(priors.distance_mm, Normal):
        rig |= {"distance_mm": priors.distance_mm.mean, "distance_sd_mm": priors.distance_mm.sd or None}
    else:
        rig["distance_range_mm"] = _interval(priors.distance_mm)
    if priors.light_offset_mm != UNTOLD_OFFSET_MM:
        rig["light_offset_mm"] = _interval(priors.light_offset_mm)
    return rig


def _surface(priors: Priors) -> dict[str, Any]:
    lobe, slope = priors.lobe_curvature, priors.relief_slope
    told = None if slope == UNTOLD_SLOPE_RAD else _interval(slope)
    return {
        "lobe_curvature": lobe.mean if isinstance(lobe, Normal) else None,
        "relief_slope_deg": None if told is None else [degrees_of(end) for end in told],
    }


def _uncertainty(priors: Priors, states_falloff: bool) -> dict[str, Any]:
    power, floors = priors.falloff_power, priors.floors
    values = {} if floors is None else {key: (getattr(floors, name), unit) for name, (key, unit) in FLOORS.items()}
    return {
        **{name: deviation or None for name, deviation in priors.camera.deviations.items()},
        "falloff_power": _interval(power) if states_falloff or power != UNTOLD_FALLOFF_POWER else None,
        **{key: degrees_of(value) if unit else value for key, (value, unit) in values.items()},
    }


def _interval(distribution: Distribution | None) -> tuple[float, float] | None:
    """Return the ends of a uniform distribution, equal ones of an exact value; None of others, which no file states."""
    if isinstance(distribution, Uniform):
        return distribution.low, distribution.high
    exact = isinstance(distribution, Normal) and distribution.sd == 0
    return (distribution.mean, distribution.mean) if exact and isinstance(distribution, Normal) else None


def degrees_of(angle: float) -> float:
    """Return an angle, rad, as the shortest number of degrees that reads back as the same radians.

    Where no number does, since degrees lie less densely there, it is the nearest one.
    """
    rough = math.degrees(angle)
    near = [rough]
    for towards in (-math.inf, math.inf):
        stepped = rough
        for _ in range(4):
            stepped = math.nextafter(stepped, towards)
            near.append(stepped)
    candidates = (*(round(rough, digits) for digits in range(15)), *near)
    return next((degrees for degrees in candidates if math.radians(degrees) == angle), rough)


def _check_read_back(calibration: Calibration, tables: Tables) -> None:
    """Raise `InputError` where a file would not state the whole of a calibration."""
    read = validate(CalibrationSpec, {**tables, "camera": {}}, "calibration").calibration(calibration.camera)
    names = ["response", "vignetting", "emission", "noise", "saturation_level"]
    names += [] if calibration.emission.is_uniform else ["emission_axis"]
    parts = [(name, getattr(calibration, name), getattr(read, name)) for name in names]
    parts += [
        (each.name, getattr(calibration.priors, each.name), getattr(read.priors, each.name)) for each in fields(Priors)
    ]
    for name, one, other in parts:
        if not _alike(one, other):
            raise InputError(f"calibration {name} = {one!r}: a calibration file cannot state it")


def _alike(one: Any, other: Any) -> bool:
    """Return whether values are the same, numbers up to the rounding of angles in degrees."""
    if isinstance(one, NoiseModel) and one.bits is None:
        # Of a frame without steps between its values the response makes no difference to the noise.
        other = replace(other, response=one.response)
    # Also what nobody gave, which is given once a file states it.
    of_a_kind = is_dataclass(one) and (isinstance(one, type(other)) or isinstance(other, type(one)))
    if one == other or not of_a_kind:
        return bool(one == other)
    ones, others = (list(_numbers(astuple(each))) for each in (one, other))
    return len(ones) == len(others) and all(
        a == b or (isinstance(a, float) and isinstance(b, float) and math.isclose(a, b, rel_tol=CLOSE))
        for a, b in zip(ones, others, strict=True)
    )


def _numbers(value: Any) -> Iterator[Any]:
    if isinstance(value, tuple):
        for each in value:
            yield from _numbers(each)
    else:
        yield value
