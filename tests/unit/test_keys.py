"""Keys of a scene: what a setting replaces, how messages name them, their descriptions, and values as TOML."""

import tomllib
from functools import reduce

import pytest

from simtest.dataset.plan import Plan
from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec import Scene, load_calibration, load_dataset, load_experiment, load_scene, read_toml
from simtest.spec.keys import describe_key, name_key, replace_values
from simtest.spec.scene import scene_from_dict
from simtest.spec.sensor import Exposure
from simtest.spec.toml_files import apply_settings, toml_tables, toml_value
from simtest.validation.cases import expand
from tests.refusals import refused


def test_keys_of_the_former_type_go():
    plane = load_scene("plane")
    assert plane.reflectance.type == "phong"
    changed = load_scene("plane", {"reflectance.type": "rough_plastic", "reflectance.alpha": 0.2})
    assert (changed.reflectance.type, changed.reflectance.alpha) == ("rough_plastic", 0.2)
    ball = load_scene("plane", {"surface.type": "sphere", "surface.radius_mm": 7.0})
    # What both have stays.
    assert (ball.surface.distance_mm, ball.surface.radius_mm) == (plane.surface.distance_mm, 7.0)
    # The same type changes nothing.
    assert load_scene("plane", {"reflectance.type": "phong"}) == plane


def test_a_key_of_the_former_type_that_is_set_is_refused():
    settings = {"reflectance.type": "rough_plastic", "reflectance.exponent": 40}
    refused(lambda: load_scene("plane", settings), "reflectance.exponent = 40: unknown key; allowed: ", "alpha")
    refused(lambda: load_scene("plane", {"reflectance.type": "tissue"}), "reflectance.film: missing")
    refused(lambda: load_scene("plane", {"reflectance.type": 3}), "reflectance.type = 3: unknown; allowed: phong")


