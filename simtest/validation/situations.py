"""A scene in words: its conditions, the situation that a run's guide sorts it into, and which realism it stands for.

Conditions are read from the scenes: what a reader asks before choosing an estimator and no column of results tells.
Situations are settings of one kind of light, surface, relief, noise and spot. Realism: a scene is a smooth control, or
tissue with its measured distance to real frames. The distances stand in measured_realism.json, which
`studies/realism_table.py` writes. An entry is quoted only for what looks as the measured scene did: its key is a hash
of all that a frame shows, but for seeds, viewpoint and rendering.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import polars as pl
from pydantic import BaseModel

from simtest.runtime.files import Json
from simtest.spec import Scene, apply_settings, scene_from_dict
from simtest.validation.cases import Case

LOW_NOISE = 0.02
"""White noise up to this share of full scale is called low."""


@dataclass(frozen=True)
class Conditions:
    """Conditions of a setting, in words; lengths of the camera and the lobe as numbers.

    Parameters
    ----------
    told : str
        What the estimators are told of the lights: "position and distance known", "position known" or
        "position not known", and whether the known one has an error.
    relief : str
        Relief and film of the surface.
    sensor : str
        Noise, and what else the sensor does that estimators suffer from.
    render : str
        Light beside the direct highlight: a diffuse base, bounces.
    camera : str
        Projection and distortion.
    reflectance : str
        Type of the lobe.
    emission : str
        What of the lights' emission estimators suffer from; empty where nothing.
    half_width_rad : float or None
        Angle between normal and sightline at which the lobe falls to half.
    focal_px : float or None
        Focal length, px.
    """

    told: str = ""
    relief: str = ""
    sensor: str = ""
    render: str = ""
    camera: str = ""
    reflectance: str = ""
    emission: str = ""
    half_width_rad: float | None = None
    focal_px: float | None = None

    def to_json(self) -> Json:
        """Return the entry of summary.json."""
        return asdict(self)


def conditions_of(cases: Iterable[Case]) -> dict[str, Conditions]:
    """Return the conditions of each setting, at the upper ends of what is drawn for each realisation.

    A setting's first part counts, and computed cases have none.
    """
    found: dict[str, Conditions] = {}
    for case in cases:
        if not case.is_paper and case.setting not in found:
            data = apply_settings(case.data, case.ends[1], case.where)
            found[case.setting] = conditions(scene_from_dict(data, case.where))
    return found


def conditions(scene: Scene) -> Conditions:
    """Return the conditions of a scene."""
    return Conditions(
        _told(scene), _relief(scene), _sensor(scene), _render(scene), _camera(scene), scene.reflectance.in_words,
        _emission(scene), float(scene.reflectance.half_width), float(scene.camera.fx),
    )  # fmt: skip


def _told(scene: Scene) -> str:
    if not scene.known.lights:
        return "position not known"
    has_distance = scene.known.distance_mm is not None or scene.known.distance_error is not None
    told = "position and distance known" if has_distance else "position known"
    wrong = any(light.position_error_mm for light in scene.rig.lights)
    return f"{told}, the position with an error" if wrong else told


def _emission(scene: Scene) -> str:
    parts = [] if scene.rig.emission_known else ["emission not told"]
    parts += ["light of finite size"] if any(light.source is not None for light in scene.rig.lights) else []
    return ", ".join(parts)


def _relief(scene: Scene) -> str:
    relief = scene.surface.relief
    parts = [] if relief is None else ["relief"]
    if scene.film_level is not None:
        parts.append("liquid in its valleys")
    return " with ".join(parts) or "smooth surface"


def _sensor(scene: Scene) -> str:
    sensor = scene.sensor
    sigma = sensor.noise_sigma
    parts = []
    if sigma > 0:
        parts.append("noise up to 2 %" if sigma <= LOW_NOISE else "noise above 2 %")
    parts += [
        words
        for words, applies in (
            ("shot noise", sensor.full_well is not None),
            ("blur", sensor.point_spread_px > 0),
            ("clipping", sensor.saturation),
            (f"{sensor.bits} bits", sensor.bits is not None),
            ("encoded values" + ("" if sensor.response_known else ", not told"), sensor.response.type != "linear"),
            ("vignetting not told", not sensor.vignetting_known),
            ("lossy coding", sensor.coding is not None),
            ("colour mosaic", sensor.mosaic is not None),
            ("colour processing", sensor.colour is not None),
            ("noise reduction", sensor.denoising is not None),
            ("sharpening", sensor.sharpening is not None),
            ("rescaled", sensor.scaling is not None),
            ("overlay", sensor.overlay is not None),
            ("colour fringe", sensor.fringe is not None),
            ("interlaced", sensor.interlacing is not None),
        )
        if applies
    ]
    return ", ".join(parts) or "no noise"


def _render(scene: Scene) -> str:
    parts = ["diffuse base"] if getattr(scene.reflectance, "diffuse", 0.0) else []
    parts += ["bounced light"] if scene.render.path_depth > 2 or scene.render.ambient else []
    parts += ["instruments"] if scene.shown_instruments else []
    return ", ".join(parts) or "direct highlight alone"


def _camera(scene: Scene) -> str:
    kind = getattr(scene.camera.distortion, "type", None) if scene.camera.distortion is not None else None
    return {None: "pinhole camera", "none": "pinhole camera", "brown_conrady": "distorted lens",
            "kannala_brandt": "fisheye", "scaramuzza": "omnidirectional lens"}.get(kind, str(kind))  # fmt: skip


FLAT = 0.05
"""A curvature times distance below this size counts as none: the surface bends by less than 1/20 of its distance."""

CO_LOCATED = 1e-3
"""A light nearer to the camera than this share of the distance counts as at the camera; it costs below 0.03 deg."""

SMALL_SPOT_PX = 3.0
"""Radius at half height below which isophotes carry no shape (`simtest.estimators.small_spots`)."""

FAR_BESIDE = 0.11
"""Light offset over distance above which a light counts as far beside the camera: 0.1, and what a tilt adds to it."""

MIXED = "mixed curvature"

_USUAL = {"direct highlight alone", "pinhole camera", "resolved spot", "smooth surface"}
"""What is not worth a word where other situations differ from it."""

_ANALYTIC = {"plane", "cylinder", "sphere", "quadric"}

_ASPECTS = ("reflectance", "emission", "relief", "sensor", "render", "camera")


@dataclass(frozen=True)
class Situation:
    """A kind of setting.

    Parameters
    ----------
    surface : str
        Kind of surface, in words; of computed frames, what is varied.
    circumstances : str
        What else sets it apart from the run's other situations: light, lobe, noise, relief, spot; may be empty.
    settings : tuple of str
        Its settings.
    labels : tuple of str
        Names of its curves.
    """

    surface: str
    circumstances: str
    settings: tuple[str, ...]
    labels: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Both, as one phrase."""
        return ", ".join(part for part in (self.surface, self.circumstances) if part)


