"""What a scene file and `--set` may not hold beyond a single key's type and bounds: one line that names it."""

import os
import tomllib

import pytest

from simtest.spec import load_camera, load_experiment, load_scene, parse_settings, scene_from_dict
from simtest.surfaces.recipe import load_recipe
from tests.refusals import refused

# Scenes ----------------------------------------------------------------------------------------------------------

PLANE = '[surface]\ntype = "plane"\n'
SPHERE = '[surface]\ntype = "sphere"\n'
CYLINDER = '[surface]\ntype = "cylinder"\n'
PHONG = PLANE + '[reflectance]\ntype = "phong"\n'
WET = PLANE + '[reflectance]\ntype = "tissue"\n[reflectance.film]\nindex = 1.36\n'
VESSELS = PHONG + "[reflectance.albedo.vessels]\n"
RIG = PLANE + "[rig]\n"
LIGHT = PLANE + "[[rig.lights]]\n"
SOURCE = PLANE + "[[rig.lights]]\n[rig.lights.source]\n"
CRESCENT = SOURCE + 'type = "crescent"\nradius_mm = 3\n'
PROFILE = LIGHT + '[rig.lights.profile]\ntype = "table"\n'
CAMERA = PLANE + "[camera]\n"
FOV = CAMERA + "fov_deg = 70.0\n"
SENSOR = PLANE + "[sensor]\n"
EXPOSURE = PLANE + "[sensor.exposure]\n"
RESPONSE = PLANE + '[sensor.response]\ntype = "table"\n'
BAND = PLANE + "[[surface.relief.bands]]\n"
FINE = "\n[[surface.relief.bands]]\nslope_deg = 4\nwavelength_mm = 1.5"

