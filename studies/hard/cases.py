"""Detections of the corpus with their truth, kept in files: a frame is rendered once, estimators are judged often."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration import Calibration, CameraPrior, Priors, Uniform
from simtest.errors import InputError
from simtest.geometry import Array, Patch
from simtest.runtime.files import write_atomically
from simtest.spec import Scene, scene_from_dict
from studies.hard.rows import PRIOR_FOCAL_SD, Row
from studies.hard.scenes import Tables, base_scene, rng_of

WIDER = 0.1
"""The told range of distances is wider by this share than that of the highlights in view."""

ARRAYS = ("values", "peak_px", "saturated", "seen", "raw", "noise")
NUMBERS = ("origin_px", "peak_value", "peak_pixel", "smoothing_px", "others_px", "others_value")


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


def save(path: Path, cases: Sequence[Case], rows: Iterable[str]) -> None:
    """Write the cases of a scene, and which rows were rendered: arrays, and one text with the rest."""
    arrays: dict[str, np.ndarray] = {}
    kept = []
    for i, case in enumerate(cases):
        for name in ARRAYS:
            value = getattr(case.patch, name)
            if value is not None:
                arrays[f"{i}_{name}"] = np.asarray(value)
        numbers = {name: getattr(case.patch, name) for name in NUMBERS}
        told = {name: getattr(case, name) for name in ("row", "holds", "radius_px", "span_mm")}
        normals = [None if n is None else n.tolist() for n in (case.normal, case.normal_base)]
        kept.append({"patch": numbers, "case": told, "normals": normals})
    arrays["text"] = np.array(json.dumps({"rows": sorted(rows), "cases": kept}, default=float))

    def write(part: Path) -> None:
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    write_atomically(path, write)


def rows_in(path: Path) -> set[str]:
    """Return the rows whose frames were rendered for a scene's file; none where there is no file."""
    if not path.exists():
        return set()
    with np.load(path, allow_pickle=False) as kept:
        return set(_text(path, kept)["rows"])


def load(path: Path) -> Iterator[Case]:
    """Read the cases of a scene; raise `InputError` where the file does not hold any."""
    with np.load(path, allow_pickle=False) as kept:
        for i, each in enumerate(_text(path, kept)["cases"]):
            arrays = {name: kept.get(f"{i}_{name}") for name in ARRAYS}
            if arrays["noise"] is not None and arrays["noise"].ndim == 0:
                arrays["noise"] = float(arrays["noise"])  # type: ignore[assignment]
            numbers = each["patch"]
            for name in ("origin_px", "peak_pixel"):
                numbers[name] = tuple(int(v) for v in numbers[name])
            if numbers["others_px"] is not None:
                numbers["others_px"] = tuple(tuple(point) for point in numbers["others_px"])
            # Files of before have none.
            numbers["others_value"] = tuple(numbers.get("others_value", ()))
            told = each["case"]
            told |= {"holds": int(told["holds"]), "span_mm": tuple(told["span_mm"])}
            told["radius_px"] = math.nan if told["radius_px"] is None else told["radius_px"]
            normals = [None if n is None else np.array(n) for n in each["normals"]]
            yield Case(patch=Patch(**arrays, **numbers), normal=normals[0], normal_base=normals[1], **told)


def _text(path: Path, kept: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return what a scene's file holds beside its arrays."""
    made = json.loads(str(kept["text"])) if "text" in kept else None
    if not isinstance(made, dict):
        raise InputError(f"{path}: no file of the corpus hard, or one without the names of its rows")
    return made
