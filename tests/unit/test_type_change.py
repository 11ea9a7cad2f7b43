"""A setting that gives a table another type, and messages that name keys as the user wrote them."""

import pytest

from simtest.errors import InputError
from simtest.spec import load_calibration, load_experiment, load_scene
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