SCENES = {
    # Messages
    "unknown key": (PLANE + "distance = 3", "surface.distance = 3: unknown key; allowed: distance_mm, relief, "),
    "unknown table": ("[lamp]\n" + PLANE, "lamp = {}: unknown key; allowed: name, surface, reflectance"),
    "unknown type": ('[surface]\ntype = "cone"', "surface.type = 'cone': unknown; allowed: anatomy, cylinder, plane"),
    "no type": (PLANE + "[reflectance]\nexponent = 3", "reflectance.type: missing; allowed: phong, principled"),
    "two keys missing": ('[surface]\ntype = "quadric"', "surface.k1_per_mm: missing; it must be given (and 1 more)"),
    "another type's key": (PHONG + "alpha = 0.2", "reflectance.alpha = 0.2: unknown key; allowed: diffuse, colour"),
    "item of a list": (LIGHT + "position_mm = [1, 0]", "rig.lights.0.position_mm.2: missing; it must be given"),
    "33 lights": (PLANE + "[[rig.lights]]\n" * 33, "rig.lights = [{}, {}", "...: must have at most 32 items"),
    "date for a number": (PLANE + "distance_mm = 2024-01-01", "surface.distance_mm = datetime.date(2024"),
    "400 digits": (PLANE + "distance_mm = 1" + "0" * 400, "surface.distance_mm = 1000", "...: must be"),
    "line break in a key": ('"a\\nb" = 1\n' + PLANE, r"a\nb = 1: unknown key"),
    "endless key": ("k" * 5000 + " = 1\n" + PLANE, "kkk...kkk", "kkk = 1: unknown key"),
    # Surfaces
    "camera outside": (SPHERE + 'side = "inside"\nradius_mm = 5\ndistance_mm = 10', "outside a radius of 5 mm"),
    "camera outside by tilt": (
        CYLINDER + 'side = "inside"\nradius_mm = 6\ndistance_mm = 10\ntilt_deg = 60',
        "must be small enough for the camera to lie inside",
    ),
    "relief too high": (BAND + "slope_deg = 10\nwavelength_mm = 5", "a relief of about 0.72 mm", "below 0.3 mm"),
    "bands too high together": (
        BAND + "slope_deg = 6\nwavelength_mm = 3.2" + FINE * 3,
        "must stay below 0.3 mm",
    ),
    "pits too deep": (BAND + 'slope_deg = 6\nwavelength_mm = 1.5\nkind = "pits"', "a relief of about 0.38 mm"),
    "band without direction": (
        BAND + "slope_deg = 4\nwavelength_mm = 1.5\ndirection = [0, 0, 0]",
        "surface.relief.bands.0: direction = [0.0, 0.0, 0.0]: must have a length",
    ),
    # Reflectances
    "more light than arrives": (PHONG + "normalised = true\ndiffuse = 0.3", "a diffuse base of 0.3 reflect more light"),
    "tissue and diffuse": (PHONG + "diffuse = 0.3\nalbedo = {}", "diffuse and albedo exclude each other"),
    "tissue and colour": (PHONG + "colour = [1, 0.5, 0.5]\nalbedo = {}", "colour and albedo exclude each other"),
    "calibres turned round": (VESSELS + "smallest_mm = 0.6", "largest_mm = 0.5 and smallest_mm = 0.6"),
    "too many calibres": (VESSELS + "smallest_mm = 0.01", "more than the smallest and at most 30 times"),
    "vessels too near": (VESSELS + "spacing_mm = 0.3", "vessels must not be wider than their spacing"),
    "level without relief": (WET + "level = 0.5", "reflectance.film.level = 0.5: there are no valleys to fill"),
    "patches without level": (WET + "patches = {}", "patches vary the film's level: give level too"),
    # Lights
    "placed twice": (LIGHT + "position_mm = [1, 0, 0]\noffset_mm = 1", "position_mm and offset_mm exclude each"),
    "preset and lights": (RIG + 'preset = "colocated"\nlights = [{}]', "preset and lights exclude each other"),
    "count alone": (RIG + "count = 3", "rig: count: belongs to a preset"),
    "all in one place": (RIG + 'preset = "colocated"\ncount = 3', "count = 3: with radius_mm = 0"),
    "wide spot": (LIGHT + "spot_deg = 200", "rig.lights.0: spot_deg = 200: must be at most 180"),
    "edge": (LIGHT + "spot_deg = 50\nsoft_edge_deg = 30", "soft_edge_deg = 30: must be at most half of spot"),
    "edge alone": (LIGHT + "soft_edge_deg = 3", "soft_edge_deg = 3: needs spot_deg"),
    "no direction": (LIGHT + "direction = [0, 0, 0]", "direction = [0.0, 0.0, 0.0]: must have a length"),
    "black": (LIGHT + "colour = [0, 0, 0]", "colour = [0.0, 0.0, 0.0]: one of the channels must be positive"),
    "each of lights": (RIG + 'preset = "laparoscope"\neach = {spot_deg = 200}', "rig.each: spot_deg = 200"),
    "inner = radius": (SOURCE + 'type = "ring"\nradius_mm = 3\ninner_mm = 3', "inner_mm = 3: must be below radius_mm"),
    "crescent without area": (CRESCENT + "cut_radius_mm = 6\ncut_offset_mm = 2", "must leave at least 1 % of the disc"),
    "cut beside the disc": (CRESCENT + "cut_radius_mm = 2\ncut_offset_mm = 5.5", "must overlap the disc of radius_mm"),
    "profile of unlike lists": (PROFILE + "angle_deg = [0, 20]\nvalue = [1, 1, 1]", "value has 3 entries, angle_deg 2"),
    "profile from 5 deg": (PROFILE + "angle_deg = [5, 20]\nvalue = [1, 1]", "angle_deg = [5.0, 20.0]: must rise"),
    "profile with a step": (PROFILE + "angle_deg = [0, 20, 20]\nvalue = [1, 1, 1]", "must rise from 0"),
    "profile dark on the axis": (PROFILE + "angle_deg = [0, 20]\nvalue = [0, 1]", "must be positive on the axis"),
    # Camera
    "wider than the lens": (CAMERA + "fov_deg = 180.0", "fov_deg = 180: this lens cannot span", "below 180 deg"),
    "wider than a barrel's fold": (
        CAMERA + 'fov_deg = 120.0\ndistortion = {type = "brown_conrady", k1 = -0.4}',
        "must be below 84.78 deg",
    ),
    "angle and focal length": (FOV + "fx = 300.0", "fov_deg and fx exclude each other"),
    "angle and both focal lengths": (FOV + "fx = 300.0\nfy = 300.0", "fov_deg and fx and fy exclude each other"),
    "extent alone": (CAMERA + 'fov_of = "diagonal"', "fov_of = 'diagonal': needs fov_deg"),
    "angle and skew": (FOV + "skew = 1.0", "skew = 1: must be 0 with fov_deg"),
    # Sensor
    "curve that falls": (RESPONSE + "light = [0.0, 0.5, 1.0]\nvalue = [0.0, 1.0, 0.8]", "sensor.response", "value"),
    "curve that rests": (RESPONSE + "light = [0.0, 0.5, 0.6, 1.0]\nvalue = [0.0, 0.5, 0.5, 1.0]", "value"),
    "curve from 0.1": (RESPONSE + "light = [0.0, 1.0]\nvalue = [0.1, 1.0]", "rise from 0 to 1"),
    "curve to 0.9": (RESPONSE + "light = [0.0, 0.9]\nvalue = [0.0, 1.0]", "light", "rise from 0 to 1"),
    "curve of unlike lists": (RESPONSE + "light = [0.0, 1.0]\nvalue = [0.0, 0.5, 1.0]", "as many"),
    "electrons without a well": (SENSOR + "read_noise = 3", "sensor: read_noise = 3 electrons: needs full_well"),
    "two exposures": (EXPOSURE + "percentile = 99\nfull_scale = 1.0", "sensor.exposure: ", "exclude each other"),
    "average and percentile": (EXPOSURE + "average = 0.4\npercentile = 99", "percentile and average exclude each"),
    "JPEG of 10 bits": (SENSOR + 'bits = 10\ncoding = {type = "jpeg"}', "bits = 10: must be 8"),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    text, *fragments = SCENES[name]
    refused(lambda: scene_from_dict(tomllib.loads(text), "my.toml"), "my.toml: ", *fragments)


# Files -----------------------------------------------------------------------------------------------------------

FILES = {
    "empty": (b"", "surface: missing"),
    "not TOML": (b"distance = = 3", "not valid TOML: Invalid value (at line 1, column 12)"),
    "table twice": (PLANE.encode() * 2, "not valid TOML: Cannot declare"),
    "not UTF-8": (b'name = "caf\xe9"', "not a text file in UTF-8 (byte 11)"),
    "zero bytes": (bytes(100), "not valid TOML"),
    "2 MB": (b"#" * 2_000_000, "2000000 bytes; at most 1000000 are allowed (SIMTEST_LIMITS=text_bytes=N"),
    "deeply nested": (b"a = " + b"[" * 100_000, "not valid TOML: nested too deeply"),
    "5000 digits": (b"a = " + b"1" * 5000, "not valid TOML: a number has too many digits"),
}


@pytest.mark.parametrize("name", FILES)
def test_files(tmp_path, name):
    data, fragment = FILES[name]
    path = tmp_path / "my.toml"
    path.write_bytes(data)
    refused(lambda: load_scene(path), f"{path}: ", fragment)


MISSING = {load_scene: "surface", load_experiment: "groups", load_camera: "width", load_recipe: "type"}


@pytest.mark.parametrize("load", MISSING)
def test_what_is_no_file(tmp_path, load):
    empty, pipe = tmp_path / "my.toml", tmp_path / "pipe"
    empty.touch()
    os.mkfifo(pipe)
    refused(lambda: load(empty), f"{empty}: {MISSING[load]}: missing")
    refused(lambda: load(tmp_path), f"{tmp_path}: is a folder")
    refused(lambda: load(tmp_path / "none.toml"), "none.toml: ", "no such file")
    refused(lambda: load("n" * 5000), "nnn...nnn", "File name too long")
    refused(lambda: load("a\nb"), r"a\nb: ")
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
    "surface.distance_mm=nan": "surface.distance_mm = nan: must be a finite number",
    "surface.distance_mm=1\nfoo=2": r"surface.distance_mm = '1\nfoo=2': must be a number",
    "camera.width=" + "[" * 100_000: "camera.width = '[[[",
    "camera.width=" + "9" * 5000: "camera.width = '999",
    "surface..x=1": "surface.'' = {'x': 1}: unknown key",
    "surface.distance_mm.x=1": "surface.distance_mm.x: surface.distance_mm is a plain value, not a table",
    "surface.distance_mm.x.y=1": "surface.distance_mm.x.y: x is below a plain value, not a table",
    "rig.lights.1.power=2": "rig.lights.1.power: index 1 is not allowed; the first item is 0",
    "reflectance.colour.3=1": "reflectance.colour.3: index 3 is not allowed; the list has items 0 to 2",
    "reflectance.colour.-1=1": "reflectance.colour.-1: index -1 is not allowed; the list has items 0 to 2",
    "reflectance.colour.²=1": "reflectance.colour.²: index ² is not allowed",
    "rig.lights.first.power=2": "rig.lights = {'first': {'power': 2}}: must be a list",
    "rig.lights.0=5": "rig.lights.0 = 5: must be a table",
}


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda text: text[:30].encode("unicode_escape").decode())
def test_settings(setting):
    given = ["reflectance.colour=[1, 1, 1]", setting]
    refused(lambda: load_scene("plane", parse_settings(given)), SETTINGS[setting])


def test_an_empty_list_has_no_index():
    refused(lambda: load_scene("plane", {"rig.lights": [], "rig.lights.0.power": 2}), "the list has no items")
