"""Malformed input gives one line that names the place, the value and what is allowed; ill-posed data gives a value."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest

from simtest.calibration import Calibration, Response
from simtest.errors import Failure, Reason
from simtest.estimators import load_estimators
from simtest.geometry import Camera
from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, reconstruct
from simtest.spec import load_camera, load_experiment, load_scene, parse_settings, scene_from_dict
from simtest.spec.surface import AnatomySurface
from simtest.surfaces import make_surface
from simtest.surfaces.recipe import load_recipe
from simtest.validation import realisation, runner
from simtest.validation.cases import expand
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
    "line break in a key": ('"a\\nb" = 1\n' + PLANE, r"'a\nb' = 1: unknown key"),
    "endless key": ("k" * 5000 + " = 1\n" + PLANE, "kkk... = 1: unknown key"),
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
    "2 MB": (b"#" * 2_000_000, "2000000 bytes; a TOML file of at most 1000000 is allowed"),
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
    refused(lambda: load(tmp_path / "none.toml"), "none.toml: ", "no such file" if load in NAMED else "No such file")
    refused(lambda: load("n" * 5000), "nnn...: cannot be read (File name too long)")
    refused(lambda: load("a\nb"), r"'a\nb': ")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    # Reading it would wait for ever.
    refused(lambda: load(pipe), f"{pipe}: ", "no such file" if load in NAMED else "is no plain file")


NAMED = {load_scene: "anatomy, cylinder, plane", load_experiment: "anatomy, anatomy_sensor, camera, colon, compare"}


@pytest.mark.parametrize("load", NAMED)
def test_unknown_names_list_the_shipped_ones(load):
    refused(lambda: load("plain"), f"plain: no such file; shipped by name: {NAMED[load]}")
    refused(lambda: load(""), "'': is a folder")
    refused(lambda: load("~nobody-of-this-name/x.toml"), "~nobody-of-this-name/x.toml: no such home folder")


# --set -----------------------------------------------------------------------------------------------------------

SETTINGS = {
    "surface.distance_mm": "--set surface.distance_mm: must be key=value, for example surface.distance_mm=12",
    "=3": "--set =3: must be key=value",
    "a\nb": r"--set 'a\nb': must be key=value",
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


# Experiments -----------------------------------------------------------------------------------------------------

GROUP = '[[groups]]\nscene = "plane"\n'
EXPERIMENTS = {
    "no groups": ("realisations = 3", "groups: missing"),
    "empty groups": ("groups = []", "groups = []: must have at least 1 item"),
    "group without scene": ("[[groups]]", "groups.0.scene: missing"),
    "unknown key": ("repeats = 3\n" + GROUP, "repeats = 3: unknown key; allowed: realisations, name"),
    "unknown key of a group": (GROUP + "swep = []", "groups.0.swep = []: unknown key; allowed: sweep, scene"),
    "unequal lengths": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [1, 2], "surface.azimuth_deg" = [1] }]',
        "lists of one sweep must be equally long and not empty, got lengths {'surface.tilt_deg': 2, 'surface.azimu",
    ),
    "empty sweep": (GROUP + 'sweep = [{ "surface.tilt_deg" = [] }]', "not empty, got lengths {'surface.tilt_deg': 0}"),
    "sweep of nothing": (GROUP + "sweep = [{}]", "not empty, got lengths {}"),
    "sweep of a plain value": (GROUP + 'sweep = [{ "surface.tilt_deg" = 3 }]', "tilt_deg = 3: must be a list"),
    "empty pool": (GROUP + 'pool = [{ "surface.tilt_deg" = [] }]', "not empty"),
    "unknown estimator": ('estimators = ["magic"]\n' + GROUP, "estimator 'magic': not installed; allowed: "),
    "estimator twice": ('estimators = ["cone_axis", "cone_axis"]\n' + GROUP, "estimator 'cone_axis': given twice"),
    "no estimators": ("estimators = []\n" + GROUP, "estimators = []: must have at least 1 item"),
    "unknown scene": (GROUP.replace("plane", "plain"), "plain: no such file; shipped by name: anatomy, cylinder"),
    "no realisations": ("realisations = 0\n" + GROUP, "realisations = 0: must be greater than or equal to 1"),
    "realisations in quotes": ('realisations = "3"\n' + GROUP, "realisations = '3': must be a number"),
    "seed negative": ("seed = -1\n" + GROUP, "seed = -1: must be greater than or equal to 0"),
    "seed huge": ("seed = 9223372036854775808\n" + GROUP, "seed = 9223372036854775808: must be less than"),
    "bad name": ('name = "../up"\n' + GROUP, "name = '../up': must match the pattern"),
    "set out of range": (GROUP + 'set = { "surface.tilt_deg" = 95 }', "surface.tilt_deg = 95: must be less than 90"),
    "swept out of range": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [0, 45, 95] }]',
        "plane.toml: surface.tilt_deg = 95: must be less than 90",
    ),
    "swept text": (GROUP + 'sweep = [{ "camera.fx" = [90, "x"] }]', "camera.fx = 'x': must be a number"),
    "unknown swept key": (GROUP + 'sweep = [{ "surface.tilt" = [0] }]', "surface.tilt = 0: unknown key; allowed: "),
    "swept index": (GROUP + 'sweep = [{ "rig.lights.2.power" = [1] }]', "index 2 is not allowed; the first item is 0"),
    "swept type": (GROUP + 'sweep = [{ "surface.type" = ["plane", "cone"] }]', "surface.type = 'cone': unknown"),
    "swept recipe": (
        '[[groups]]\nscene = "anatomy"\nsweep = [{ "surface.path" = ["colon", "kidney"] }]',
        "kidney: no such file; shipped by name: colon, liver",
    ),
    "swept twice": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [0] }, { "surface.tilt_deg" = [1] }]',
        "surface.tilt_deg: varied twice; a key may be in one table of sweep, pool and random",
    ),
    "swept and drawn": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [0] }]\nrandom = { "surface.tilt_deg" = { low = 0, high = 1 } }',
        "surface.tilt_deg: varied twice",
    ),
    "value twice": (GROUP + 'sweep = [{ "surface.tilt_deg" = [1, 1] }]', "two settings are called 'plane, tilt_deg=1'"),
    "group twice": (GROUP * 2, "two settings are called 'plane'; give the groups different labels"),
    "range turned round": (GROUP + 'random = { "surface.tilt_deg" = { low = 2, high = 1 } }', "low = 2 must not"),
    "range without an end": (GROUP + 'random = { "surface.tilt_deg" = { low = 2 } }', "high: missing"),
    "range of NaN": (GROUP + 'random = { "surface.tilt_deg" = { low = nan, high = 1 } }', "low = nan: must be"),
    "drawn out of range": (
        GROUP + 'random = { "surface.tilt_deg" = { low = 0, high = 91 } }',
        "surface.tilt_deg = 90.9",
        "must be less than 90",
    ),
    "drawn too low": (
        GROUP + 'random = { "surface.distance_mm" = { low = -1e-9, high = 1e6 } }',
        "surface.distance_mm = -1e-09: must be greater than",
    ),
}  # fmt: skip


@pytest.fixture
def no_rendering(monkeypatch):
    def touched(*_):
        pytest.fail("the renderer was used")

    monkeypatch.setattr(realisation, "Session", touched)
    monkeypatch.setattr(runner.backend, "load", touched)


@pytest.mark.usefixtures("no_rendering")
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_are_refused_before_anything_is_rendered(tmp_path, name):
    text, *fragments = EXPERIMENTS[name]
    path, out = tmp_path / "my.toml", tmp_path / "out"
    path.write_text(text)
    refused(lambda: runner.run_experiment(load_experiment(path), out), *fragments)
    assert not out.exists()


@pytest.mark.usefixtures("no_rendering")
def test_a_swept_recipe_is_read_before_anything_is_rendered(tmp_path):
    recipe = tmp_path / "bad.toml"
    recipe.write_text('type = "colon"\nradius_mm = 1\n')
    described = load_experiment("anatomy", {"surface.path": str(recipe)})
    refused(
        lambda: runner.run_experiment(described, tmp_path / "out"), f"{recipe}: radius_mm = 1: must be greater than"
    )


def test_a_range_may_end_at_an_excluded_bound(tmp_path):
    path = tmp_path / "my experiment (new).toml"
    path.write_text(GROUP + 'random = { "surface.tilt_deg" = { low = 0, high = 90 } }')
    described = load_experiment(path)
    assert len(expand(described)) == 1
    # A file's name may hold what an experiment's may not.
    assert described.name == "my-experiment-new-"


@pytest.mark.usefixtures("no_rendering")
def test_settings_of_an_experiment():
    refused(lambda: load_experiment("overview", {"realisations": 0}), "realisations = 0: must be greater than")
    refused(lambda: load_experiment("overview", {"seed": "x"}), "seed = 'x': must be a number")
    refused(
        lambda: load_experiment("overview", {"estimators": "cone_axis"}), "estimators = 'cone_axis': must be a list"
    )
    refused(lambda: expand(load_experiment("overview", {"surface.foo": 1})), "surface.foo = 1: unknown key")
    refused(lambda: load_estimators(["cone_axis", "magic"]), "estimator 'magic'")


# Folders of a run ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_rendering")
@pytest.mark.parametrize("held", ["notes.txt", "figures/mine.png", "gallery/mine.png", "index.html", ".hidden"])
def test_a_folder_of_something_else_is_left_alone(tmp_path, held):
    file = tmp_path / "out" / held
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    described = load_experiment("overview")
    name = Path(held).parts[0]
    refused(lambda: runner.run_experiment(described, tmp_path / "out"), f"holds {name}, which is no part of a run")
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == [file]


@pytest.mark.usefixtures("no_rendering")
def test_folders_that_cannot_be_written(tmp_path):
    described = load_experiment("overview")
    plain = tmp_path / "plain"
    plain.write_text("mine")
    refused(lambda: runner.run_experiment(described, plain), f"--out {plain}: is a file; must be a folder")
    refused(
        lambda: runner.run_experiment(described, plain / "x"), f"--out {plain / 'x'}: cannot be", "(Not a directory)"
    )
    refused(lambda: runner.run_experiment(described, tmp_path / ("n" * 300)), "(File name too long)")
    refused(lambda: runner.run_experiment(described, plain / "a\nb"), r"/a\nb")


# Recipes and meshes through a scene ------------------------------------------------------------------------------

RECIPES = {
    "unknown type": ('type = "kidney"', "type = 'kidney'; allowed: colon, liver"),
    "no type": ("length_mm = 100", "type: missing; allowed: colon, liver"),
    "unknown key": ('type = "colon"\nlength = 100', "length = 100: unknown key; allowed: length_mm"),
    "NaN": ('type = "colon"\nradius_mm = nan', "radius_mm = nan: must be a finite number"),
    "text": ('type = "colon"\nradius_mm = "22"', "radius_mm = '22': must be a number"),
    "radius 0": ('type = "colon"\nradius_mm = 0', "radius_mm = 0: must be greater than or equal to 5"),
    "folds close the lumen": ('type = "colon"\nfold_depth_mm = 30', "at most 0.8 radius_mm = 17.6 mm is allowed"),
    "no lobes": ('type = "liver"\nlobes = []', "lobes = []: must have at least 1 item"),
    "lobe of two axes": (
        'type = "liver"\nlobes = [{ centre_mm = [0, 0, 0], semi_axes_mm = [50, 50] }]',
        "lobes.0.semi_axes_mm.2: missing",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", RECIPES)
def test_recipes(tmp_path, name):
    text, fragment = RECIPES[name]
    path = tmp_path / "my.toml"
    path.write_text(text)
    refused(lambda: make_surface(AnatomySurface(path=str(path))), f"{path}: ", fragment)


MESHES = {
    "none.toml": (None, "no such file; shipped by name: colon, liver"),
    "none.ply": (None, "no such file"),
    "mesh.xyz": ("0 0 0\n", "unknown suffix .xyz; allowed: .toml, .ply, .obj, .stl, .vtk"),
    "empty.ply": ("", "0 bytes"),
    "text.obj": ("this is no mesh\n", "no faces"),
    "cloud.obj": ("v 0 0 0\nv 9 0 0\nv 0 9 0\n", "3 points and no faces"),
    "scene.toml": (PLANE, "type: missing; allowed: colon, liver"),
}


@pytest.mark.parametrize("name", MESHES)
def test_meshes_through_a_scene(tmp_path, name):
    text, fragment = MESHES[name]
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    scene = load_scene("anatomy", {"surface.path": str(path)})
    refused(lambda: make_surface(scene.surface), name, fragment)


def test_a_folder_is_no_anatomy(tmp_path):
    refused(lambda: make_surface(AnatomySurface(path=str(tmp_path))), "is a folder")
    refused(lambda: make_surface(AnatomySurface(path="kidney")), "kidney: no such file; shipped by name: colon, liver")


# Cameras ---------------------------------------------------------------------------------------------------------

CALIBRATION = "width = 32\nheight = 24\nfx = 40\nfy = 40\n"
CAMERAS = {
    "missing key": (CALIBRATION.replace("fy = 40\n", ""), "fy: missing; a camera needs width, height, fx, fy"),
    "text": ("a calibration", "not valid TOML"),
    "NaN": (CALIBRATION.replace("fx = 40", "fx = nan"), "fx = nan: must be a finite number"),
    "in quotes": (CALIBRATION.replace("fx = 40", 'fx = "40"'), "fx = '40': must be a number"),
    "singular": (CALIBRATION.replace("fy = 40", "fy = 0"), "fy = 0: must be greater than"),
    "fractional": (CALIBRATION.replace("32", "32.5"), "width = 32.5: must be a valid integer"),
    "unknown key": (CALIBRATION + "fov = 60", "fov = 60: unknown key; allowed: width, height"),
    "no table": ("camera = 5", "width: missing"),
    "table without keys": ("[camera]\nwidth = 32", "height: missing"),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_files(tmp_path, name):
    text, fragment = CAMERAS[name]
    path = tmp_path / "camera.toml"
    path.write_text(text)
    refused(lambda: load_camera(path), f"{path}: ", fragment)


K = [[40.0, 0.0, 16.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]]
MATRICES = {
    "zero": (np.zeros((3, 3)), "must be upper triangular with K[2][2] = 1"),
    "singular": (np.diag([0.0, 40.0, 1.0]), "camera.fx = ", "must be > 0, else K is singular"),
    "mirrored": (np.diag([40.0, -40.0, 1.0]), "camera.fy = ", "must be > 0, else K is singular"),
    "shape": (K[:2], "K has shape (2, 3): must be (3, 3)"),
    "4 x 4": (np.eye(4), "K has shape (4, 4): must be (3, 3)"),
    "transposed": (np.transpose(K), "must be upper triangular with K[2][2] = 1"),
    "all NaN": (np.full((3, 3), np.nan), "must be upper triangular"),
    "one NaN": ([[40.0, 0.0, np.nan], *K[1:]], "camera.cx = ", "must be a finite number"),
    "infinite": ([[np.inf, 0.0, 16.0], *K[1:]], "camera.fx = ", "must be a finite number"),
}


@pytest.mark.parametrize("name", MATRICES)
def test_calibration_matrices(name):
    matrix, *fragments = MATRICES[name]
    refused(lambda: Camera.from_matrix(matrix, 32, 24), *fragments)


@pytest.mark.parametrize("width", [0, -32, 32.5])
def test_camera_sizes(width):
    refused(lambda: Camera.from_matrix(K, width, 24), f"camera.width = {width}: must be an integer >= 1")


@pytest.mark.parametrize("fov", [0, 180, -60, float("nan"), float("inf")])
def test_fields_of_view(fov):
    refused(lambda: Camera.from_fov(fov, 32, 24), f"fov = {fov}: must be between 0 and 180 deg")


# Frames ----------------------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 32, 24
EYE = Camera.from_matrix(K, WIDTH, HEIGHT)
_ROWS, _COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
SPOT = np.exp(-((_COLUMNS - 16) ** 2 + (_ROWS - 12) ** 2) / 30)


def with_value(value):
    frame = SPOT.copy()
    frame[3, 5] = value
    return frame


FRAMES = {
    "NaN": (with_value(np.nan), "frame holds 1 values that are NaN, infinite"),
    "infinity": (with_value(-np.inf), "frame holds 1 values that are NaN, infinite"),
    "infinities of both signs": (np.stack([SPOT + np.inf, SPOT - np.inf], 2), "frame holds 768 values"),
    "beyond float32": (with_value(1e300), "frame holds 1 values", "beyond 3e38: all must be finite"),
    "turned": (SPOT.T, "frame is 24 x 32 px: must be 32 x 24, the size of the camera's calibration"),
    "1 x 1": ([[1.0]], "frame is 1 x 1 px: must be 32 x 24"),
    "one number": (1.0, "frame has shape (): must be (H, W) or (H, W, C)"),
    "a line": (SPOT[0], "frame has shape (32,): must be (H, W) or (H, W, C)"),
    "four dimensions": (SPOT[None, None], "frame has shape (1, 1, 24, 32): must be (H, W) or (H, W, C)"),
    "empty": ([], "frame has shape (0,): must be (H, W) or (H, W, C)"),
    "no channels": (np.empty((HEIGHT, WIDTH, 0)), "frame has shape (24, 32, 0)"),
    "a file's name": ("frame.png", "frame holds values of type <U9: must be an array of real numbers"),
    "numbers in quotes": ([["1", "2"], ["3", "4"]], "frame holds values of type <U1"),
    "ragged": ([[1, 2], [3]], "frame: must be an array of numbers; its rows differ in length"),
    "nothing": (None, "frame holds values of type object: must be an array of real numbers"),
    "complex": (SPOT * 1j, "frame holds values of type complex128: must be an array of real numbers"),
    "dates": (np.zeros((HEIGHT, WIDTH), "datetime64[s]"), "frame holds values of type datetime64[s]"),
    "integers of no range": (np.zeros((HEIGHT, WIDTH), int), "integers of type int64, whose range is not known"),
    "a picture of two channels": (np.zeros((HEIGHT, WIDTH, 2), np.uint8), "frame: has 2 channels; must have 1, 3 or 4"),
    "a picture of another size": (np.zeros((5, 6, 3), np.uint16), "frame is 6 x 5 px: must be 32 x 24"),
}  # fmt: skip


@pytest.mark.parametrize("name", FRAMES)
def test_frames(name):
    frame, *fragments = FRAMES[name]
    refused(lambda: reconstruct(frame, EYE), *fragments)


ARGUMENTS = {
    "roi outside": ({"roi": (0, 0, 33, 24)}, "roi = 0,0,33,24: must be x,y,w,h inside the 32 x 24 frame"),
    "roi beyond the corner": ({"roi": (31, 23, 2, 2)}, "roi = 31,23,2,2: must be x,y,w,h inside"),
    "roi of no size": ({"roi": (4, 4, 0, 5)}, "roi = 4,4,0,5: must be x,y,w,h inside"),
    "roi negative": ({"roi": (-1, 0, 5, 5)}, "roi = -1,0,5,5: must be x,y,w,h inside"),
    "roi of negative size": ({"roi": (9, 9, 5, -5)}, "roi = 9,9,5,-5: must be x,y,w,h inside"),
    "roi of three": ({"roi": (1, 2, 3)}, "roi = (1, 2, 3): must be x, y, width, height: four integers, px"),
    "roi fractional": ({"roi": (1.5, 0, 4, 4)}, "roi = (1.5, 0, 4, 4): must be x, y, width, height: four integers"),
    "roi NaN": ({"roi": (float("nan"), 0, 4, 4)}, "roi = (nan, 0, 4, 4): must be x, y, width, height"),
    "roi text": ({"roi": "1,2,3,4"}, "roi = '1,2,3,4': must be x, y, width, height: four integers, px"),
    "smoothing negative": ({"smoothing_px": -1}, "smoothing_px = -1: must be a number in [0, 50]"),
    "smoothing huge": ({"smoothing_px": 1e9}, "smoothing_px = 1000000000.0: must be a number in [0, 50]"),
    "smoothing NaN": ({"smoothing_px": float("nan")}, "smoothing_px = nan: must be a number in [0, 50]"),
    "smoothing text": ({"smoothing_px": "2"}, "smoothing_px = '2': must be a number in [0, 50]"),
    "smoothing true": ({"smoothing_px": True}, "smoothing_px = True: must be a number in [0, 50]"),
    "unknown estimator": ({"estimators": ["magic"]}, "estimator 'magic': not installed; allowed: "),
    "estimator twice": ({"estimators": ["cone_axis"] * 2}, "estimator 'cone_axis': given twice"),
    "estimators one name": ({"estimators": "cone_axis"}, "estimators = 'cone_axis': must be a list of names"),
    "estimators numbers": ({"estimators": [5]}, "estimators = [5]: must be a list of names"),
    "encoding unknown": ({"encoding": "rec709"}, "encoding = 'rec709': must be one of srgb, linear, or None"),
    "encoding of large values": ({"encoding": "srgb", "frame": 255 * SPOT}, "encoded real values must lie in [0, 1]"),
    "encoding told twice": (
        {"encoding": "srgb", "camera": Calibration(EYE, Response("gamma", 2.2))},
        "encoding = 'srgb': the calibration states the response; give one of them",
    ),
    "detector unknown": ({"detector": "magic"}, "detector 'magic': not installed; allowed: "),
    "detector of a region": ({"detector": "colour", "roi": (0, 0, 9, 9)}, "the region of interest is named"),
    "detector of grey": ({"detector": "colour"}, "detector colour: the picture is grey; must be peaks"),
    "field of view out of range": ({"camera": 200.0}, "200"),
    "field of view of no image": ({"camera": 60.0, "frame": [1.0, 2.0]}, "where the camera is a field of view"),
    "camera a truth": ({"camera": True}, "camera is a bool: must be a simtest.Camera"),
    "camera a matrix": ({"camera": np.eye(3)}, "camera is a ndarray: must be a simtest.Camera"),
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_of_reconstruct(name):
    given, fragment = ARGUMENTS[name]
    refused(lambda: reconstruct(**{"frame": SPOT, "camera": EYE, **given}), fragment)


NOTHING_TO_SEE = {
    "black": np.zeros((HEIGHT, WIDTH)),
    "grey": np.full((HEIGHT, WIDTH), 0.5),
    "all saturated": np.ones((HEIGHT, WIDTH)),
    "all 255": np.full((HEIGHT, WIDTH, 3), 255, np.uint8),
    "negative": -SPOT - 1,
    "chequered": (_ROWS + _COLUMNS) % 2.0,
    "ramp": _COLUMNS / WIDTH,
    "noise": np.random.default_rng(0).random((HEIGHT, WIDTH)),
}


@pytest.mark.parametrize("name", NOTHING_TO_SEE)
def test_frames_without_a_highlight_give_an_empty_list(name):
    assert reconstruct(NOTHING_TO_SEE[name], EYE) == []


@pytest.mark.parametrize("name", ["black", "grey", "all saturated", "negative"])
def test_a_region_without_a_peak_is_a_failure(name):
    frame = NOTHING_TO_SEE["black"] - 1 if name == "negative" else NOTHING_TO_SEE[name]
    (found,) = reconstruct(frame, EYE, roi=(4, 4, 20, 16))
    assert len(found.estimates) == len(DEFAULT_ESTIMATORS)
    assert all(isinstance(e, Failure) and e.reason == Reason.NO_PEAK for e in found.estimates.values())


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (1, 32), (24, 2), (3, 3)])
def test_tiny_frames(size):
    frame = SPOT[12 : 12 + size[0], : size[1]] if size[0] < 24 else SPOT[:, 16:18]
    camera = Camera.from_matrix(K, size[1], size[0])
    assert reconstruct(frame, camera) == []
    (found,) = reconstruct(frame, camera, roi=(0, 0, size[1], size[0]), smoothing_px=0)
    assert isinstance(found.estimates["circle_pose"], Failure)
    assert isinstance(found.estimates["cone_axis"], Failure)
    assert found.estimates["circle_pose"].reason in {
        Reason.NO_PEAK,
        Reason.NO_CLOSED_ISOPHOTE,
        Reason.TOO_FEW_POINTS,
    }


@pytest.mark.parametrize("scale", [1e-40, 1e-30, 1e30, 1e38])
def test_the_scale_of_a_frame_does_not_matter(scale):
    (found,) = reconstruct(SPOT * scale, EYE)
    assert all(not isinstance(estimate, Failure) for estimate in found.estimates.values())


def test_an_estimator_that_fails_is_a_value():
    class Broken:
        def estimate(self, patch, camera, priors):
            raise ZeroDivisionError("float division by zero")

    class Silent:
        def estimate(self, patch, camera, priors):
            return None

    (found,) = reconstruct(SPOT, EYE, {"broken": Broken(), "silent": Silent()})
    details = {name: result.detail for name, result in found.estimates.items()}
    assert {result.reason for result in found.estimates.values()} == {Reason.ESTIMATOR_ERROR}
    assert details["broken"] == "ZeroDivisionError: float division by zero"
    assert details["silent"] == "gave a NoneType; must be an Estimate or a Failure"
    refused(lambda: reconstruct(SPOT, EYE, {"number": 5}), "estimator 'number'", "not callable")


@pytest.mark.parametrize("focal", [1e-300, 1e300])
def test_an_absurd_camera_gives_failures_not_errors(focal):
    (found,) = reconstruct(SPOT, Camera(WIDTH, HEIGHT, focal, focal, 16, 12))
    assert isinstance(found.estimates["circle_pose"], Failure)
    assert isinstance(found.estimates["cone_axis"], Failure)
