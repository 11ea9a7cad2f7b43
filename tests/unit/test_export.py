"""Exported scenes as Mitsuba itself loads and renders them, against the session's own pictures."""

import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

import simtest
from simtest.errors import InputError
from simtest.rendering import Session, plugins
from simtest.rendering.mitsuba_export import SAMPLES
from simtest.spec import scene_from_dict
from simtest.spec.camera import CameraSpec
from simtest.spec.lights import LightSpec
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 90, "height": 72, "fx": 80.0, "fy": 80.0, "cx": 52.0, "cy": 31.0}
AT_CAMERA, ASIDE = {"offset_mm": 0.0}, {"position_mm": [2.0, -1.5, 1.0], "power": 3.0}
PHONG = {"type": "phong", "exponent": 40.0, "diffuse": 0.3}


def scene(surface, reflectance=PHONG, lights=(ASIDE,), render=None, camera=None):
    tables = {"surface": surface, "reflectance": reflectance, "rig": {"lights": list(lights)}}
    return scene_from_dict(tables | {"camera": {**CAMERA, **(camera or {})}, "render": render or {}})


@pytest.fixture(scope="module")
def session():
    session = Session(scene({"type": "plane"}))
    session.mi.set_log_level(session.mi.LogLevel.Error)
    yield session
    session.mi.set_log_level(session.mi.LogLevel.Warn)


def loaded(session, described, folder, **parameters):
    """Export a scene, let Mitsuba load it from its file and render it."""
    file = simtest.export(described, folder)[0]
    mi = session.mi
    plugins.register()
    image = mi.render(mi.load_file(str(file), **parameters), seed=5)
    return np.array(image, dtype=float)[:, :, 0]


SURFACES = {
    "plane": {"type": "plane", "tilt_deg": 20.0, "azimuth_deg": 130.0, "spin_deg": 25.0},
    "plane to the horizon": {"type": "plane", "tilt_deg": 70.0},
    "sphere": {"type": "sphere", "radius_mm": 6.0, "tilt_deg": 15.0, "azimuth_deg": 70.0},
    "sphere inside": {"type": "sphere", "radius_mm": 14.0, "tilt_deg": 15.0, "side": "inside"},
    "cylinder": {"type": "cylinder", "radius_mm": 5.0, "tilt_deg": 10.0, "azimuth_deg": 30.0, "spin_deg": 20.0},
    "cylinder inside": {"type": "cylinder", "radius_mm": 12.0, "side": "inside"},
    "quadric": {"type": "quadric", "k1_per_mm": 0.08, "k2_per_mm": -0.05, "tilt_deg": 20.0},
    "colon": {"type": "anatomy", "path": "colon"},
    "liver": {"type": "anatomy", "path": "liver", "viewpoint": 2},
}
REFLECTANCES = {
    "phong": PHONG,
    "normalised": {"type": "phong", "exponent": 40.0, "specular": 0.6, "diffuse": 0.3, "normalised": True},
    "rough plastic": {"type": "rough_plastic", "alpha": 0.1, "colour": [0.8, 0.4, 0.3]},
    "principled": {"type": "principled", "roughness": 0.3},
    "rough conductor": {"type": "rough_conductor", "alpha": 0.2, "diffuse": 0.3},
    "albedo": {"type": "tissue", "film": {"index": 1.36, "alpha": 0.05}, "colour": [0.8, 0.4, 0.3]},
    "tissue GGX": {"type": "tissue", "film": {"index": 1.36, "alpha": 0.05, "distribution": "ggx"}},
}
CASES = [(name, "phong", AT_CAMERA if i % 2 else ASIDE) for i, name in enumerate(SURFACES)]
CASES += [("plane", name, ASIDE) for name in REFLECTANCES if name != "phong"]
CASES += [("quadric", "rough plastic", ASIDE), ("quadric", "rough conductor", ASIDE)]
SELDOM = [("quadric", "phong", ASIDE), ("quadric", "rough plastic", ASIDE)]


@pytest.mark.parametrize(
    ("surface", "reflectance", "light"), marked(CASES, ci=SELDOM, slow=[("liver", "phong", ASIDE)]), ids=str
)
def test_mitsuba_renders_the_same_picture(session, tmp_path, surface, reflectance, light):
    described = scene(SURFACES[surface], REFLECTANCES[reflectance], (light,))
    session.update(described)
    expected = session.radiance().total
    image = loaded(session, described, tmp_path)
    assert image.shape == expected.shape
    assert expected.max() > 0
    # Of a plane to the horizon Mitsuba interpolates the hits between corners that are far away.
    tolerance = 5e-3 if surface == "plane to the horizon" else 2e-5
    assert np.abs(image - expected).max() < tolerance * expected.max()


def test_shadows_are_exported(session, tmp_path):
    """A light outside the sphere that the camera is in."""
    dark = scene({"type": "sphere", "radius_mm": 8.0, "side": "inside"}, lights=({"position_mm": [0.0, 0.0, 13.0]},))
    assert loaded(session, dark, tmp_path).max() == 0


TUBE = {"type": "cylinder", "radius_mm": 12.0, "side": "inside"}
WIDE = {**PHONG, "exponent": 5.0, "diffuse": 0.7}
WET = {"type": "tissue", "film": {"index": 1.36, "alpha": 0.1}, "diffuse": 0.9}
SPREAD = {
    "two lights": ({"samples_per_pixel": 64}, (AT_CAMERA, {**ASIDE, "power": 1.0}), SURFACES["plane"], WIDE),
    "bounces": ({"samples_per_pixel": 16, "path_depth": 3}, (ASIDE,), TUBE, WIDE),
    "bounces off tissue": ({"samples_per_pixel": 64, "path_depth": 3}, (ASIDE,), TUBE, WET),
}


