"""Each experiment of a run has its own Mitsuba variant: its rows do not depend on the experiments beside it."""

import json

import numpy as np
import pytest

from simtest.rendering import Session
from simtest.runtime.processes import LocalEngine, make_engine
from simtest.spec import load_experiment
from simtest.validation import case_work
from simtest.validation.case_work import by_variant
from simtest.validation.cases import expand
from simtest.validation.runner import make_jobs, run_experiments, variant_of

pytestmark = pytest.mark.render

CAMERA = '"camera.width" = 160, "camera.height" = 160, "sensor.noise_sigma" = 0.02'
GREY = f"""
realisations = 2
estimators = ["cone_axis", "brightest_point"]
[[groups]]
scene = "cylinder"
set = {{ {CAMERA} }}
sweep = [{{ "surface.radius_mm" = [5.0, 10.0] }}]
"""
COLOURED = f"""
realisations = 2
estimators = ["cone_axis", "brightest_point"]
[[groups]]
scene = "sphere"
set = {{ {CAMERA}, "reflectance" = {{ type = "phong", exponent = 50.0, albedo = {{ preset = "colon_mucosa" }} }} }}
"""
TEXTS = {"coloured": COLOURED, "grey": GREY, "grey_too": GREY}
VARIANTS = {"coloured": "llvm_ad_rgb", "grey": "llvm_ad_mono", "grey_too": "llvm_ad_mono"}


@pytest.fixture(scope="module")
def experiments(tmp_path_factory):
    folder = tmp_path_factory.mktemp("experiments")
    for name, text in TEXTS.items():
        (folder / f"{name}.toml").write_text(text)
    return {name: load_experiment(folder / f"{name}.toml") for name in TEXTS}


def run(experiments, names, folder, workers=1):
    """Run experiments in one piece; return the rows by name."""
    engine = make_engine(workers=workers)
    runs = run_experiments([(experiments[name], folder / name) for name in names], engine=engine)
    for name, made in zip(names, runs, strict=True):
        assert json.loads((made.folder / "summary.json").read_text())["run"]["variant"] == VARIANTS[name]
    return {name: made.results for name, made in zip(names, runs, strict=True)}


@pytest.fixture(scope="module")
def alone(experiments, tmp_path_factory):
    """The rows of each experiment that is run alone."""
    folder = tmp_path_factory.mktemp("alone")
    return {name: run(experiments, [name], folder)[name] for name in experiments}


@pytest.mark.parametrize("names", [pytest.param(("coloured", "grey"), marks=pytest.mark.ci), ("grey", "coloured")])
def test_an_experiment_beside_one_of_another_variant_has_the_rows_that_it_has_alone(
    names, experiments, alone, tmp_path
):
    for name, rows in run(experiments, names, tmp_path).items():
        assert rows.equals(alone[name])
        assert rows.filter(status="ok").height > 0


@pytest.mark.slow
@pytest.mark.parametrize("names", [("coloured", "grey"), ("grey", "coloured", "grey_too")])
def test_workers_change_the_variant_between_experiments(names, experiments, alone, tmp_path):
    for name, rows in run(experiments, names, tmp_path, workers=2).items():
        assert rows.equals(alone[name])


def test_a_grey_experiment_in_the_variant_of_colour_has_other_rows(experiments, alone, tmp_path):
    """Negative control: three channels of a grey scene average their noise."""
    (made,) = run_experiments([(experiments["grey"], tmp_path / "grey")], variant="llvm_ad_rgb")
    assert not made.results.equals(alone["grey"])
    errors = [rows["error_deg"].drop_nulls().to_numpy() for rows in (made.results, alone["grey"])]
    assert np.all(np.abs(errors[0] - errors[1]) > 1e-6)


def test_the_meshes_of_a_label_go_when_the_next_one_comes(experiments, tmp_path, monkeypatch):
    forgotten = []
    monkeypatch.setattr(case_work, "forget_meshes", lambda: forgotten.append(None))
    case_work._forget_meshes_of_others.cache_clear()
    run_experiments([(experiments[name], tmp_path / name) for name in ("grey", "grey_too")])
    # Of two settings each, which share their label.
    assert len(forgotten) == 2


def test_jobs_of_one_variant_follow_each_other(experiments, tmp_path):
    jobs = make_jobs([(experiments[name], tmp_path / name) for name in ("grey", "coloured", "grey_too")], None)
    assert [job.folder.name for job in by_variant(jobs)] == ["grey", "grey_too", "coloured"]
    assert len({job.digest for job in jobs}) == 3


def test_each_variant_of_a_run_has_processes_of_its_own(experiments, alone, tmp_path):
    """Colour on top of what grey frames leave in a process took a night to 2.4 GB."""
    runs = []

    class Counted(LocalEngine):
        def run(self, task, arguments, on_step):
            runs.append({part.experiment.name for part in arguments})
            yield from super().run(task, arguments, on_step)

    names = ("grey", "coloured", "grey_too")
    jobs = [(experiments[name], tmp_path / name) for name in names]
    made = run_experiments(jobs, engine=Counted(1))
    assert runs == [{"grey", "grey_too"}, {"coloured"}]
    for name, run_of in zip(names, made, strict=True):
        assert run_of.results.equals(alone[name])


@pytest.mark.parametrize(("keys", "coloured"), [
    ('"reflectance.diffuse" = 0.5', False),
    ('"reflectance.diffuse" = 0.5, "reflectance.colour" = [0.5, 0.5, 0.5]', False),
    ('"reflectance.diffuse" = 0.5, "reflectance.colour" = [0.85, 0.45, 0.4]', True),
    ('"rig.lights" = [{}, { offset_mm = 2.0, colour = [1.0, 0.9, 0.8] }]', True),
    ('"instruments" = [{ kind = "shaft", tip = [0.5, 0.5] }]', True),
    ('"instruments" = [{ kind = "shaft", tip = [0.5, 0.5], present = false }]', False),
])  # fmt: skip
def test_whatever_is_not_grey_is_rendered_in_colour(keys, coloured, tmp_path):
    """Bases and lights of a colour were rendered grey without a word."""
    path = tmp_path / "own.toml"
    path.write_text(GREY.replace('"sensor.noise_sigma" = 0.02', f'"sensor.noise_sigma" = 0.02, {keys}'.strip(", ")))
    cases = expand(load_experiment(path))
    scene, _ = cases[0].scene(load_experiment(path), 0)
    assert scene.is_coloured == coloured
    assert variant_of(cases) == ("llvm_ad_rgb" if coloured else "llvm_ad_mono")
    assert Session(scene).variant == variant_of(cases)


@pytest.mark.parametrize("drawn", ["low = 0.2, high = 0.6", "low = 0.8, high = 0.9"])
def test_a_colour_that_is_drawn_is_rendered_in_colour(drawn, tmp_path):
    """One that is grey at the lower end was rendered grey."""
    path = tmp_path / "own.toml"
    grey = GREY.replace('"sensor.noise_sigma" = 0.02', '"reflectance.colour" = [0.8, 0.8, 0.8]')
    path.write_text(grey + '[groups.random]\n"reflectance.colour.1" = {' + drawn + "}\n")
    assert variant_of(expand(load_experiment(path))) == "llvm_ad_rgb"


def test_the_variant_is_that_of_the_scenes_unless_one_is_named(experiments):
    for name, experiment in experiments.items():
        cases = expand(experiment)
        assert variant_of(cases) == VARIANTS[name]
        assert variant_of(cases, "cuda") == VARIANTS[name].replace("llvm", "cuda")
        assert variant_of(cases, "llvm_ad_mono") == "llvm_ad_mono"