def situations_of(
    true: pl.DataFrame, conditions: Mapping[str, Mapping[str, object]]
) -> tuple[tuple[str, ...], list[Situation]]:
    """Sort the settings of true highlights into situations.

    Parameters
    ----------
    true : polars.DataFrame
        Rows of results.parquet with a true highlight.
    conditions : mapping
        Conditions of each setting (`conditions_of`); may be empty.

    Returns
    -------
    shared : tuple of str
        What holds in all situations.
    situations : list of Situation
        In the order of appearance, those of the same circumstances together.
    """
    kinds: dict[tuple[str, ...], list[str]] = {}
    parts = {str(name): part for (name,), part in true.group_by("setting", maintain_order=True)}
    for setting, part in parts.items():
        kinds.setdefault(_kind(part, conditions.get(setting, {})), []).append(setting)
    varying = [len(set(values)) > 1 for values in zip(*kinds, strict=True)]
    # A surface is always named: without one the others say nothing.
    varying[:1] = [True]
    shared = tuple(text for text, varies in zip(next(iter(kinds), ()), varying, strict=False) if text and not varies)
    found = []
    for kind, settings in kinds.items():
        rows = pl.concat([parts[setting] for setting in settings])
        told = [text for text, varies in zip(kind, varying, strict=True) if text and varies]
        circumstances = ", ".join(text for text in told[1:] if text not in _USUAL)
        labels = tuple(str(label) for label in rows["label"].unique(maintain_order=True))
        found.append(Situation(told[0], circumstances, tuple(settings), labels))
    order = list(dict.fromkeys(situation.circumstances for situation in found))
    return shared, sorted(found, key=lambda situation: order.index(situation.circumstances))


def _kind(rows: pl.DataFrame, told: Mapping[str, object]) -> tuple[str, ...]:
    """Return what kind of setting some highlights belong to: a phrase for each aspect, empty for one not known."""
    if rows["kd_min"].null_count() == rows.height:
        # The published protocol computes its frames; the label names what it varies.
        return (str(rows["label"][0]), "", "", *("" for _ in _ASPECTS))
    names = [str(name) for name in rows["surface"].drop_nulls().unique(maintain_order=True)]
    surface = _shape(rows)
    if set(names) - _ANALYTIC:
        surface = f"{', '.join(names)}: {surface}"
    return (surface, _light(rows, told), _spot(rows, told), *(str(told.get(name) or "") for name in _ASPECTS))


