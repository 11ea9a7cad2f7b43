"""A scope: camera, lights and sensor, by the name of a preset or from a TOML file."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array
from simtest.runtime.boundary import suggestion
from simtest.spec.camera import SceneCamera, load_camera
from simtest.spec.camera_tables import camera_table
from simtest.spec.lights import Rig
from simtest.spec.sensor import Sensor
from simtest.spec.spec_model import Spec, validate
from simtest.spec.toml_files import read_toml

Table = dict[str, Any]
"""A table as TOML holds it."""

Interval = tuple[float, float]


def _scope(kind: str, focal_px: float, rig: str, radius_mm: float | None = None) -> Table:
    """Return a scope with the camera of the shipped tissue scenes (scenes/tissue_*.toml), and exits of some radius."""
    emission = {"source": {"type": "disc", "radius_mm": radius_mm}, "profile": {"type": "cosine", "power": 1.0}}
    return {
        "camera": {"width": 640, "height": 480, "fx": focal_px, "fy": focal_px},
        "sensor": {"preset": f"{kind}_hd", "vignetting": {"type": "cosine", "power": 2.0}},
        "rig": {"preset": rig} | ({} if radius_mm is None else {"each": emission}),
    }


SCOPES: dict[str, Table] = {
    "colocated": _scope("colonoscope", 320.0, "colocated"),
    "colonoscope_2": _scope("colonoscope", 320.0, "colonoscope_2", 0.9),
    "colonoscope_3": _scope("colonoscope", 320.0, "colonoscope_3", 0.9),
    "laparoscope": _scope("laparoscope", 480.0, "laparoscope", 0.6),
}
"""Scopes by the name of their rig's preset."""


class ReliefPrior(Spec):
    """What is known of the relief: each value a number, or the interval that it is drawn from."""

    slope_deg: float | Interval = Field(description="slope an axis, deg; 0: smooth")
    wavelength_mm: float | Interval = Field(2.0, description="mm")

    @model_validator(mode="after")
    def _in_order(self) -> "ReliefPrior":
        for name, least, most in (("slope_deg", 0.0, 20.0), ("wavelength_mm", 0.02, 20.0)):
            low, high = ends(getattr(self, name))
            if not least <= low <= high <= most or (low == 0 and high > 0):
                raise ValueError(
                    f"{name} = {getattr(self, name)}: must be a number, or a lower and an upper end in this order, "
                    f"{least:g} to {most:g}" + (", and 0 only as a number" if least == 0 else "")
                )
        return self


class ScopeFile(Spec):
    """A scope's file; all tables but the camera may be left out."""

    camera: SceneCamera
    rig: Rig = Rig()
    sensor: Sensor | None = None
    relief: ReliefPrior | None = None


@dataclass(frozen=True)
class Scope:
    """A scope, by the name of its preset or file."""

    name: str
    tables: Table  # camera, rig and sensor as a scene takes them; the last two may be absent
    relief: ReliefPrior | None = None  # what the file states of it

    @cached_property
    def _file(self) -> ScopeFile:
        return validate(ScopeFile, self.tables, self.name)

    @property
    def camera(self) -> Camera:
        """The camera's geometry."""
        return self._file.camera.model()

    @property
    def focal_px(self) -> float:
        """Pixels per rad at the centre of the picture."""
        step = self.camera.step_of_pixels(np.array([self.camera.width / 2, self.camera.height / 2]))
        return float(1 / math.sqrt(np.linalg.norm(np.cross(*step))))

    @property
    def offsets_mm(self) -> Array:
        """Distance of each light from the camera's centre, mm, shape (L,)."""
        return np.asarray(np.linalg.norm(self._file.rig.nominal_mm(), axis=1))

    @property
    def deepest_light_mm(self) -> float:
        """How far the foremost light lies in front of the camera, mm; below 0 it lies behind."""
        return float(self._file.rig.nominal_mm()[:, 2].max())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, px."""
        return self.camera.width, self.camera.height


def ends(value: float | Interval) -> Interval:
    """Return both ends of a value that is a number or an interval."""
    return value if isinstance(value, tuple) else (value, value)


def read_scope(name: str, camera: Path | None = None) -> Scope:
    """Read a scope.

    Parameters
    ----------
    name : str
        Of a preset (`SCOPES`), or a TOML file with the tables ``[camera]``, ``[rig]``, ``[sensor]`` and ``[relief]``.
        In ``[rig]``, ``lights_mm`` may give the positions alone, as in a calibration file.
    camera : Path, optional
        Camera file that replaces the scope's camera.
    """
    path = Path(name).expanduser()
    if name in SCOPES:
        scope = Scope(name, SCOPES[name])
    elif path.is_file():
        data = read_toml(path)
        rig = data.get("rig")
        if isinstance(rig, Mapping) and "lights_mm" in rig:
            data["rig"] = _listed(rig, f"{path}: rig")
        relief = validate(ScopeFile, data, str(path)).relief
        scope = Scope(path.stem, {key: value for key, value in data.items() if key != "relief"}, relief)
    else:
        known = ", ".join(SCOPES)
        raise InputError(f"{name}: no such file or preset; presets: {known}{suggestion(name, SCOPES)}")
    if camera is None:
        return scope
    return replace(scope, tables={**scope.tables, "camera": camera_table(load_camera(camera))})


def _listed(rig: Mapping[str, Any], where: str) -> Table:
    """Return the rig of lights at some positions, of which each has its share of the power."""
    if other := next((key for key in rig if key != "lights_mm"), None):
        raise InputError(f"{where}.{other}: must be left out where rig.lights_mm is given")
    lights_mm = rig["lights_mm"]
    sound = isinstance(lights_mm, Sequence) and 1 <= len(lights_mm) <= 32
    if not sound or not all(isinstance(light, Sequence) and len(light) == 3 for light in lights_mm):
        raise InputError(f"{where}.lights_mm = {lights_mm!s:.80}: must be 1 to 32 positions x, y, z, mm")
    return {"lights": [{"position_mm": list(light), "power": 1 / len(lights_mm)} for light in lights_mm]}
