"""A setting that gives a table another type, and messages that name keys as the user wrote them."""

from functools import reduce

import pytest

from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec import Scene, load_calibration, load_dataset, load_experiment, load_scene, read_toml
from simtest.spec.keys import replace_values
from simtest.spec.scene import scene_from_dict
from simtest.spec.toml_files import apply_settings
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
])  # fmt: skip
def test_a_key_that_is_set_replaces_what_it_excludes(settings, key, rivals, tmp_path):
    """But for the camera's focal length, such a key was refused over a file that has the other."""
    value = [{"offset_mm": 2.0}] if key == "rig.lights" else 1.5
    data = apply_settings(read_toml(find("plane", "scenes")), settings, "plane")
    replaced = replace_values(Scene, data, {key: value}, "plane")
    scene_from_dict(replaced)
    for rival in rivals:
        *parents, name = rival.split(".")
        assert name not in reduce(dict.__getitem__, parents, replaced)
    # Both together are refused as ever.
    both = {key: value, rivals[0]: reduce(dict.__getitem__, rivals[0].split("."), data)}
    refused(lambda: load_scene("plane", both), "exclude each other")


def test_a_preset_of_lights_replaces_a_list_of_them():
    assert len(load_scene("plane", {"rig.lights": [{}]}).rig.lights) == 1
    path = find("plane", "scenes")
    data = apply_settings(read_toml(path), {"rig.lights": [{"offset_mm": 1.0}]}, "plane")
    assert len(scene_from_dict(replace_values(Scene, data, {"rig.preset": "laparoscope"}, "plane")).rig.lights) == 8


def test_a_setting_replaces_what_it_excludes_of_a_group_too():
    """These keys were replaced in the scene's file alone: with a group's or family's they were refused."""
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


@pytest.mark.parametrize("value", ["-1.0", "'steep'", "90.0", "{ low = 3.0 }", "[1.0]"])
def test_messages_name_the_key_and_not_the_member_of_a_union(tmp_path, value):
    path = tmp_path / "c.toml"
    path.write_text(f"[camera]\nwidth = 64\nheight = 48\nfx = 50.0\nfy = 50.0\n[surface]\nrelief_slope_deg = {value}\n")
    with pytest.raises(InputError) as caught:
        load_calibration(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: surface.relief_slope_deg")
    assert "constrained" not in said
    assert "Interval" not in said
