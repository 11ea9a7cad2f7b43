"""A calibration as it stands in the files that simtest writes: `load_calibration` reads back what was written."""

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from simtest.calibration import Calibration, Distribution, NoiseModel, Normal, Priors, Response, Uniform
from simtest.calibration.angular_profile import AngularProfile
from simtest.calibration.calibration import OPTICAL_AXIS
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER, UNTOLD_OFFSET_MM, UNTOLD_SLOPE_RAD
from simtest.errors import InputError
from simtest.spec.camera_tables import camera_table
from simtest.spec.toml_files import toml_tables

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
    tables: Tables = {"camera": dict(camera_table(calibration.camera))}
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
    power = priors.falloff_power
    return {
        **{name: deviation or None for name, deviation in priors.camera.deviations.items()},
        "falloff_power": _interval(power) if states_falloff or power != UNTOLD_FALLOFF_POWER else None,
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
    from simtest.spec.calibration_spec import CalibrationSpec
    from simtest.spec.spec_model import validate

    stated = {**tables, "camera": {}}
    read = validate(CalibrationSpec, stated, "calibration").calibration(calibration.camera)
    for name, given, back in _parts(calibration, read):
        if not _alike(given, back):
            raise InputError(f"calibration {name} = {given!r}: a calibration file cannot state it")


def _parts(one: Calibration, other: Calibration) -> Iterator[tuple[str, object, object]]:
    """Yield name and both values of what two calibrations hold, the priors one by one."""
    for name in ("response", "vignetting", "emission", "noise", "saturation_level"):
        yield name, getattr(one, name), getattr(other, name)
    if not one.emission.is_uniform:
        yield "emission_axis", one.emission_axis, other.emission_axis
    for item in fields(Priors):
        yield item.name, getattr(one.priors, item.name), getattr(other.priors, item.name)


def _alike(one: object, other: object) -> bool:
    """Return whether values are the same, angles up to the rounding of their degrees."""
    if one == other:
        return True
    if isinstance(one, AngularProfile) and isinstance(other, AngularProfile):
        pairs = zip(one.angles, other.angles, strict=False)
        close = all(math.isclose(a, b, rel_tol=CLOSE) for a, b in pairs)
        return close and (one.power, one.values) == (other.power, other.values)
    # Also what nobody gave, which is given once a file states it.
    if (isinstance(one, Uniform) and isinstance(other, Uniform)) or (
        isinstance(one, Normal) and isinstance(other, Normal)
    ):
        return all(math.isclose(a, b, rel_tol=CLOSE) for a, b in zip(_numbers(one), _numbers(other), strict=True))
    # Of a frame without steps between its values the response makes no difference to the noise.
    if isinstance(one, NoiseModel) and isinstance(other, NoiseModel):
        return one.bits is None and NoiseModel(one.sigma, one.full_well, one.read_noise) == NoiseModel(
            other.sigma, other.full_well, other.read_noise
        )
    return False


def _numbers(distribution: Uniform | Normal) -> tuple[float, ...]:
    return tuple(getattr(distribution, item.name) for item in fields(distribution))
