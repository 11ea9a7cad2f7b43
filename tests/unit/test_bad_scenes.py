"""Malformed scene files and values of --set: one line that names the place, the value and what is allowed."""

import os
import tomllib
from pathlib import Path

import pytest

from simtest.spec import load_camera, load_experiment, load_scene, parse_settings, scene_from_dict
from simtest.surfaces import make_surface
from simtest.surfaces.recipe import load_recipe
from tests.refusals import refused

# Scenes ----------------------------------------------------------------------------------------------------------

PLANE = '[surface]\ntype = "plane"\n'
SPHERE = '[surface]\ntype = "sphere"\n'
PHONG = PLANE + '[reflectance]\ntype = "phong"\n'
TISSUE = PLANE + '[reflectance]\ntype = "tissue"\nfilm = {index = 1.36}\n'
FILM = PLANE + '[reflectance]\ntype = "tissue"\n[reflectance.film]\n'
WET = FILM + "index = 1.36\n"
BAND = PLANE + "[[surface.relief.bands]]\n"
RELIEF = "\n[[surface.relief.bands]]\nslope_deg = 4\nwavelength_mm = 1"
COLOURED = PHONG + "[reflectance.albedo]\n"
LIGHT = PLANE + "[[rig.lights]]\n"
CAMERA = PLANE + "[camera]\n"
ANATOMY = '[surface]\ntype = "anatomy"\npath = "colon"\n'

