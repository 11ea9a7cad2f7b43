"""EndoMapper's photometric calibration (EM_Dataset-PhotometricCalibration): response, vignetting and light.

A pixel holds (gain V sigma e^(-mu (1 - cos a)) / d^2 times the surface's reflectance)^(1 / gamma) (Batlle, Montiel and
Tardos 2022): a is the angle at the light between its principal direction D and the surface, d its distance, and
V = cos^k of the angle from the optical axis. Gain and sigma scale all pixels alike and are not read. Positions are
metres in the camera frame.
"""

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from simtest.errors import InputError
from simtest.spec.camera_formats.common import number, read_xml
from simtest.spec.camera_formats.vicalib import text_of, values

Tables = dict[str, dict[str, Any]]

MM = 1000.0
STEP_DEG = 0.5
"""Of the table of the light's spread: with mu = 10, linear interpolation is off by 1e-4."""

FARTHEST_MM = 1000.0
MOST_SPREAD = 1000.0


def read_photometric(path: Path) -> Tables:
    """Read a photometric calibration as tables of a calibration file: response, vignetting, emission, rig.

    Several lights must spread their light alike.
    """
    where, root = str(path), read_xml(path)
    tables: Tables = {}
    cameras = root.findall("camera")
    if len(cameras) > 1:
        raise InputError(f"{where}: holds {len(cameras)} cameras; must be one")
    model = cameras[0].find("camera_model") if cameras else None
    if model is not None:
        tables |= _camera(model, f"{where}: camera")
    lights = [_light(element, f"{where}: light {i}") for i, element in enumerate(root.findall("light/light_model"))]
    if lights:
        tables |= _rig(lights, where)
    if not tables:
        raise InputError(f"{where}: holds neither a camera_model nor a light_model; must hold one of them")
    return tables


def _camera(model: ElementTree.Element, at: str) -> Tables:
    if model.get("type") != "gamma":
        raise InputError(f"{at}: type = {model.get('type')!r:.40}: simtest lacks it; must be 'gamma'")
    gamma = _number(model, "gamma", at)
    if not 0.1 <= gamma <= 10:
        raise InputError(f"{at}: gamma = {gamma:g}: must be 0.1 to 10")
    tables: Tables = {"response": {"type": "gamma", "gamma": gamma}}
    power = _number(model, "vignetting", at) if model.find("vignetting") is not None else 0.0
    if not 0 <= power <= 1000:
        raise InputError(f"{at}: vignetting = {power:g}: must be 0 to 1000")
    tables["vignetting"] = {"type": "cosine", "power": power}
    return tables


def _light(model: ElementTree.Element, at: str) -> dict[str, Any]:
    """Return the spread, position, mm, and direction of a light."""
    if model.get("type") != "sls":
        raise InputError(f"{at}: type = {model.get('type')!r:.40}: simtest lacks it; must be 'sls'")
    mu = _number(model, "mu", at)
    if not 0 <= mu <= MOST_SPREAD:
        raise InputError(f"{at}: mu = {mu:g}: must be 0 to {MOST_SPREAD:g}")
    _number(model, "sigma", at)
    told = {}
    for key in ("P", "D"):
        element = model.find(key)
        if element is None:
            raise InputError(f"{at}: {key}: missing; must be [ x; y; z ]")
        told[key] = np.array(values(element, at, key, 3))
    position, length = told["P"] * MM, float(np.linalg.norm(told["D"]))
    if not np.abs(position).max() <= FARTHEST_MM:
        raise InputError(f"{at}: P = {told['P'].tolist()}: must be metres, within 1 m of the camera")
    if not abs(length - 1) <= 0.01:
        raise InputError(f"{at}: D has length {length:.3g}; must be a unit vector")
    return {"mu": mu, "position": position.round(9).tolist(), "direction": (told["D"] / length).tolist()}


def _rig(lights: list[dict[str, Any]], where: str) -> Tables:
    """Return where the lights are and how they emit."""
    first = lights[0]
    for light in lights[1:]:
        if light["mu"] != first["mu"] or not np.allclose(light["direction"], first["direction"], atol=1e-3):
            raise InputError(f"{where}: lights of different mu or D; must spread their light alike")
    angles = np.arange(0.0, 180 + STEP_DEG, STEP_DEG)
    emission = {
        "type": "table", "angle_deg": angles.tolist(),
        "value": [math.exp(-first["mu"] * (1 - math.cos(math.radians(angle)))) for angle in angles],
        "direction": first["direction"],
    }  # fmt: skip
    return {"emission": emission, "rig": {"lights_mm": [light["position"] for light in lights]}}


def _number(model: ElementTree.Element, key: str, at: str) -> float:
    """Return a number, in brackets or not."""
    return number(text_of(model, key, at).strip("[] "), at, key)
