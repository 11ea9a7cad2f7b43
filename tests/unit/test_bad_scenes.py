"""Malformed scene files and values of --set: one line that names the place, the value and what is allowed."""

import os
import tomllib

import pytest

from simtest.spec import load_camera, load_experiment, load_scene, parse_settings, scene_from_dict
from simtest.surfaces.recipe import load_recipe
from tests.refusals import refused

# Scenes ----------------------------------------------------------------------------------------------------------

PLANE = '[surface]\ntype = "plane"\n'
SPHERE = '[surface]\ntype = "sphere"\n'
PHONG = PLANE + '[reflectance]\ntype = "phong"\n'
TISSUE = PLANE + '[reflectance]\ntype = "tissue"\nfilm = {index = 1.36}\n'
FILM = PLANE + '[reflectance]\ntype = "tissue"\n[reflectance.film]\n'
WET = FILM + "index = 1.36\n"
RELIEF = "\n[[surface.relief.bands]]\nslope_deg = 4\nwavelength_mm = 1"
COLOURED = PHONG + "[reflectance.albedo]\n"
LIGHT = PLANE + "[[rig.lights]]\n"
CAMERA = PLANE + "[camera]\n"
ANATOMY = '[surface]\ntype = "anatomy"\npath = "colon"\n'

SCENES = {
    "unknown key": (PLANE + "distance = 3", "surface.distance = 3: unknown key; allowed: distance_mm, relief, "),
    "unknown table": ("[lamp]\n" + PLANE, "lamp = {}: unknown key; allowed: name, surface, reflectance"),
    "unknown type": ('[surface]\ntype = "cone"', "surface.type = 'cone': unknown; allowed: anatomy, cylinder, plane"),
    "type a number": ("[surface]\ntype = 5", "surface.type = 5: unknown; allowed: anatomy, cylinder, plane"),
    "no type": (PLANE + "[reflectance]\nexponent = 3", "reflectance.type: missing; allowed: phong, principled"),
    "no surface": ('name = "x"', "surface: missing"),
    "surface a number": ("surface = 5", "surface = 5: must be a table"),
    "missing curvatures": ('[surface]\ntype = "quadric"', "surface.k1_per_mm: missing; it must be given (and 1 more)"),
    "list for a number": (PLANE + "distance_mm = [1]", "surface.distance_mm = [1]: must be a valid number"),
    "text for a number": (PLANE + 'distance_mm = "ten"', "surface.distance_mm = 'ten': must be a number"),
    "digits in quotes": (PLANE + 'distance_mm = "10"', "surface.distance_mm = '10': must be a number"),
    "true for a number": (PLANE + "distance_mm = true", "surface.distance_mm = True: must be a number"),
    "date for a number": (PLANE + "distance_mm = 2024-01-01", "surface.distance_mm = datetime.date(2024"),
    "number for true": (PHONG + "normalised = 1", "reflectance.normalised = 1: must be true or false"),
    "more light than arrives": (PHONG + "normalised = true\ndiffuse = 0.3", "a diffuse base of 0.3 reflect more light"),
    "number for text": ("name = 5\n" + PLANE, "name = 5: must be a valid string"),
    "unknown tissue": (COLOURED + 'preset = "skin"', "albedo.preset = 'skin': must be 'colon_mucosa'"),
    "tissue a text": (PHONG + 'albedo = "liver"', "reflectance.albedo = 'liver': must be a table"),
    "tissue a list": (PHONG + "albedo = [1]", "reflectance.albedo = [1]: must be a table"),
    "tissue and diffuse": (PHONG + "diffuse = 0.3\nalbedo = {}", "diffuse and albedo exclude each other"),
    "tissue and colour": (PHONG + "colour = [1, 0.5, 0.5]\nalbedo = {}", "colour and albedo exclude each other"),
    "tissue brighter than arrives": (COLOURED + "base = [1.2, 0.3, 0.2]", "albedo.base.0 = 1.2: must be less"),
    "tissue without blood": (COLOURED + "blood = 0", "albedo.blood = 0: must be greater than or equal"),
    "negative mottling": (COLOURED + "mottling = {amplitude = -0.1}", "mottling.amplitude = -0.1: must be greater"),
    "mottling a number": (COLOURED + "mottling = 0.1", "reflectance.albedo.mottling = 0.1: must be a table"),
    "unknown key of vessels": (COLOURED + "vessels = {radius = 1}", "vessels.radius = 1: unknown key; allowed: l"),
    "calibres turned round": (COLOURED + "vessels = {smallest_mm = 0.6}", "largest_mm = 0.5 and smallest_mm = 0.6"),
    "too many calibres": (COLOURED + "vessels = {smallest_mm = 0.01}", "more than the smallest and at most 30 times"),
    "vessels too near": (COLOURED + "vessels = {spacing_mm = 0.3}", "vessels must not be wider than their spacing"),
    "vessels too deep": (COLOURED + "vessels = {depth_mm = 9}", "vessels.depth_mm = 9: must be less than or"),
    "NaN for a calibre": (COLOURED + "vessels = {largest_mm = nan}", "largest_mm = nan: must be a finite number"),
    "text for a saturation": (COLOURED + 'vessels = {venous_saturation = "0.7"}', "= '0.7': must be a number"),
    "endless capillaries": (COLOURED + "capillaries = {spacing_mm = 0}", "capillaries.spacing_mm = 0: must be greater"),
    "negative seed of tissue": (COLOURED + "seed = -1", "reflectance.albedo.seed = -1: must be greater than or equal"),
    "empty name": ('name = ""\n' + PLANE, "name = '': must have at least 1 character"),
    "NaN": (PLANE + "distance_mm = nan", "surface.distance_mm = nan: must be a finite number"),
    "infinity": (PLANE + "distance_mm = -inf", "surface.distance_mm = -inf: must be a finite number"),
    "400 digits": (PLANE + "distance_mm = 1" + "0" * 400, "surface.distance_mm = 1000", "...: must be"),
    "distance 0": (PLANE + "distance_mm = 0", "surface.distance_mm = 0: must be greater than or equal to 0.001"),
    "distance negative": (PLANE + "distance_mm = -2.5", "surface.distance_mm = -2.5: must be greater than"),
    "distance huge": (PLANE + "distance_mm = 1e7", "surface.distance_mm = 10000000.0: must be less than or equal to"),
    "tilt 90": (PLANE + "tilt_deg = 90", "surface.tilt_deg = 90: must be less than 90"),
    "tilt negative": (PLANE + "tilt_deg = -1", "surface.tilt_deg = -1: must be greater than or equal to 0"),
    "radius 0": (SPHERE + "radius_mm = 0", "surface.radius_mm = 0: must be greater than"),
    "radius negative": (SPHERE + "radius_mm = -4", "surface.radius_mm = -4: must be greater than"),
    "radius huge": (SPHERE + "radius_mm = 1e300", "surface.radius_mm = 1e+300: must be less than or equal to"),
    "unknown side": (SPHERE + 'side = "left"', "surface.side = 'left': must be 'outside' or 'inside'"),
    "camera outside": (
        SPHERE + 'side = "inside"\nradius_mm = 5\ndistance_mm = 10',
        "distance_mm = 10 puts the camera outside a radius of 5 mm; must be small enough",
    ),
    "camera outside by tilt": (
        SPHERE.replace("sphere", "cylinder") + 'side = "inside"\nradius_mm = 6\ndistance_mm = 10\ntilt_deg = 60',
        "must be small enough for the camera to lie inside",
    ),
    "curvature": ('[surface]\ntype = "quadric"\nk1_per_mm = 11\nk2_per_mm = 0', "k1_per_mm = 11: must be less than"),
    "viewpoint negative": (ANATOMY + "viewpoint = -1", "surface.viewpoint = -1: must be greater than or equal to 0"),
    "unknown kind": (ANATOMY + 'kind = "gut"', "surface.kind = 'gut': must be 'auto', 'lumen' or 'organ'"),
    "subdivisions": (ANATOMY + "subdivisions = 4", "surface.subdivisions = 4: must be less than or equal to 3"),
    "empty path": (ANATOMY.replace("colon", ""), "surface.path = '': must have at least 1 character"),
    "exponent 0": (PHONG + "exponent = 0", "reflectance.exponent = 0: must be greater than 0"),
    "exponent negative": (PHONG + "exponent = -50.0", "reflectance.exponent = -50.0: must be greater than 0"),
    "another type's key": (PHONG + "alpha = 0.2", "reflectance.alpha = 0.2: unknown key; allowed: diffuse, colour"),
    "no film": (PLANE + '[reflectance]\ntype = "tissue"', "reflectance.film: missing; it must be given"),
    "film without index": (FILM + "alpha = 0.03", "reflectance.film.index: missing; it must be given"),
    "film of glass": (FILM + "index = 1.5", "reflectance.film.index = 1.5: must be less than or equal to 1.4"),
    "film of air": (FILM + "index = 1.0", "reflectance.film.index = 1.0: must be greater than or equal to 1.33"),
    "film too rough": (WET + "alpha = 0.5", "reflectance.film.alpha = 0.5: must be less than or equal to 0.1"),
    "film too smooth": (WET + "alpha = 0.001", "reflectance.film.alpha = 0.001: must be greater than or equal to 0.01"),
    "film of Phong": (WET + 'distribution = "phong"', "film.distribution = 'phong': must be 'beckmann' or 'ggx'"),
    "level without relief": (WET + "level = 0.5", "reflectance.film.level = 0.5: there are no valleys to fill"),
    "level too high": (WET + "level = 4" + RELIEF, "reflectance.film.level = 4: must be less than or equal to 3"),
    "level NaN": (WET + "level = nan" + RELIEF, "reflectance.film.level = nan: must be a finite number"),
    "level in quotes": (WET + 'level = "high"' + RELIEF, "reflectance.film.level = 'high': must be a number"),
    "film a number": (TISSUE.replace("{index = 1.36}", "1.36"), "reflectance.film = 1.36: must be a table"),
    "film misspelt": (WET + "roughness = 0.1", "reflectance.film.roughness = 0.1: unknown key; allowed: index, alpha"),
    "film of Phong's": (PHONG + "film = {index = 1.36}", "reflectance.film = {'index': 1.36}: unknown key; allowed:"),
    "exponent of tissue": (TISSUE + "exponent = 50", "reflectance.exponent = 50: unknown key; allowed: diffuse"),
    "tissue too bright": (TISSUE + "diffuse = 1.2", "reflectance.diffuse = 1.2: must be less than or equal to 1"),
    "colour over 1": (PHONG + "colour = [0.5, 1.5, 0.5]", "reflectance.colour.1 = 1.5: must be less than or"),
    "colour of two": (PHONG + "colour = [1, 0]", "reflectance.colour.2: missing"),
    "colour in quotes": (PHONG + 'colour = ["1", 0, 0]', "reflectance.colour = ['1', 0, 0]: must be numbers"),
    "colour a number": (PHONG + "colour = 1", "reflectance.colour = 1: must be a list"),
    "no lights": (PLANE + "[rig]\nlights = []", "rig.lights = []: must have at least 1 item"),
    "33 lights": (PLANE + "[[rig.lights]]\n" * 33, "rig.lights = [{}, {}", "...: must have at most 32 items"),
    "lights a table": (PLANE + "[rig.lights]\npower = 1", "rig.lights = {'power': 1}: must be a list"),
    "light placed twice": (LIGHT + "position_mm = [1, 0, 0]\noffset_mm = 1", "position_mm and offset_mm exclude each"),
    "position of two": (LIGHT + "position_mm = [1, 0]", "rig.lights.0.position_mm.2: missing; it must be given"),
    "position of four": (LIGHT + "position_mm = [1, 0, 0, 0]", "position_mm = [1, 0, 0, 0]: must have at most 3 items"),
    "power negative": (LIGHT + "power = -1", "rig.lights.0.power = -1: must be greater than 0"),
    "offset negative": (LIGHT + "offset_mm = -1", "rig.lights.0.offset_mm = -1: must be greater than or equal to 0"),
    "width 0": (CAMERA + "width = 0", "camera.width = 0: must be greater than or equal to 1"),
    "width negative": (CAMERA + "width = -406", "camera.width = -406: must be greater than or equal to 1"),
    "width fractional": (CAMERA + "width = 10.5", "camera.width = 10.5: must be a valid integer"),
    "width in quotes": (CAMERA + 'width = "406"', "camera.width = '406': must be a number"),
    "width huge": (CAMERA + "width = 1000000", "camera.width = 1000000: must be less than or equal to 16384"),
    "K singular": (CAMERA + "fx = 0", "camera.fx = 0: must be greater than"),
    "fy negative": (CAMERA + "fy = -406", "camera.fy = -406: must be greater than"),
    "cx NaN": (CAMERA + "cx = nan", "camera.cx = nan: must be a finite number"),
    "noise negative": (PLANE + "[sensor]\nnoise_sigma = -0.1", "sensor.noise_sigma = -0.1: must be greater than"),
    "samples 0": (PLANE + "[render]\nsamples_per_pixel = 0", "render.samples_per_pixel = 0: must be greater than"),
    "path depth 1": (PLANE + "[render]\npath_depth = 1", "render.path_depth = 1: must be greater than or equal to 2"),
    "seed negative": (PLANE + "[render]\nseed = -1", "render.seed = -1: must be greater than or equal to 0"),
    "line break in a key": ('"a\\nb" = 1\n' + PLANE, r"a\nb = 1: unknown key"),
    "endless key": ("k" * 5000 + " = 1\n" + PLANE, "kkk...kkk", "kkk = 1: unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    text, *fragments = SCENES[name]
    refused(lambda: scene_from_dict(tomllib.loads(text), "my.toml"), "my.toml: ", *fragments)


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
