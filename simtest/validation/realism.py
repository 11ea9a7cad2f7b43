"""For which realism an experiment's scenes stand: smooth controls, or tissue with its measured distance to real frames.

The distances stand in measured_realism.json, which `studies/realism_table.py` writes. An entry is quoted only for what
looks as the measured scene did: its key is a hash of all that a frame shows, but for seeds, viewpoint and rendering.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypedDict

from simtest.runtime.files import Json
from simtest.spec import Scene, scene_from_dict
from simtest.validation.cases import Case

MEASURED = Path(__file__).parent / "measured_realism.json"

CHAIN = ("mosaic", "colour", "sharpening", "scaling", "overlay", "coding")
"""Stages of the camera chain, keys of `sensor`: with one of them, or with motion, there is a chain."""

UNKNOWN = "Its distance to real frames is not known; `simtest realism` measures it."


class MeasuredDistance(TypedDict):
    """An entry of measured_realism.json: a scene's distance to a set of real frames."""

    scene: str
    look: str  # `look_of` the scene
    real: list[str]  # names of the real frames
    frames: int  # generated ones
    verdict: str
    near: int
    judged: int
    statistics: Json


def realism_of(cases: Iterable[Case]) -> list[Json]:
    """Describe the scenes of an experiment: an entry for all labels whose scenes are alike; none for computed cases."""
    found: dict[str, tuple[dict[str, Json], list[str]]] = {}
    for case in cases:
        if case.is_paper:
            continue
        entry = _entry(scene_from_dict(case.data, case.where), case.random)
        _, labels = found.setdefault(json.dumps(entry, sort_keys=True), (entry, []))
        if case.label not in labels:
            labels.append(case.label)
    return [{"scenes": labels, **entry} for entry, labels in found.values()]


def _entry(scene: Scene, random: Mapping[str, Any]) -> dict[str, Json]:
    kind, what = _surface(scene)
    stages = ["motion"] if scene.camera.motion is not None else []
    stages += [name for name in CHAIN if getattr(scene.sensor, name) is not None]
    chain = f"through a camera chain ({', '.join(stages)})" if stages else "without a camera chain"
    # What is drawn anew for each realisation has not one look.
    measured = None if random else _measured().get(look_of(scene))
    distance = UNKNOWN if measured is None else _quoted(measured)
    # A smooth scene is a control, whatever its distance.
    told = f"{what}, {chain}." + ("" if kind == "smooth" and measured is None else f" {distance}")
    quoted = None if measured is None else _as_json(measured)
    return {"kind": kind, "camera_chain": stages, "sentence": told, "distance": quoted}


def _surface(scene: Scene) -> tuple[str, str]:
    """Return whether a scene is smooth or tissue, or only rough or painted, and what its surface carries."""
    relief = scene.surface.relief
    parts = []
    if relief is not None:
        bands = " and ".join(f"{band.slope_deg:g}° at {band.wavelength_mm:g} mm" for band in relief.bands)
        parts.append(f"relief with slopes of {bands}")
    if scene.film_level is not None or getattr(scene.reflectance, "film", None) is not None:
        parts.append("a liquid film")
    if scene.albedo is not None:
        parts.append("vessels and mottling")
    if scene.translucency is not None:
        parts.append("translucency")
    if not parts:
        return "smooth", "Smooth control: no relief and no texture"
    kind = "tissue" if relief is not None and scene.albedo is not None else "partial"
    words = parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]
    return kind, f"{'Tissue' if kind == 'tissue' else 'Parts of tissue'}: {words}"


def _as_json(measured: MeasuredDistance) -> Json:
    return {
        "scene": measured["scene"], "real": measured["real"], "frames": measured["frames"],
        "verdict": measured["verdict"], "statistics": measured["statistics"],
    }  # fmt: skip


def _quoted(measured: MeasuredDistance) -> str:
    real, frames = len(measured["real"]), f"{measured['frames']} frames of {measured['scene']}"
    against = f"measured on {frames} against {real} real {'frame' if real == 1 else 'frames'}"
    if not measured["judged"]:
        return f"Its distance to real frames carries no verdict: too few scenes ({against})."
    return f"{measured['near']} of {measured['judged']} statistics are near real frames ({against})."


def look_of(scene: Scene) -> str:
    """Return a hash of all of a scene that its frames show, but for seeds, viewpoint and rendering."""
    # Defaults are left out, so that a key that scenes get later changes no look.
    keys = scene.model_dump(mode="json", exclude={"name", "render"}, exclude_defaults=True)
    surface, reflectance = keys.setdefault("surface", {}), keys.setdefault("reflectance", {})
    surface.pop("viewpoint", None)
    for table in (surface.get("relief"), reflectance.get("albedo"), keys.get("sensor"), keys.get("rig")):
        if table is not None:
            table.pop("seed", None)
    keys["types"] = [part.type for part in (scene.surface, scene.reflectance, scene.sensor.response)]
    return hashlib.sha256(json.dumps(keys, sort_keys=True).encode()).hexdigest()[:16]


@cache
def _measured() -> dict[str, MeasuredDistance]:
    """Return the measured distances by look."""
    if not MEASURED.is_file():
        return {}
    entries: Sequence[MeasuredDistance] = json.loads(MEASURED.read_text(encoding="utf-8"))["scenes"]
    return {entry["look"]: entry for entry in entries}