def test_an_experiment_of_another_type(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text("[[groups]]\nscene = 'plane'\nset = { 'reflectance.exponent' = 80.0 }\n")
    described = load_experiment(path, {"reflectance.type": "rough_conductor"})
    refused(lambda: expand(described), "reflectance.exponent = 80.0: unknown key; allowed: ")
    path.write_text("[[groups]]\nscene = 'plane'\n")
    (case,) = expand(load_experiment(path, {"reflectance.type": "rough_conductor"}))
    assert case.data["reflectance"]["type"] == "rough_conductor"
    assert "exponent" not in case.data["reflectance"]


@pytest.mark.parametrize(("settings", "key", "rivals"), [
    ({"sensor.exposure.average": 0.4}, "sensor.exposure.percentile", ["sensor.exposure.average"]),
    ({"sensor.exposure.percentile": 99.0}, "sensor.exposure.full_scale", ["sensor.exposure.percentile"]),
    ({"known.distance_mm": 9.0}, "known.distance_error", ["known.distance_mm"]),
    ({"known.distance_error": 0.1}, "known.distance_mm", ["known.distance_error"]),
    ({"rig": {"preset": "laparoscope", "radius_mm": 3.0}}, "rig.lights", ["rig.preset", "rig.radius_mm"]),
    ({"rig.lights": [{"offset_mm": 1.0}]}, "rig.preset", ["rig.lights"]),
])  # fmt: skip
def test_a_key_that_is_set_replaces_what_it_excludes(settings, key, rivals):
    value = {"rig.lights": [{"offset_mm": 2.0}], "rig.preset": "laparoscope"}.get(key, 1.5)
    data = apply_settings(read_toml(find("plane", "scenes")), settings, "plane")
    replaced = replace_values(Scene, data, {key: value}, "plane")
    scene_from_dict(replaced)
    for rival in rivals:
        *parents, name = rival.split(".")
        assert name not in reduce(dict.__getitem__, parents, replaced)
    both = {key: value, rivals[0]: reduce(dict.__getitem__, rivals[0].split("."), data)}
    refused(lambda: load_scene("plane", both), "exclude each other")


def test_a_setting_replaces_what_it_excludes_of_a_group_too():
    cases = expand(load_experiment("compare", {"known.distance_mm": 20.0}))
    assert not [case for case in cases if "known.distance_error" in case.data["known"]]
    # What lies below such a key goes as well.
    cases = expand(load_experiment("known_light", {"rig.preset": "laparoscope"}))
    assert {len(scene_from_dict(case.data).rig.lights) for case in cases} == {8}
    families = load_dataset("tiny", {"camera.fov_deg": 90.0}).families
    assert all("camera.fx" not in family.set and "camera.width" in family.set for family in families)


def test_what_excludes_a_drawn_value_fixes_it_too():
    dataset = load_dataset("endoscopy", {"sensor.exposure.percentile": 99.0})
    assert not [key for family in dataset.families for key in family.per_sample if key.startswith("sensor.exposure")]
    assert Plan(dataset).draw(0).scene.sensor.exposure == Exposure(percentile=99.0)


@pytest.mark.parametrize("value", ["-1.0", "'steep'", "{ low = 3.0 }"])
def test_messages_name_the_key_and_not_the_member_of_a_union(tmp_path, value):
    path = tmp_path / "c.toml"
    path.write_text(f"[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\n[surface]\nrelief_slope_deg = {value}\n")
    with pytest.raises(InputError) as caught:
        load_calibration(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: surface.relief_slope_deg")
    assert "constrained" not in said
    assert "Interval" not in said


# Names and descriptions ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "part"),
    [
        ("sensor.noise_sigma", "share of full scale"),
        ("surface.radius_mm", "radius"),
        ("rig.lights.0.offset_mm", "distance from the camera"),
        ("reflectance.exponent", "roughness exponent"),
    ],
)
def test_keys_are_described_through_unions_references_and_arrays(path, part):
    assert part in describe_key(path)


def test_unknown_keys_have_no_description():
    assert describe_key("sensor.nothing") == describe_key("") == describe_key("a.b.c") == ""


def test_names_carry_their_unit():
    assert name_key("surface.tilt_deg") == "tilt (deg)"
    assert name_key("surface.k1_per_mm") == "k1 (1/mm)"
    assert name_key("sensor.noise_sigma") == "noise sigma"


# TOML ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["caf\u00e9 \U0001f52c", 'quote " and \\\\ and\ttab', "\x00\x1f\x7f\x80\n", ""])
def test_text_reads_back(text):
    assert tomllib.loads(f"value = {toml_value(text)}") == {"value": text}


def test_what_is_none_is_left_out():
    assert tomllib.loads(toml_tables({"a": {"x": None, "y": {"z": None, "w": 1}}, "b": {"v": [True, 1.5]}})) == {
        "a": {"y": {"w": 1}}, "b": {"v": [True, 1.5]},
    }  # fmt: skip


def test_a_size_that_changes_the_field_of_view_is_warned_of():
    told = (
        r"tissue_colon\.toml: camera\.width: the field of view across the width changes from 90 to 53\.13 deg, since "
        r"fx and fy stay; to keep it set camera\.fov_deg=90$"
    )
    with pytest.warns(UserWarning, match=told) as caught:
        cropped = load_scene("tissue_colon", {"camera.width": 320, "camera.height": 240}).camera
    assert (len(caught), cropped.fx) == (1, 320.0)
    with pytest.warns(UserWarning, match=r"across the height .* set camera\.fov_deg=73\.74 and camera\.fov_of=height$"):
        load_scene("tissue_colon", {"camera.height": 240})
    # What is advised keeps it, and so does a focal length; both without a word, as warnings are errors here.
    kept = load_scene("tissue_colon", {"camera.width": 320, "camera.height": 240, "camera.fov_deg": 90}).camera
    assert kept.fx == pytest.approx(160.0)
    load_scene("tissue_colon", {"camera.width": 320, "camera.fx": 160.0, "camera.fy": 160.0})