SCENES = {
    "unknown key": (PLANE + "distance = 3", "surface.distance = 3: unknown key; allowed: distance_mm, relief, "),
    "unknown type": ('[surface]\ntype = "cone"', "surface.type = 'cone': unknown; allowed: anatomy, cylinder, plane"),
    "no type": (PLANE + "[reflectance]\nexponent = 3", "reflectance.type: missing; allowed: phong, principled"),
    "missing curvatures": ('[surface]\ntype = "quadric"', "surface.k1_per_mm: missing; it must be given (and 1 more)"),
    "list for a number": (PLANE + "distance_mm = [1]", "surface.distance_mm = [1]: must be a valid number"),
    "digits in quotes": (PLANE + 'distance_mm = "10"', "surface.distance_mm = '10': must be a number"),
    "true for a number": (PLANE + "distance_mm = true", "surface.distance_mm = True: must be a number"),
    "date for a number": (PLANE + "distance_mm = 2024-01-01", "surface.distance_mm = datetime.date(2024"),
    "number for true": (PHONG + "normalised = 1", "reflectance.normalised = 1: must be true or false"),
    "more light than arrives": (PHONG + "normalised = true\ndiffuse = 0.3", "a diffuse base of 0.3 reflect more light"),
    "number for text": ("name = 5\n" + PLANE, "name = 5: must be a valid string"),
    "unknown tissue": (COLOURED + 'preset = "skin"', "albedo.preset = 'skin': must be 'colon_mucosa'"),
    "tissue a text": (PHONG + 'albedo = "liver"', "reflectance.albedo = 'liver': must be a table"),
    "tissue and diffuse": (PHONG + "diffuse = 0.3\nalbedo = {}", "diffuse and albedo exclude each other"),
    "tissue and colour": (PHONG + "colour = [1, 0.5, 0.5]\nalbedo = {}", "colour and albedo exclude each other"),
    "negative mottling": (COLOURED + "mottling = {amplitude = -0.1}", "mottling.amplitude = -0.1: must be greater"),
    "calibres turned round": (COLOURED + "vessels = {smallest_mm = 0.6}", "largest_mm = 0.5 and smallest_mm = 0.6"),
    "too many calibres": (COLOURED + "vessels = {smallest_mm = 0.01}", "more than the smallest and at most 30 times"),
    "vessels too near": (COLOURED + "vessels = {spacing_mm = 0.3}", "vessels must not be wider than their spacing"),
    "empty name": ('name = ""\n' + PLANE, "name = '': must have at least 1 character"),
    "NaN": (PLANE + "distance_mm = nan", "surface.distance_mm = nan: must be a finite number"),
    "400 digits": (PLANE + "distance_mm = 1" + "0" * 400, "surface.distance_mm = 1000", "...: must be"),
    "distance 0": (PLANE + "distance_mm = 0", "surface.distance_mm = 0: must be greater than or equal to 0.001"),
    "unknown side": (SPHERE + 'side = "left"', "surface.side = 'left': must be 'outside' or 'inside'"),
    "camera outside": (
        SPHERE + 'side = "inside"\nradius_mm = 5\ndistance_mm = 10',
        "distance_mm = 10 puts the camera outside a radius of 5 mm; must be small enough",
    ),
    "camera outside by tilt": (
        SPHERE.replace("sphere", "cylinder") + 'side = "inside"\nradius_mm = 6\ndistance_mm = 10\ntilt_deg = 60',
        "must be small enough for the camera to lie inside",
    ),
    "another type's key": (PHONG + "alpha = 0.2", "reflectance.alpha = 0.2: unknown key; allowed: diffuse, colour"),
    "level without relief": (WET + "level = 0.5", "reflectance.film.level = 0.5: there are no valleys to fill"),
    "colour in quotes": (PHONG + 'colour = ["1", 0, 0]', "reflectance.colour = ['1', 0, 0]: must be numbers"),
    "33 lights": (PLANE + "[[rig.lights]]\n" * 33, "rig.lights = [{}, {}", "...: must have at most 32 items"),
    "lights a table": (PLANE + "[rig.lights]\npower = 1", "rig.lights = {'power': 1}: must be a list"),
    "light placed twice": (LIGHT + "position_mm = [1, 0, 0]\noffset_mm = 1", "position_mm and offset_mm exclude each"),
    "position of two": (LIGHT + "position_mm = [1, 0]", "rig.lights.0.position_mm.2: missing; it must be given"),
    "width fractional": (CAMERA + "width = 10.5", "camera.width = 10.5: must be a valid integer"),
    "slope 60": (BAND + "slope_deg = 60\nwavelength_mm = 1", "surface.relief.bands.0.slope_deg = 60: must be less"),
    "wavelength in deg": (BAND + "slope_deg = 4\nwavelength_deg = 1", "surface.relief.bands.0.wavelength"),
    "too high": (BAND + "slope_deg = 10\nwavelength_mm = 5", "a relief of about 0.72 mm", "must stay below 0.3 mm"),
    "too high together": (BAND + "slope_deg = 6\nwavelength_mm = 3.2" + 3 * (RELIEF + ".5"), "must stay below 0.3 mm"),
    "pits too deep": (BAND + 'slope_deg = 6\nwavelength_mm = 1.5\nkind = "pits"', "a relief of about 0.38 mm"),
    "zero direction": (PLANE + RELIEF + "\ndirection = [0, 0, 0]", "bands.0: direction = [0.0, 0.0, 0.0]: must have a"),
    "line break in a key": ('"a\\nb" = 1\n' + PLANE, r"a\nb = 1: unknown key"),
    "endless key": ("k" * 5000 + " = 1\n" + PLANE, "kkk...kkk", "kkk = 1: unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    text, *fragments = SCENES[name]
    refused(lambda: scene_from_dict(tomllib.loads(text), "my.toml"), "my.toml: ", *fragments)


MESH = Path(__file__).resolve().parents[2] / "meshes" / "colon_40mm.ply"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*inside out")
def test_waves_that_a_mesh_holds_itself():
    def surface(wavelength, **values):
        relief = {"bands": [{"slope_deg": 1, "wavelength_mm": 1.0}, {"slope_deg": 1, "wavelength_mm": wavelength}]}
        return {"type": "anatomy", "path": str(MESH), "relief": relief, **values}

    def make(**values):
        return make_surface(scene_from_dict({"surface": surface(**values)}).surface)

    refused(
        lambda: make(wavelength=5.0),
        "surface.relief.bands.1.wavelength_mm = 5: ",
        "colon_40mm.ply holds waves from 2.4 mm on itself (two of its median edges, or smoothing_mm)",
    )
    # Waves below the mesh's own lie in the normal alone and need no triangles; smoothing makes room for longer ones.
    assert make(wavelength=0.1).relief is not None
    assert make(wavelength=5.0, smoothing_mm=6.0).relief is not None


FILES = {
    "empty": (b"", "surface: missing"),
    "not TOML": (b"distance = = 3", "not valid TOML: Invalid value (at line 1, column 12)"),
    "table twice": (PLANE.encode() * 2, "not valid TOML: Cannot declare"),
    "not UTF-8": (b'name = "caf\xe9"', "not a text file in UTF-8 (byte 11)"),
    "binary": (bytes(range(256)) * 4, "not a text file in UTF-8 (byte 128)"),
    "zero bytes": (bytes(100), "not valid TOML"),
    "2 MB": (b"#" * 2_000_000, "2000000 bytes; at most 1000000 are allowed (SIMTEST_LIMITS=text_bytes=N"),
    "deeply nested": (b"a = " + b"[" * 100_000, "not valid TOML: nested too deeply"),
    "5000 digits": (b"a = " + b"1" * 5000, "not valid TOML: a number has too many digits"),
}


@pytest.mark.parametrize("load", [load_scene, load_experiment, load_camera, load_recipe])
@pytest.mark.parametrize("name", FILES)
def test_files(tmp_path, name, load):
    data, fragment = FILES[name]
    path = tmp_path / "my.toml"
    path.write_bytes(data)
    wanted = {load_experiment: "groups: missing", load_camera: "width: missing", load_recipe: "type: missing"}
    refused(lambda: load(path), f"{path}: ", wanted.get(load, fragment) if name == "empty" else fragment)


@pytest.mark.parametrize("load", [load_scene, load_experiment, load_camera, load_recipe])
def test_what_is_no_file(tmp_path, load):
    refused(lambda: load(tmp_path), f"{tmp_path}: is a folder")
    refused(lambda: load(tmp_path / "none.toml"), "none.toml: ", "no such file")
    refused(lambda: load("n" * 5000), "nnn...nnn", "File name too long")
    refused(lambda: load("a\nb"), r"a\nb: ")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    # Reading it would wait for ever.
    refused(lambda: load(pipe), f"{pipe}: ", "is no plain file but a pipe")


NAMED = {load_scene: "anatomy, cylinder, plane", load_experiment: "anatomy, anatomy_sensor, camera, colon, compare"}


@pytest.mark.parametrize("load", NAMED)
def test_unknown_names_list_the_shipped_ones(load):
    refused(lambda: load("plain"), f"plain: no such file; shipped by name: {NAMED[load]}")
    refused(lambda: load(""), ".: is a folder")
    refused(lambda: load("~nobody-of-this-name/x.toml"), "~nobody-of-this-name/x.toml: no such home folder")


# --set -----------------------------------------------------------------------------------------------------------

SETTINGS = {
    "surface.distance_mm": "--set surface.distance_mm: must be key=value, for example surface.distance_mm=12",
    "=3": "--set =3: must be key=value",
    "a\nb": r"--set a\nb: must be key=value",
    "surface.distance_mm=": "surface.distance_mm = '': must be a number",
    "surface.distance_mm=ten": "surface.distance_mm = 'ten': must be a number",
    "surface.distance_mm=nan": "surface.distance_mm = nan: must be a finite number",
    "surface.distance_mm=1\nfoo=2": r"surface.distance_mm = '1\nfoo=2': must be a number",
    "camera.width=" + "[" * 100_000: "camera.width = '[[[",
    "camera.width=" + "9" * 5000: "camera.width = '999",
    "surface.typo=1": "surface.typo = 1: unknown key; allowed: type, relief, distance_mm",
    "surface..x=1": "surface.'' = {'x': 1}: unknown key",
    "surface.distance_mm.x=1": "surface.distance_mm.x: surface.distance_mm is a plain value, not a table",
    "surface.distance_mm.x.y=1": "surface.distance_mm.x.y: x is below a plain value, not a table",
    "rig.lights.1.power=2": "rig.lights.1.power: index 1 is not allowed; the first item is 0",
    "reflectance.colour.3=1": "reflectance.colour.3: index 3 is not allowed; the list has items 0 to 2",
    "reflectance.colour.-1=1": "reflectance.colour.-1: index -1 is not allowed; the list has items 0 to 2",
    "reflectance.colour.²=1": "reflectance.colour.²: index ² is not allowed",
    "rig.lights.first.power=2": "rig.lights = {'first': {'power': 2}}: must be a list",
    "rig.lights.0=5": "rig.lights.0 = 5: must be a table",
    "sensor=": "sensor = '': must be a table",
}


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda text: text[:30].encode("unicode_escape").decode())
def test_settings(setting):
    given = ["reflectance.colour=[1, 1, 1]", setting]
    refused(lambda: load_scene("plane", parse_settings(given)), SETTINGS[setting])


def test_an_empty_list_has_no_index():
    refused(lambda: load_scene("plane", {"rig.lights": [], "rig.lights.0.power": 2}), "the list has no items")
