"""Names and descriptions of a scene's keys."""

import pytest

from simtest.spec.keys import describe_key, name_key


@pytest.mark.parametrize(
    ("path", "part"),
    [
        ("sensor.noise_sigma", "share of full scale"),
        ("surface.radius_mm", "radius"),
        ("rig.lights.0.offset_mm", "distance from the camera"),
        ("render.path_depth", "direct light"),
        ("sensor.exposure.gain", ""),
        ("reflectance.exponent", "roughness exponent"),
    ],
)
def test_keys_are_described_through_unions_references_and_arrays(path, part):
    assert describe_key(path)
    assert part in describe_key(path)


def test_unknown_keys_have_no_description():
    assert describe_key("sensor.nothing") == describe_key("") == describe_key("a.b.c") == ""


def test_names_carry_their_unit():
    assert name_key("surface.tilt_deg") == "tilt (deg)"
    assert name_key("surface.k1_per_mm") == "k1 (1/mm)"
    assert name_key("sensor.noise_sigma") == "noise sigma"
