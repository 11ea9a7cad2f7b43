"""Under which conditions a setting's frames are made: what a reader asks before choosing an estimator.

They are read from the scenes, so they hold what no column of results tells, and stand in summary.json by setting.
"""

from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass

from simtest.runtime.files import Json
from simtest.spec import Scene, scene_from_dict
from simtest.validation.cases import Case

LOW_NOISE = 0.02
"""White noise up to this share of full scale is called low."""

LOBES = {
    "phong": "Phong lobe",
    "rough_plastic": "rough plastic",
    "principled": "principled lobe",
    "rough_conductor": "rough conductor",
    "tissue": "film over tissue",
}
"""Types of reflectance in words."""

_PRESET = "stands for lights, which count themselves"
_NUMBER = "in the number of lights and their offset, which the results tell"
_TOLD_EMISSION = "told to the estimators, unless emission_known is false"

DEGREES: dict[str, dict[str, str]] = {
    "rig": {
        **dict.fromkeys(("preset", "count", "radius_mm", "azimuth_deg", "axial_mm", "power", "each"), _PRESET),
        "seed": "of position_error_mm",
        **{f"lights.{key}": _NUMBER for key in ("position_mm", "offset_mm", "azimuth_deg")},
        **{f"lights.{key}": _TOLD_EMISSION for key in ("colour", "profile", "direction", "spot_deg", "soft_edge_deg",
                                                       "power")},
    },
    "reflectance": {
        "colour": "of the diffuse base, which is a kind",
        "albedo": "colour of the diffuse base, which is a kind",
        "translucency": "of the diffuse base, which is a kind",
        "specular": "scales the picture",
        "normalised": "scales the picture",
        "film": "its roughness is the half-width of the lobe, its level stands with the relief",
    },
    "sensor": {
        "preset": "stands for other keys, which count themselves",
        "vignetting": "taken out of the picture, unless vignetting_known is false",
        "exposure": "scales the picture; what it clips is told by saturation",
        "read_noise": "part of shot noise",
        "seed": "of the noise",
    },
}  # fmt: skip
"""Keys of a scene that set no situations apart, each with why; all others are kinds."""


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
    """Return the conditions of each setting; its first part counts, and computed cases have none."""
    found: dict[str, Conditions] = {}
    for case in cases:
        if not case.is_paper and case.setting not in found:
            found[case.setting] = conditions(scene_from_dict(case.data, case.where), case.random)
    return found


def conditions(scene: Scene, drawn: Collection[str] = ()) -> Conditions:
    """Return the conditions of a scene, of which the values of some keys are drawn for each realisation."""
    half_width = getattr(scene.reflectance, "half_width", None)
    return Conditions(
        _told(scene, drawn), _relief(scene), _sensor(scene), _render(scene), _camera(scene),
        LOBES.get(scene.reflectance.type, scene.reflectance.type), _emission(scene),
        None if half_width is None else float(half_width), float(scene.camera.fx),
    )  # fmt: skip


def _told(scene: Scene, drawn: Collection[str]) -> str:
    if not scene.known.lights:
        return "position not known"
    keys = ("distance_mm", "distance_error")
    has_distance = any(getattr(scene.known, key) is not None or f"known.{key}" in drawn for key in keys)
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
            ("sharpening", sensor.sharpening is not None),
            ("rescaled", sensor.scaling is not None),
            ("overlay", sensor.overlay is not None),
        )
        if applies
    ]
    return ", ".join(parts) or "no noise"


def _render(scene: Scene) -> str:
    parts = ["diffuse base"] if getattr(scene.reflectance, "diffuse", 0.0) else []
    parts += ["bounced light"] if scene.render.path_depth > 2 else []
    parts += ["instruments"] if scene.shown_instruments else []
    return ", ".join(parts) or "direct highlight alone"


def _camera(scene: Scene) -> str:
    kind = getattr(scene.camera.distortion, "type", None) if scene.camera.distortion is not None else None
    return {None: "pinhole camera", "none": "pinhole camera", "brown_conrady": "distorted lens",
            "kannala_brandt": "fisheye", "scaramuzza": "omnidirectional lens"}.get(kind, str(kind))  # fmt: skip
