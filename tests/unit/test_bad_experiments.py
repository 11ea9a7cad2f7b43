"""Malformed experiments, run folders, recipes and meshes: refused in one line, before anything is rendered."""

from pathlib import Path

import pytest

from simtest.estimators import load_estimators
from simtest.runtime.boundary import plain_errors
from simtest.spec import load_experiment, load_scene, scene_from_dict
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces import make_surface
from simtest.validation import realisation, runner
from simtest.validation.cases import expand
from tests.refusals import refused

# Experiments -----------------------------------------------------------------------------------------------------

GROUP = '[[groups]]\nscene = "plane"\n'
EXPERIMENTS = {
    "group without scene": ("[[groups]]", "groups.0.scene: missing"),
    "unknown key": ("repeats = 3\n" + GROUP, "repeats = 3: unknown key; allowed: realisations, name"),
    "unequal lengths": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [1, 2], "surface.azimuth_deg" = [1] }]',
        "lists of one sweep must be equally long and not empty, got lengths {'surface.tilt_deg': 2, 'surface.azimu",
    ),
    "empty sweep": (GROUP + 'sweep = [{ "surface.tilt_deg" = [] }]', "not empty, got lengths {'surface.tilt_deg': 0}"),
    "sweep of nothing": (GROUP + "sweep = [{}]", "not empty, got lengths {}"),
    "empty pool": (GROUP + 'pool = [{ "surface.tilt_deg" = [] }]', "not empty"),
    "unknown estimator": ('estimators = ["magic"]\n' + GROUP, "estimator 'magic': not installed; allowed: "),
    "estimator twice": ('estimators = ["cone_axis", "cone_axis"]\n' + GROUP, "estimator 'cone_axis': given twice"),
    "unknown scene": (GROUP.replace("plane", "plain"), "plain: no such file; shipped by name: anatomy, cylinder"),
    "set out of range": (GROUP + 'set = { "surface.tilt_deg" = 95 }', "surface.tilt_deg = 95: must be less than 90"),
    "swept out of range": (
        GROUP + 'sweep = [{ "surface.tilt_deg" = [0, 45, 95] }]',
        "plane.toml: surface.tilt_deg = 95: must be less than 90",
    ),
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
    refused(lambda: runner.run_experiment(described, tmp_path / "out"), f"{recipe}: radius_mm = 1: must be greater")


def test_a_range_may_end_at_an_excluded_bound(tmp_path):
    path = tmp_path / "my experiment (new).toml"
    path.write_text(GROUP + 'random = { "surface.tilt_deg" = { low = 0, high = 90 } }')
    described = load_experiment(path)
    assert len(expand(described)) == 1
    # A file's name may hold what an experiment's may not.
    assert described.name == "my-experiment-new-"


def test_settings_of_an_experiment():
    refused(lambda: load_experiment("overview", {"realisations": 0}), "realisations = 0: must be greater than")
    refused(lambda: load_experiment("overview", {"estimators": "cone_axis"}), "estimators = 'cone_axis': must be a")
    refused(lambda: expand(load_experiment("overview", {"surface.foo": 1})), "surface.foo = 1: unknown key")
    refused(lambda: load_estimators(["cone_axis", "magic"]), "estimator 'magic'")


def test_few_viewpoints_of_an_experiment():
    few, all_of_them = load_experiment("mesh", {"viewpoints": 3}), load_experiment("mesh")
    assert {case.data["surface"]["viewpoint"] for case in expand(few)} == {0, 1, 2}
    assert {case.setting for case in expand(few)} == {case.setting for case in expand(all_of_them)}
    # 48, 5 x 12 and 3 x 8 frames, or 3 of each.
    assert (len(expand(all_of_them)), len(expand(few))) == (132, 27)
    assert "viewpoints=3" in few.description
    assert len(expand(load_experiment("mesh", {"viewpoints": 1000}))) == 132
    refused(
        lambda: load_experiment("curvature", {"viewpoints": 3}),
        "--set viewpoints: no group of",
        "varies surface.viewpoint",
    )


@pytest.mark.parametrize("bad", [0, 2.5, True, "x"])
def test_a_number_of_viewpoints_is_a_whole_one(bad):
    refused(
        lambda: load_experiment("mesh", {"viewpoints": bad}), f"--set viewpoints={bad}: must be a whole number from 1"
    )


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
    run = plain_errors(runner.run_experiment)
    refused(lambda: run(described, plain / "x"), f"{plain / 'x'}", "Not a directory")
    refused(lambda: run(described, tmp_path / ("n" * 300)), "File name too long")
    refused(lambda: run(described, plain / "a\nb"), r"/a\nb")


# Recipes and meshes through a scene ------------------------------------------------------------------------------

ANATOMIES = {
    "kidney.toml": ('type = "kidney"', "type = 'kidney'; allowed: colon, liver"),
    "untyped.toml": ("length_mm = 100", "type: missing; allowed: colon, liver"),
    "unknown.toml": ('type = "colon"\nlength = 100', "length = 100: unknown key; allowed: length_mm"),
    "closed.toml": ('type = "colon"\nfold_depth_mm = 30', "at most 0.8 radius_mm = 17.6 mm is allowed"),
    "flat.toml": (
        'type = "liver"\nlobes = [{ centre_mm = [0, 0, 0], semi_axes_mm = [50, 50] }]',
        "lobes.0.semi_axes_mm.2: missing",
    ),
    "none.toml": (None, "no such file; shipped by name: colon, liver"),
    "none.ply": (None, "no such file"),
    "text.obj": ("this is no mesh\n", "no faces"),
}


@pytest.mark.parametrize("name", ANATOMIES)
def test_recipes_and_meshes(tmp_path, name):
    text, fragment = ANATOMIES[name]
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    scene = load_scene("anatomy", {"surface.path": str(path)})
    refused(lambda: make_surface(scene.surface), name, fragment)


def test_a_folder_is_no_anatomy(tmp_path):
    refused(lambda: make_surface(AnatomySurface(path=str(tmp_path))), "is a folder")
    refused(lambda: make_surface(AnatomySurface(path="kidney")), "kidney: no such file; shipped by name: colon, liver")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*inside out")
def test_waves_that_a_mesh_holds_itself():
    mesh = Path(__file__).resolve().parents[2] / "meshes" / "colon_40mm.ply"

    def make(wavelength, **values):
        relief = {"bands": [{"slope_deg": 1, "wavelength_mm": 1.0}, {"slope_deg": 1, "wavelength_mm": wavelength}]}
        surface = {"type": "anatomy", "path": str(mesh), "relief": relief, **values}
        return make_surface(scene_from_dict({"surface": surface}).surface)

    refused(
        lambda: make(wavelength=5.0),
        "surface.relief.bands.1.wavelength_mm = 5: ",
        "colon_40mm.ply holds waves from 2.4 mm on itself (two of its median edges, or smoothing_mm)",
    )
    # Waves below the mesh's own lie in the normal alone and need no triangles; smoothing makes room for longer ones.
    assert make(wavelength=0.1).relief is not None
    assert make(wavelength=5.0, smoothing_mm=6.0).relief is not None
