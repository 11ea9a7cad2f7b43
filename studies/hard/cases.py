"""Detections of the corpus with their truth, and what reconstruction is told of a scene."""

from dataclasses import dataclass, replace
from functools import lru_cache

from simtest.calibration import Calibration, CameraPrior, Priors, Uniform
from simtest.geometry import Array, Patch
from simtest.spec import Scene, scene_from_dict
from studies.hard.rows import PRIOR_FOCAL_SD, Row
from studies.hard.scenes import Tables, base_scene, rng_of

WIDER = 0.1
"""The told range of distances is wider by this share than that of the highlights in view."""


@dataclass(frozen=True)
class Case:
    """A detection with the truth.

    `row`: of the corpus; `patch`: the detection's region of interest; `normal`, `normal_base` (shape (3,)): true
    normals of the fine surface and of the base at the highlight point; None where the detection is false; `holds`:
    lit glints in the spot; 0 where it is none, or has none. Accuracy is scored where it holds exactly one;
    `radius_px`: of the visible highlight, at half height; NaN where there is none; `span_mm`: least and largest
    distance of the highlights in view, mm.
    """

    row: str
    patch: Patch
    normal: Array | None
    normal_base: Array | None
    holds: int
    radius_px: float
    span_mm: tuple[float, float]


def scene_of(number: int, row: Row) -> tuple[Tables, Scene]:
    """Return a row's scene as tables without its sensor, and whole."""
    tables = row.change(number, base_scene(number))
    sensor = {**tables["sensor"], **row.sensor(number), "vignetting_known": row.told.vignetting}
    if "bits" in sensor:
        # A picture's noise is that of its electrons.
        sensor |= {"noise_sigma": 0.0, "full_well": 8000, "read_noise": 6.0}
    scene = scene_from_dict(tables | {"sensor": sensor}, f"hard {number} {row.name}")
    return {name: value for name, value in tables.items() if name != "sensor"}, scene


@lru_cache(maxsize=64)
def calibration_of(number: int, row: Row, span_mm: tuple[float, float]) -> Calibration:
    """Return what reconstruction is told of a row of a scene."""
    calibration = scene_of(number, row)[1].calibration()
    if row.told.light:
        priors = replace(calibration.priors, distance_mm=Uniform(span_mm[0] * (1 - WIDER), span_mm[1] * (1 + WIDER)))
    else:
        priors = replace(calibration.priors, lights_mm=Priors().lights_mm)
    if row.told.focal:
        return replace(calibration, priors=priors)
    off = max(1 + PRIOR_FOCAL_SD * float(rng_of(number, "focal").standard_normal()), 0.6)
    camera = calibration.camera
    told = replace(priors, camera=CameraPrior(focal_sd=PRIOR_FOCAL_SD))
    return replace(calibration, camera=replace(camera, fx=camera.fx * off, fy=camera.fy * off), priors=told)