def _shape(rows: pl.DataFrame) -> str:
    """Name the kind of surface at some highlights by the signs of their principal curvatures.

    Under a relief these are the base's: the fine surface bends both ways within every cloud.
    """
    low, high = (_of_base(rows, name).drop_nulls().to_numpy() for name in ("kd_min", "kd_max"))
    # A curvature that lies within the limit at all highlights is none; one that changes sign is mixed.
    signs = [_sign(values) for values in (low, high)]
    names = {
        (0, 0): "flat", (0, 1): "outside of a tube", (-1, 0): "inside of a tube", (1, 1): "dome", (-1, -1): "bowl",
        (-1, 1): "saddle",
    }  # fmt: skip
    return MIXED if None in signs else names[signs[0] or 0, signs[1] or 0]


def _of_base(rows: pl.DataFrame, name: str) -> pl.Series:
    """Return a column of the base, and of the fine surface where the base has none."""
    base = f"{name}_base"
    return rows.select(pl.coalesce(base, name)).to_series() if base in rows.columns else rows[name]


def _sign(values: np.ndarray) -> int | None:
    """Return the sign that curvatures share, 0 for none; None where they do not."""
    found = set(np.where(np.abs(values) < FLAT, 0, np.sign(values)).astype(int).tolist())
    return found.pop() if len(found) == 1 else None


def _light(rows: pl.DataFrame, told: Mapping[str, object]) -> str:
    lights = rows["n_lights"].drop_nulls() if "n_lights" in rows.columns else pl.Series([1])
    count = int(lights[0]) if lights.len() else 1
    name = "light" if count == 1 else f"{count} lights"
    largest = rows["eps_over_d"].abs().max()
    if largest is None or float(largest) <= CO_LOCATED:  # type: ignore[arg-type]
        return f"{name} at the camera"
    degree = "ε/d up to 0.1" if float(largest) <= FAR_BESIDE else "ε/d above 0.1"  # type: ignore[arg-type]
    return ", ".join(part for part in (f"{name} beside the camera ({degree})", str(told.get("told") or "")) if part)


def _spot(rows: pl.DataFrame, told: Mapping[str, object]) -> str:
    """Name the size of the highlights: the half-width of the lobe, shrunk by the surface's own turn."""
    half_width, focal = told.get("half_width_rad"), told.get("focal_px")
    if not isinstance(half_width, float) or not isinstance(focal, float):
        return ""
    stretch = np.abs((1 + rows["kd_min"].to_numpy()) * (1 + rows["kd_max"].to_numpy()))
    radius = focal * half_width / np.sqrt(np.nanmedian(np.maximum(stretch, 1e-6)))
    return "small spot (below 3 px)" if radius < SMALL_SPOT_PX else "resolved spot"


MEASURED = Path(__file__).parent / "measured_realism.json"

CHAIN = ("fringe", "mosaic", "colour", "denoising", "sharpening", "interlacing", "scaling", "overlay", "coding")
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


class SceneRealism(BaseModel):
    """For which realism some scenes of an experiment stand; `scenes` are the labels of their curves."""

    scenes: tuple[str, ...]
    kind: str
    camera_chain: tuple[str, ...]
    sentence: str
    distance: dict[str, Any] | None


def realism_of(cases: Iterable[Case]) -> list[SceneRealism]:
    """Describe the scenes of an experiment: an entry for all labels whose scenes are alike; none for computed cases."""
    found: dict[str, tuple[dict[str, Any], list[str]]] = {}
    for case in cases:
        if case.is_paper:
            continue
        entry = _entry(scene_from_dict(case.data, case.where), case.random)
        _, labels = found.setdefault(json.dumps(entry, sort_keys=True), (entry, []))
        if case.label not in labels:
            labels.append(case.label)
    return [SceneRealism(scenes=tuple(labels), **entry) for entry, labels in found.values()]


def _entry(scene: Scene, random: Mapping[str, Any]) -> dict[str, Any]:
    kind, what = _carried(scene)
    stages = ["motion"] if scene.camera.motion is not None else []
    stages += [name for name in CHAIN if getattr(scene.sensor, name) is not None]
    chain = f"through a camera chain ({', '.join(stages)})" if stages else "without a camera chain"
    # What is drawn anew for each realisation has not one look.
    measured = None if random else _measured().get(look_of(scene))
    distance = UNKNOWN if measured is None else _quoted(measured)
    # A smooth scene is a control, whatever its distance.
    told = f"{what}, {chain}." + ("" if kind == "smooth" and measured is None else f" {distance}")
    quoted: Json = None
    if measured is not None:
        quoted = {
            "scene": measured["scene"], "real": measured["real"], "frames": measured["frames"],
            "verdict": measured["verdict"], "statistics": measured["statistics"],
        }  # fmt: skip
    return {"kind": kind, "camera_chain": stages, "sentence": told, "distance": quoted}


def _carried(scene: Scene) -> tuple[str, str]:
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
    keys |= {"ambient": True} if scene.render.ambient else {}
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
