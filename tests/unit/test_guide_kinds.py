"""Which keys of a scene set situations of the guide apart, and which do not."""

from typing import get_args

import pytest
from test_guide import FLAT, guide_from, rows_of

from simtest.spec import load_scene
from simtest.spec.lights import LightSpec, Rig
from simtest.spec.reflectance import Reflectance
from simtest.spec.sensor import Sensor
from simtest.validation.situations import conditions

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

# A change of each key that sets situations apart, with what it needs beside.
KINDS = {
    "rig": {
        "emission_known": {"rig.emission_known": False},
        "lights.position_error_mm": {"rig.lights.0.position_error_mm": 0.2},
        "lights.source": {"rig.lights.0.source.type": "disc", "rig.lights.0.source.radius_mm": 1.0},
    },
    "reflectance": {
        "type": {"reflectance.type": "rough_conductor"},
        "diffuse": {"reflectance.diffuse": 0.3},
        "exponent": {"reflectance.exponent": 2e4},
        "alpha": {"reflectance.type": "rough_conductor", "reflectance.alpha": 0.003},
        "roughness": {"reflectance.type": "principled", "reflectance.roughness": 0.05},
    },
    "sensor": {
        "point_spread_px": {"sensor.point_spread_px": 1.0},
        "full_well": {"sensor.full_well": 1000},
        "noise_sigma": {"sensor.noise_sigma": 0.0},
        "saturation": {"sensor.saturation": True},
        "response": {"sensor.response.type": "srgb"},
        "response_known": {"sensor.response.type": "srgb", "sensor.response_known": False},
        "bits": {"sensor.bits": 8},
        "mosaic": {"sensor.mosaic.pattern": "rggb"},
        "colour": {"sensor.colour.white_balance": [1.2, 1.0, 1.1]},
        "sharpening": {"sensor.sharpening.amount": 0.5},
        "scaling": {"sensor.scaling.factor": 0.5},
        "overlay": {"sensor.overlay.boxes": [{"x": 0, "y": 0, "width": 0.1, "height": 0.1}]},
        "coding": {"sensor.bits": 8, "sensor.coding.type": "jpeg"},
        "vignetting_known": {"sensor.vignetting_known": False},
    },
}


def keys_of(*models):
    """Keys of some models; those of a light behind "lights"."""
    names = {name for model in models for name in model.model_fields}
    if "lights" in names:
        names = (names - {"lights"}) | {f"lights.{name}" for name in LightSpec.model_fields}
    return names


@pytest.mark.parametrize(
    ("part", "models"),
    [("rig", [Rig]), ("sensor", [Sensor]), ("reflectance", get_args(get_args(Reflectance)[0]))],
)
def test_every_key_of_a_scene_is_of_a_kind_or_a_degree(part, models):
    keys, degrees = keys_of(*models), set(DEGREES[part])
    assert keys == KINDS[part].keys() | degrees
    assert not KINDS[part].keys() & degrees


@pytest.mark.parametrize("key", [f"{part} {key}" for part, keys in KINDS.items() for key in keys])
def test_a_key_of_a_kind_sets_situations_apart(key):
    part, name = key.split()
    changes = KINDS[part][name]
    # Without the key alone, so that what it needs beside does not count.
    last = name.removeprefix("lights.")
    beside = {path: value for path, value in changes.items() if last not in path.split(".")}
    told = {name: conditions(load_scene("plane", own)).to_json() for name, own in (("a", changes), ("b", beside))}
    offset = FLAT | {"eps_over_d": 0.05}
    parts = (rows_of("cone_axis", [1.0], setting, **offset) for setting in told)
    assert len(guide_from(*parts, conditions=told).advice) == 2


def test_what_is_not_told_of_the_light_and_the_lobe_set_situations_apart():
    found = conditions(load_scene("plane", {"rig.emission_known": False}))
    assert (found.emission, found.reflectance) == ("emission not told", "Phong lobe")
    told = {"a": found.to_json(), "b": conditions(load_scene("plane")).to_json(),
            "c": conditions(load_scene("plane", {"reflectance.type": "rough_conductor"})).to_json()}  # fmt: skip
    guide = guide_from(*(rows_of("cone_axis", [1.0], name) for name in told), conditions=told)
    assert {each.situation.circumstances for each in guide.advice} == {
        "Phong lobe, emission not told", "Phong lobe", "rough conductor"
    }  # fmt: skip