@pytest.mark.parametrize("name", marked(SPREAD, ci=["bounces off tissue"]))
def test_sampled_pictures_have_the_same_mean(session, tmp_path, name):
    """Over all pixels together, within 3 standard errors; 1 % more would be seen."""
    render, lights, surface, reflectance = SPREAD[name]
    described = scene(surface, reflectance, lights, render)
    session.update(described)
    expected = session.radiance().total.astype(float)
    image = loaded(session, described, tmp_path)
    difference = image - expected
    error = difference.std() / np.sqrt(difference.size)
    assert abs(difference.mean()) < 3 * error
    assert abs((1.01 * image - expected).mean()) > 3 * error


def test_one_sample_where_it_cannot_do_becomes_many(tmp_path):
    def sampler(lights, render):
        file = simtest.export(scene(SURFACES["plane"], lights=lights, render=render), tmp_path)[0]
        root = ET.parse(file).getroot()
        count = next(e.get("value") for e in root.findall("default") if e.get("name") == "spp")
        return root.find("sensor/sampler").get("type"), int(count)

    assert sampler((ASIDE,), {}) == ("stratified", 1)
    assert sampler((ASIDE, AT_CAMERA), {}) == ("independent", SAMPLES)
    assert sampler((ASIDE,), {"path_depth": 4}) == ("independent", SAMPLES)
    assert sampler((ASIDE,), {"samples_per_pixel": 9}) == ("independent", 9)


@pytest.mark.parametrize(
    ("name", "shown"),
    [pytest.param("phong", "Phong[exponent=40", marks=pytest.mark.ci), ("tissue GGX", "Tissue[alpha=0.05")],
)
def test_the_line_in_the_file_makes_it_load(session, tmp_path, name, shown):
    text = simtest.export(scene(SURFACES["quadric"], REFLECTANCES[name]), tmp_path)[0].read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene.xml", "surface.ply"]
    line = next(line.strip() for line in text.splitlines() if "import register" in line)
    code = "import mitsuba as mi; mi.set_variant('scalar_rgb')\n" + line
    code += "\nprint(mi.load_file('scene.xml').shapes()[0].bsdf())"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert shown in done.stdout, done.stderr


def test_mitsuba_alone_loads_what_is_its_own(session, tmp_path):
    described = scene(SURFACES["quadric"], REFLECTANCES["rough plastic"], camera={"width": 32, "height": 32})
    text = simtest.export(described, tmp_path)[0].read_text()
    assert "register" not in text
    code = (
        "import sys, mitsuba as mi; mi.set_variant('scalar_rgb');"
        "image = mi.render(mi.load_file('scene.xml')); print(image.shape, 'simtest' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "(32, 32, 3) False", done.stderr


def test_a_name_cannot_end_the_comment(tmp_path):
    named = scene(SURFACES["plane"]).model_copy(update={"name": 'a --- b --> <x y="z">'})
    root = ET.parse(simtest.export(named, tmp_path)[0]).getroot()
    assert [child.tag for child in root][-3:] == ["sensor", "shape", "emitter"]


def test_the_same_bytes_twice(tmp_path):
    folders = [tmp_path / name for name in ("one", "two")]
    first, second = ([file.read_bytes() for file in simtest.export(scene(SURFACES["quadric"]), f)] for f in folders)
    assert first == second


# What Mitsuba cannot express -----------------------------------------------------------------------------------------


class ProfiledLight(LightSpec):
    """A light with a key that the exporter has not heard of."""

    profile: str = "isotropic"


class ShutteredCamera(CameraSpec):
    """A camera with a key that the exporter has not heard of."""

    rows_ms: tuple[float, ...] = ()


def with_parts(described, **parts):
    return described.model_copy(update=parts)


def test_what_mitsuba_cannot_express_is_refused(tmp_path):
    described = scene(SURFACES["plane"])
    rig = described.rig
    cases = {
        "camera.fx = 81.0": scene(SURFACES["plane"], camera={"fx": 81.0}),
        "reflectance.albedo = 'stomach'": scene(SURFACES["plane"], {"type": "phong", "albedo": {"preset": "stomach"}}),
        "camera.skew = 2.0": scene(SURFACES["plane"], camera={"skew": 2.0}),
        "render.ambient = True": scene(SURFACES["plane"], render={"ambient": True}),
        "rig.lights.1.profile = 'cos'": with_parts(
            described,
            rig=rig.model_copy(update={"lights": (ProfiledLight(), ProfiledLight(profile="cos"))}),
        ),
        "camera.rows_ms = (0.1,)": with_parts(described, camera=ShutteredCamera(**CAMERA, rows_ms=(0.1,))),
        "camera.distortion = BrownConradySpec(": scene(
            SURFACES["plane"], camera={"distortion": {"type": "brown_conrady", "k1": 0.1}}
        ),
        "camera.distortion = KannalaBrandtSpec(": scene(
            SURFACES["plane"], camera={"distortion": {"type": "kannala_brandt"}}
        ),
        "surface.relief = {'bands': ": scene(
            {**SURFACES["plane"], "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.0}]}}
        ),
        "camera.view_mask = ViewMaskSpec(": scene(SURFACES["plane"], camera={"view_mask": {"radius": 30.0}}),
    }
    for key, refused in cases.items():
        with pytest.raises(InputError) as raised:
            simtest.export(refused, tmp_path / "out")
        assert key in str(raised.value)
        assert "must " in str(raised.value)
        assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()
    plain = with_parts(described, rig=rig.model_copy(update={"lights": (ProfiledLight(),)}))
    assert simtest.export(plain, tmp_path / "out")
