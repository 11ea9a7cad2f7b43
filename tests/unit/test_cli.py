"""The command line: what it prints, how it fails, its manners, and that a stopped run goes on."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
import types
import warnings
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import polars as pl
import pytest

import simtest
import simtest.report
from simtest import api
from simtest.cli import commands, common, progress
from simtest.cli import main as front
from simtest.cli.common import PictureOptions, gather_settings
from simtest.cli.pictures import reconstruct
from simtest.cli.runs import validate
from simtest.cli.scenes import HEADINGS, names_of, render
from simtest.dataset import verify as verifying
from simtest.errors import InputError
from simtest.estimators.names import DESCRIPTIONS, ESTIMATORS, describe_estimators, load_estimators
from simtest.rendering import backend
from simtest.rendering.backend import BackendReport
from simtest.runtime import messages
from simtest.runtime.boundary import suggestion
from simtest.runtime.resources import OWN
from simtest.simulation.highlights import NO_HIGHLIGHT, REMEDIES
from simtest.spec import load_dataset, load_experiment, load_profile, load_scene
from simtest.validation import runner

ROOT = Path(__file__).resolve().parents[2]
MAIN = "from simtest.cli.main import main; main()"
STOPPED_AFTER_A_CASE = """
import os, signal

replace = os.replace


def and_stop(source, target, **more):
    replace(source, target, **more)
    if os.fspath(target).endswith("case-00000.parquet"):
        os.kill(os.getpid(), signal.SIGINT)


os.replace = and_stop
"""
"""A process that is stopped by Ctrl-C once its first case is kept, however fast it is."""
SMALL = {"camera.width": 96, "camera.height": 96, "camera.fx": 96.0, "camera.fy": 96.0}
SET_SMALL = [part for key, value in SMALL.items() for part in ("--set", f"{key}={value}")]
EXPERIMENT = """
realisations = 4
[[groups]]
scene = "plane"
set = { "camera.width" = 96, "camera.height" = 96, "camera.fx" = 96.0, "camera.fy" = 96.0 }
sweep = [{ "surface.tilt_deg" = [0.0, 2.0, 4.0, 6.0, 8.0] }]
[groups.random]
"surface.azimuth_deg" = { low = 0.0, high = 360.0 }
"""
pytestmark = pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """Keep the user's cache out of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


def child(*arguments, folder=None):
    command = [sys.executable, "-c", MAIN, *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)


def without_bar(lines):
    """Leave out the progress bar's lines."""
    return [line for line in lines if "━" not in line]


def test_the_installed_command_answers():
    from importlib.metadata import entry_points, version

    (point,) = entry_points(group="console_scripts", name="simtest")
    assert point.load() is front.main
    done = child("--version")
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, version("simtest"), "")


def shipped(kind):
    return sorted(file.stem for file in (ROOT / "scenes" / kind).glob("*.toml"))


@pytest.mark.parametrize(("command", "kind", "page"), [("validate", "experiments", "howto/experiments.md"),
                                                       ("dataset", "datasets", "howto/datasets.md")])  # fmt: skip
def test_help_and_pages_name_all_that_is_shipped(here, command, kind, page):
    code, output, _ = here(command, "--help")
    assert code == 0
    told = " ".join(output.replace("│", " ").split())
    listed = re.search(r"shipped one: ([\w, ]+)\.", told).group(1).split(", ")
    assert sorted(listed) == shipped(kind)
    text = (ROOT / "docs" / page).read_text()
    assert not [name for name in listed if not re.search(rf"\b{name}\b", text)]


# Bad use ---------------------------------------------------------------------------------------------------------
BAD_USE = {
    "frobnicate": 'Unknown command "frobnicate". Available commands: ',
    "render": "SCENE: missing (A scene file, a sample's JSON, or a shipped scene); simtest render --help describes it",
    "views colon": "--out: missing (Folder for the results; made if need be); simtest views --help describes it",
    "render plane --out": "--out: needs a value (Folder for the results",
    "reconstruct none.png --fov 60": "none.png: no such file",
    "score answers.csv": "--on: missing (Run or dataset whose frames were exported",
    "core check": "COMMAND: missing; simtest core check --help describes it",
    "core check .": "estimator 'command: .': . is a folder; must be a program",
    "camera convert cam.toml --out .": "--out .: is a folder; must be a file",
    "render plane --out x --frob 3": "Unknown option: --frob",
    "render plain --out x": "plain: no such file; shipped by name: anatomy, cylinder, plane",
    "render plane --out x --set tilt": "--set tilt: must be key=value, for example surface.distance_mm=12",
    "render plane --out x --set surface.typo=1": "surface.typo = 1: unknown key; allowed: type, relief, distance_mm",
    "render plane --out x --set surface.tilt_deg.x=1": "surface.tilt_deg is a plain value, not a table",
    "schema kidney": 'Invalid value "kidney" for OF. Choose from: "scene", "experiment", "dataset"',
    "fit none.png --recipe tiny --out x": "--out x: must be a file whose name ends in .toml",
    "fit none.png --recipe endoscopy --out x.toml": "--scene is needed where a recipe has several families",
    "fit none.png --recipe smooth --scene sea --out x.toml": "--scene sea; must name one of its base scenes",
    "dataset tiny --out made --samples 0": "tiny.toml with replaced values: samples = 0: must be greater than or equal",
    "dataset tiny --out made --workers 0": "workers = 0: must be 1 to 256",
    "dataset verify nowhere": "nowhere: no such folder",
    "dataset sample nowhere 0": "nowhere: no dataset to read (manifest.json: missing)",
    "validate stomach": "sensor; tissue_stomach is a scene",
    "validate plain": "plain: no such file; shipped by name: anatomy, anatomy_sensor, camera, colon, compare",
    "validate overview --realisations many": "Invalid value for --realisations: many is not a whole number",
    **{
        f"{command} --seed -1": "Invalid value for --seed: -1 is no seed; must be a whole number from 0 to 922"
        for command in (
            "validate overview",
            "dataset tiny --out x",
            "mesh colon --out x.ply",
            "twin x.png --out x",
            "advise laparoscope --out x",
            "realism x.png --against plane --out x",
            "fit x.png --recipe smooth --out x.toml",
        )
    },
    f"validate overview --seed {2**63}": "is no seed; must be a whole number from 0 to 9223372036854775807",
    "validate overview --estimator magic": "estimator 'magic': not installed; allowed: ",
    "reconstruct none.png --out x": "--camera or --fov: exactly one of them must be given",
    "twin none.png --fov 60 --out x": "none.png: ",
    "twin none.png --fov 60 --frames 0 --out x": "--frames 0: must be 1 to 1000",
    "twin none.png --fov 400 --out x": "none.png: ",
}


@pytest.mark.parametrize("line", BAD_USE)
def test_bad_use_exits_2_with_one_line(here, tmp_path, line):
    code, output, errors = here(*line.split())
    assert code == 2
    assert output == ""
    (message,) = without_bar(errors)
    assert message.startswith("simtest: ")
    assert BAD_USE[line] in message
    assert not list(tmp_path.iterdir())


def test_an_unexpected_error_gives_one_line(here, monkeypatch):
    def fails(*_, **__):
        raise RuntimeError("first line\nsecond line")

    monkeypatch.setattr(api, "render", fails)
    code, output, errors = here("render", "plane", "--out", "x")
    assert (code, output) == (1, "")
    assert errors == [
        "simtest: internal error, please report it (RuntimeError: first line second line); --traceback shows where"
    ]


# Schemas ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("of", "keys"),
    [
        ("scene", {"surface", "reflectance", "rig", "camera", "sensor", "render"}),
        ("camera", {"width", "height", "fx", "fy", "cx", "cy", "skew"}),
        ("profile", {"experiments", "description", "title"}),
    ],
)
def test_schemas_are_json(here, of, keys):
    code, output, errors = here("schema", of)
    assert (code, errors) == (0, [])
    schema = json.loads(output)
    assert schema["type"] == "object"
    assert keys <= set(schema["properties"])
    # Unknown keys are refused, by an editor too.
    assert schema["additionalProperties"] is False


# Rendering -------------------------------------------------------------------------------------------------------
WRITTEN = ("frame.png", "radiance.exr", "truth.npz", "frame.json", "camera.toml", "calibration.toml", "preview.jpg")

TRUTH = {
    "depth_mm": (), "position_mm": (3,), "normal": (3,), "shading_normal": (3,), "geometric_normal": (3,),
    "curvature": (2,), "direction_min": (3,), "direction_max": (3,), "radiance_specular": (), "radiance_diffuse": (),
    "radiance_indirect": (), "mask": (), "normal_base": (3,), "curvature_base": (2,), "pool": (),
}  # fmt: skip


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Return the folders of one scene rendered by two processes."""
    folder = tmp_path_factory.mktemp("frames")
    command = [sys.executable, "-c", MAIN, "render", "sphere", *SET_SMALL, "--out"]
    children = [
        subprocess.Popen([*command, name], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for name in ("first", "second")
    ]
    for process, name in zip(children, ("first", "second"), strict=True):
        output, errors = process.communicate(timeout=120)
        assert (process.returncode, errors) == (0, "")
        assert output.split() == [f"{name}/{file}" for file in WRITTEN]
    return folder / "first", folder / "second"


@pytest.mark.render
def test_render_writes_its_files_with_the_documented_keys(frames):
    first, _ = frames
    assert {path.name for path in first.iterdir()} == set(WRITTEN)
    assert (first / "frame.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    with np.load(first / "truth.npz", allow_pickle=False) as truth:
        assert set(truth.files) == set(TRUTH)
        for name, tail in TRUTH.items():
            assert truth[name].shape == (96, 96, *tail)
            assert truth[name].dtype == (bool if name in ("mask", "pool") else np.float32)
        mask, normal = truth["mask"], truth["normal"]
        assert mask.any()
        assert not mask.all()
        assert np.isnan(truth["depth_mm"][~mask]).all()
        np.testing.assert_allclose(np.linalg.norm(normal[mask], axis=-1), 1, atol=1e-6)
        assert (np.einsum("ni,ni->n", normal[mask], truth["position_mm"][mask]) < 0).all()
    described = json.loads((first / "frame.json").read_text())
    assert {"scene", "camera", "full_scale", "highlights", "fields", "provenance"} <= set(described)
    assert described["camera"]["K"] == [[96, 0, 48], [0, 96, 48], [0, 0, 1]]
    assert described["scene"]["surface"]["type"] == "sphere"
    (highlight,) = described["highlights"]
    assert highlight["isolated"] is True
    for key in TRUTH:
        assert any(key in field.split(", ") for field in described["fields"])


@pytest.mark.render
def test_render_gives_the_same_bytes_twice(frames):
    first, second = frames
    assert (first / "frame.png").read_bytes() == (second / "frame.png").read_bytes()
    with np.load(first / "truth.npz") as one, np.load(second / "truth.npz") as other:
        for name in one.files:
            assert one[name].tobytes() == other[name].tobytes()


@pytest.mark.render
def test_an_out_that_cannot_be_written(here, tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("mine")
    for out, said in (
        (plain, f"--out {plain}: is a file; must be a folder"),
        (plain / "below", f"{plain / 'below'}: Not a directory"),
    ):
        code, output, errors = here("render", "plane", *SET_SMALL, "--out", out)
        assert (code, output, len(errors)) == (2, "", 1)
        assert errors[0] == f"simtest: {said}"
    assert [path.name for path in tmp_path.iterdir()] == ["plain"]
    assert plain.read_text() == "mine"


@pytest.mark.render
def test_export_writes_what_mitsuba_loads(here, tmp_path):
    code, output, errors = here("export", "saddle", *SET_SMALL, "--out", tmp_path / "out")
    assert (code, errors) == (0, [])
    assert output.splitlines() == [str(tmp_path / "out" / name) for name in ("scene.xml", "surface.ply")]
    assert all((tmp_path / "out" / name).stat().st_size > 1000 for name in ("scene.xml", "surface.ply"))
    code, output, errors = here("export", "plane", *SET_SMALL, "--set", "camera.skew=1", "--out", tmp_path / "no")
    assert (code, output, len(errors)) == (2, "", 1)
    assert "camera.skew = 1.0: cannot be exported" in errors[0]
    assert not (tmp_path / "no").exists()


@pytest.mark.render
def test_a_frame_without_a_highlight_says_what_to_change(here, tmp_path):
    code, output, _ = here("render", "plane", *SET_SMALL, "--set", "surface.tilt_deg=60", "--out", tmp_path / "x")
    assert (code, output.splitlines()[0]) == (0, f"{NO_HIGHLIGHT}: {REMEDIES[NO_HIGHLIGHT]}")


@pytest.mark.render
def test_a_scene_out_of_sight(here):
    code, output, errors = here("render", "sphere", *SET_SMALL, "--set", "camera.cx=470", "--out", "x")
    assert (code, output) == (2, "")
    assert errors == ["simtest: scene sphere: no pixel sees the surface; move it, or widen the field of view"]


@pytest.mark.render
def test_an_unknown_variant_exits_2(here):
    code, output, errors = here("render", "plane", *SET_SMALL, "--out", "x", "--variant", "scalar_mono")
    assert (code, output, len(errors)) == (2, "", 1)
    assert "variant 'scalar_mono': cannot be used; allowed: " in errors[0]


def test_a_stopped_render_writes_nothing(here, monkeypatch, tmp_path):
    """Ctrl-C waits for the end of a step."""

    def render(scene, settings, variant, progress):
        progress(1, 10, "rendering")
        os.kill(os.getpid(), signal.SIGINT)
        progress(2, 10, "rendering")
        raise AssertionError("not stopped")

    monkeypatch.setattr(api, "render", render)
    code, output, errors = here("render", "plane", "--out", tmp_path / "frame")
    assert (code, output) == (130, "")
    assert errors[-1] == "simtest: stopped; nothing is written"
    assert not (tmp_path / "frame").exists()


# Validation ------------------------------------------------------------------------------------------------------


def test_validate_refuses_what_it_has_not_made(here, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    code, output, errors = here("validate", "overview", "--out", other)
    assert (code, output) == (2, "")
    said = f"--out {other}: holds notes.txt, which is no part of a run; must be empty or hold a run"
    assert without_bar(errors) == [f"simtest: {said}"]
    assert [path.name for path in other.iterdir()] == ["notes.txt"]


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """Stop a run after its first case; gives its folder, its experiment, and what the process said."""
    folder = tmp_path_factory.mktemp("stopped")
    (folder / "tiny.toml").write_text(EXPERIMENT)
    out = folder / "run"
    command = [sys.executable, "-c", STOPPED_AFTER_A_CASE + MAIN, "validate", "tiny.toml", "--out", str(out)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    # Noted now: another test goes on with the run, and the order of tests is anybody's.
    held = {path.name for path in (*out.iterdir(), *(out / "parts").iterdir())}
    return out, folder / "tiny.toml", held, done.returncode, done.stdout, done.stderr


@pytest.mark.render
def test_a_stopped_run_keeps_its_finished_cases(stopped):
    _, _, held, code, output, errors = stopped
    assert (code, output) == (130, "")
    assert without_bar(errors.splitlines()) == [
        "simtest: stopped; what is finished is kept, and the same command goes on from there"
    ]
    assert {"fingerprint.json", "case-00000.parquet"} <= held
    assert not {"results.parquet", "case-00004.parquet"} & held
    # No half-written file stays behind.
    assert not [name for name in held if name.startswith(".")]


@pytest.mark.render
def test_the_same_command_goes_on_and_gives_the_same_results(here, monkeypatch, stopped, tmp_path):
    out, experiment, *_ = stopped
    runs = []
    run_experiment = runner.run_experiment

    def spy(*arguments, **options):
        runs.append(run_experiment(*arguments, **options))
        return runs[-1]

    monkeypatch.setattr(runner, "run_experiment", spy)
    # The report has its own tests and takes longer than the run.
    monkeypatch.setattr(simtest.report, "write_report", lambda folder, *_: folder / "index.html")
    monkeypatch.setattr("simtest.cli.runs.print_guide", lambda run: None)
    monkeypatch.chdir(experiment.parent)
    # What a killed run was writing is no obstacle.
    (out / ".results.99999.part.parquet").write_bytes(b"half")
    code, output, errors = here("validate", experiment.name, "--out", out)
    assert code == 0, errors
    assert output.strip() == str(out / "index.html")
    assert runs[0].resumed >= 1
    assert {path.name for path in out.iterdir()} == {"results.parquet", "summary.json", "gallery"}

    undisturbed = run_experiment(load_experiment(experiment), tmp_path / "run")
    assert undisturbed.resumed == 0
    one, other = (pl.read_parquet(folder / "results.parquet") for folder in (out, tmp_path / "run"))
    assert one.height == 5 * 4 * 3
    assert one["status"].unique().to_list() == ["ok"]
    assert one.equals(other)
    assert (out / "results.parquet").read_bytes() == (tmp_path / "run" / "results.parquet").read_bytes()


@pytest.mark.render
def test_a_corrupt_record_starts_the_run_again(tmp_path, stopped):
    _, experiment, *_ = stopped
    described = load_experiment(experiment, {"surface.tilt_deg": 0.0, "realisations": 1})
    parts = tmp_path / "run" / "parts"
    parts.mkdir(parents=True)
    for content in (b"{", b"\xff\xfe", b"", b'"0"'):
        (parts / "fingerprint.json").write_bytes(content)
        (parts / "case-00000.parquet").write_bytes(b"of another run")
        assert runner.run_experiment(described, tmp_path / "run").resumed == 0
        parts.mkdir()


# Lists and completion --------------------------------------------------------------------------------------------


def test_the_list_names_what_commands_take(here):
    code, output, errors = here("list", "--json")
    assert (code, errors) == (0, [])
    listed = json.loads(output)
    assert list(listed) == list(HEADINGS)
    loaders = {"scenes": load_scene, "experiments": load_experiment, "datasets": load_dataset, "profiles": load_profile}
    for kind, load in loaders.items():
        for name in listed[kind]:
            if name != "published":  # a scene of validate alone
                load(name)
    assert list(listed["estimators"]) == ESTIMATORS.names()
    for name in listed["sensors"]:
        load_scene("plane", {"sensor.preset": name})
    for name in listed["rigs"]:
        load_scene("plane", {"rig.preset": name})
    # An editable installation may be older than the checkout, and register detectors that are gone.
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"]
    listed["detectors"] = {name: listed["detectors"][name] for name in declared["simtest.detectors"]}
    # A line about each, which says more than the name.
    assert all(len(about) > 5 and "\n" not in about for names in listed.values() for about in names.values())


def test_one_kind_is_listed_alone(here):
    code, output, _ = here("list", "profiles")
    lines = output.splitlines()
    assert code == 0
    assert [line.split()[0] for line in lines] == ["full", "quick"]
    assert here("list", "profile")[2] == [
        'simtest: Invalid value "profile" for KIND. Choose from: "scenes", "experiments", "datasets", "profiles", '
        '"estimators", "detectors", "sensors", "rigs". Did you mean "profiles"?'
    ]


def test_estimators_have_one_description():
    lines = {name: line.rstrip(".") for name, line in DESCRIPTIONS.items()}
    assert names_of("estimators").items() >= lines.items()
    assert f"{OWN}:cone_axis" not in names_of("estimators")
    assert describe_estimators([f"{OWN}:cone_axis"]) == {f"{OWN}:cone_axis": DESCRIPTIONS["cone_axis"]}


def test_an_estimator_without_a_docstring_has_its_modules_line(monkeypatch):
    module = types.ModuleType("own_core", "Centroid of the highlight.\n\nMore of it.")
    exec("class Own:\n    def estimate(self, patch, camera, priors): ...\nown = Own()", vars(module))
    monkeypatch.setitem(sys.modules, "own_core", module)
    monkeypatch.setattr("simtest.estimators.names.load_estimators", lambda names: {names[0]: module.own})
    assert describe_estimators(["own"]) == {"own": "Centroid of the highlight."}


def test_a_mesh_in_place_of_an_experiment_is_told_its_command(tmp_path):
    with pytest.raises(InputError, match=r"simtest validate mesh --set surface\.path=.*tube\.ply"):
        validate(str(tmp_path / "tube.ply"))


def test_several_estimators_in_one_word_are_told_apart():
    with pytest.raises(InputError, match="--estimator cone_axis --estimator curved"):
        load_estimators(["cone_axis,curved"])


def test_every_command_has_its_help(here):
    for name in commands.COMMANDS:
        code, output, errors = here(name, "--help")
        assert (code, errors) == (0, [])
        assert output.startswith(f"Usage: simtest {name}")
        assert "--quiet" in output


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_shells_get_a_script_that_names_the_commands(here, shell):
    code, output, errors = here("completion", shell)
    assert (code, errors) == (0, [])
    assert not [name for name in commands.COMMANDS if name not in output]


def test_names_and_files_are_completed(tmp_path, monkeypatch):
    from simtest.cli.common import named

    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").touch()
    (tmp_path / "mine.png").touch()
    (tmp_path / "more").mkdir()
    complete = named("datasets", files=True).completer
    assert set(complete(SimpleNamespace(incomplete="m"))) == {*names_of("datasets"), "mine.toml", "more/"}
    assert set(complete(SimpleNamespace(incomplete=f"{tmp_path}/mi"))) - set(names_of("datasets")) == {
        f"{tmp_path}/mine.toml"
    }


# Did you mean ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("rendr plane", 'Did you mean "render"?'),
        ("render plan --out x", "(did you mean plane?)"),
        ("nightly --profile quik", "(did you mean quick?)"),
        ("validate overview --estimator circle", "(did you mean circle_pose?)"),
        ("render plane --out x --set surface.tilt=3", "(did you mean tilt_deg?)"),
        ("render plane --out x --set reflectance.type=phonk", "(did you mean phong?)"),
        ("validate overview --set surfase.tilt_deg=3", "(did you mean surface?)"),
        ("doctor --verbse", 'Did you mean "--verbose"?'),
        ("render plane --out x --quite", 'Did you mean "--quiet"?'),
        ("doctor --quiet=1", "simtest: --quiet: takes no value"),
    ],
)
def test_a_mistyped_name_is_guessed(here, tmp_path, line, meant):
    code, output, errors = here(*line.split())
    assert (code, output, len(errors)) == (2, "", 1)
    assert meant in errors[0]
    assert not list(tmp_path.iterdir())


def test_nothing_is_guessed_where_nothing_is_close():
    assert suggestion("kidney", ["plane", "sphere"]) == ""
    assert suggestion("", ["plane"]) == ""
    begun = time.process_time()
    suggestion("x" * 10**6, ["plane"] * 100)
    assert time.process_time() - begun < 0.5


# Settings --------------------------------------------------------------------------------------------------------


def test_settings_are_gathered_for_the_parser():
    given = ["render", "plane", "--set", "a=1", "--out", "x", "--set", "b=2", "--set", "--quiet", "--", "--set", "c=3"]
    gathered = ["render", "plane", "--set", "a=1\0b=2", "--out", "x", "--set", "--quiet", "--", "--set", "c=3"]
    assert gather_settings(given) == gathered
    assert gather_settings(["doctor"]) == ["doctor"]
    assert gather_settings(["x", "--set"]) == ["x", "--set"]


def test_thousands_of_settings_take_linear_time(here):
    words = [word for i in range(5000) for word in ("--set", f"surface.tilt_deg={i}")]
    begun = time.process_time()
    code, _, errors = here("render", "plane", "--out", "x", *words)
    # One by one they took minutes.
    assert time.process_time() - begun < 5
    assert code == 2
    assert "surface.tilt_deg = 4999: must be less than 90" in errors[0]


# JSON ------------------------------------------------------------------------------------------------------------


def test_doctor_prints_one_document(here, monkeypatch):
    report = BackendReport("llvm_ad_mono", None, [], {"mitsuba": "3"}, "broken")
    monkeypatch.setattr(backend, "examine", lambda _: report)
    code, output, _ = here("doctor", "--json")
    assert code == 1
    assert json.loads(output)["problem"] == "broken"


@pytest.mark.parametrize("count", [0, 30])
def test_a_verdict_on_a_dataset_as_json_and_as_lines(here, monkeypatch, count):
    faults = [verifying.Fault(f"shard-{i}.tar", "missing") for i in range(count)]
    monkeypatch.setattr(verifying, "verify", lambda folder, progress: faults)
    code, output, _ = here("dataset", "verify", "d", "--json")
    told = json.loads(output)
    assert code == (1 if count else 0)
    assert told["sound"] is (count == 0)
    assert told["faults"] == [{"file": f"shard-{i}.tar", "what": "missing"} for i in range(count)]
    # Of many lines the first are printed, and all with --verbose.
    code, output, _ = here("dataset", "verify", "d")
    lines = output.splitlines()
    assert lines[-1] == ("30 faults" if count else "sound")
    if count == 30:
        assert len(lines) == 22
        assert lines[20] == "and 10 more; --verbose prints them all"
        assert len(here("dataset", "verify", "d", "--verbose")[1].splitlines()) == 31


def test_json_holds_neither_nan_nor_paths_that_break_it(capsys):
    common.print_json({"x": float("nan"), "y": np.array([1.0, np.inf]), "file": Path("a/b")})
    assert json.loads(capsys.readouterr().out) == {"x": None, "y": [1.0, None], "file": "a/b"}


def test_reports_are_json_on_request():
    """Each command that reports takes --json: whoever adds one is reminded."""
    reports = {"calibrate check", "calibrate light", "core check", "score", "advise", "twin",
               "doctor", "list", "render", "views", "view", "export", "reconstruct", "realism", "fit", "validate",
               "nightly", "nightly accept", "dataset", "dataset verify", "dataset sample", "dataset preview",
               "dataset export", "mesh check", "mesh colon", "mesh liver", "bench run", "bench table",
               "bench cases", "bench frames", "camera show", "camera convert"}  # fmt: skip
    without = {"schema", "completion", "mesh"}  # a schema is JSON, a script is none, mesh alone does nothing
    for name in reports:
        found, *_ = commands.APP.parse_commands(name.split())[1][-1:]
        assert any("--json" in argument.names for argument in found.assemble_argument_collection()), name
    assert {name.split()[0] for name in reports} | without == set(commands.COMMANDS)


def test_a_command_that_is_gone_says_what_takes_its_place(here):
    assert not set(commands.GONE) & set(commands.COMMANDS)
    for name, instead in commands.GONE.items():
        assert here(name, "--out", "x") == (2, "", [f"simtest: {name}: is gone; {instead}"])


# How much is said ------------------------------------------------------------------------------------------------


def test_flags_stand_anywhere_but_behind_two_dashes():
    assert front.take_flags(["--quiet", "render", "x", "--traceback"]) == (["render", "x"], True)
    assert (front.MANNERS.quiet, front.MANNERS.verbose) == (True, False)
    assert front.take_flags(["-v", "render"]) == (["render"], False)
    assert (front.MANNERS.quiet, front.MANNERS.verbose) == (False, True)
    assert front.take_flags(["render", "--", "--verbose"]) == (["render", "--", "--verbose"], False)
    assert (front.MANNERS.quiet, front.MANNERS.verbose) == (False, False)


def test_quiet_and_verbose_exclude_each_other(here):
    assert here("doctor", "--quiet", "--verbose")[::2] == (
        2, ["simtest: --quiet and --verbose exclude each other; give one of them"],
    )  # fmt: skip


def warned(*_):
    warnings.warn("look here", stacklevel=1)
    return BackendReport("llvm_ad_mono", None, [], {}, None)


@pytest.mark.parametrize(("flags", "lines"), [((), ["simtest: warning: look here"]), (("--quiet",), []), (("-q",), [])])
def test_quiet_leaves_out_warnings(here, monkeypatch, flags, lines):
    monkeypatch.setattr(backend, "examine", warned)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, output, errors = here("doctor", *flags)
    assert (code, errors) == (0, lines)
    assert "rendering   works" in output


def test_verbose_prints_the_debug_messages_of_the_logger(here):
    assert here("schema", "-v")[2] == []
    errors = here("mesh", "colon", "--out", "x.ply", "--edge-mm", "20", "-v")[2]
    assert any(line.startswith("simtest: debug: colon is ") and line.endswith("colon.toml") for line in errors)
    assert here("mesh", "colon", "--out", "y.ply", "--edge-mm", "20")[2] == []
    # Nothing of that stays in the process.
    logger = logging.getLogger("simtest")
    assert (logger.level, [type(handler) for handler in logger.handlers]) == (logging.NOTSET, [logging.NullHandler])


def test_the_quiet_leave_out_notes(capsys, monkeypatch):
    told = common.Told(["file"], parts=["note: a note", "a result"])
    told.print(False)
    assert capsys.readouterr().out.splitlines() == ["note: a note", "a result", "file"]
    monkeypatch.setattr(front.MANNERS, "quiet", True)
    told.print(False)
    assert capsys.readouterr().out.splitlines() == ["a result", "file"]


def test_a_program_gets_warnings_in_the_logger_where_it_asks_for_them(caplog, monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        messages.log_warnings()
        warnings.warn("look here", stacklevel=1)
    assert caplog.record_tuples == [("simtest", logging.WARNING, "look here")]


SHORT = {"--out": "-o", "--samples": "-n", "--realisations": "-n", "--count": "-n"}


def test_options_of_all_commands_have_the_same_short_names():
    seen = set()

    def look(app):
        for name in app:
            if not name.startswith("-"):
                look(app[name])
        if app.default_command is not None:
            for argument in app.assemble_argument_collection():
                for name in set(argument.names) & set(SHORT):
                    assert SHORT[name] in argument.names, (app.name, argument.names)
                    seen.add(name)

    look(commands.APP)
    assert seen == set(SHORT)


def steps(capsys):
    with progress.progress_bar("the end") as move:
        for done in range(4):
            move(done, 3, f"step {done}")
    return capsys.readouterr().err.splitlines()


def test_a_log_gets_plain_lines_now_and_then(capsys, monkeypatch):
    # Short work leaves no line ...
    assert steps(capsys) == []
    # ... long work one every ten seconds ...
    seconds = iter([0.0, 1.0, 6.0, 16.0, 17.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(seconds))
    assert steps(capsys) == ["simtest: 2/3 step 2 (16 s)"]
    monkeypatch.undo()
    # ... and each step only if asked for.
    monkeypatch.setattr(front.MANNERS, "verbose", True)
    assert steps(capsys) == [f"simtest: {i}/3 {'the end' if i == 3 else f'step {i}'} (0 s)" for i in range(4)]


def test_long_tables_are_cut_unless_asked_for(capsys, monkeypatch):
    rows = [[f"row[{i}]", "x"] for i in range(108)]
    common.Table(("name", "value"), rows).print()
    output = capsys.readouterr().out
    # What looks like markup is text.
    assert "row[19]" in output
    assert "row[20]" not in output
    assert output.splitlines()[-1] == "and 88 more; --verbose prints them all"
    assert common.first(rows, "results.csv holds them")[1] == [
        "and 88 more; --verbose prints them all, results.csv holds them"
    ]
    monkeypatch.setattr(front.MANNERS, "verbose", True)
    common.Table(("name", "value"), rows).print()
    assert "row[107]" in capsys.readouterr().out


def test_a_command_prints_the_record_that_it_returns(capsys):
    made = []

    def data():
        made.append("data")
        return {"a": 1}

    def parts(count):
        made.append("parts")
        yield f"{count} lines"
        yield common.Table(("name",), [["cell"]])
        yield lambda: print("by itself")

    @common.command
    def told(*, count: int = 1) -> common.Told:
        return common.Told([Path("x")], data, parts(count), 3)

    assert told(count=2) == 3
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0], *lines[-2:]) == ("2 lines", "by itself", "x")
    assert "│ cell │" in lines
    assert told(as_json=True) == 3
    assert json.loads(capsys.readouterr().out) == {"a": 1, "files": ["x"]}
    # What is not printed is not made.
    assert made == ["parts", "data"]
    # Where there is nothing to tell, nothing is printed.
    assert common.command(lambda: common.Told())(as_json=True) == 0
    assert capsys.readouterr().out == ""


class Spots(list):
    """Specularities without an estimate or a reference: two of three isolated, the others clusters."""

    reference, sightline_rule = None, ()

    def __init__(self, count):
        super().__init__(
            SimpleNamespace(id=i, kind="cluster" if i % 3 == 0 else "isolated", score=0.5, best=None,
                            best_estimate=None, cloud=None, peak_px=(1.0, 2.0), normals={})
            for i in range(count)
        )  # fmt: skip


def test_many_specularities_become_a_summary(capsys, monkeypatch):
    from simtest.cli.pictures import record_tables

    def printed(count):
        common.Told(parts=record_tables(Spots(count))).print(False)
        return capsys.readouterr().out

    assert printed(20).count("isolated") == 13
    summary = printed(108)
    assert [line.split()[1::2][:3] for line in summary.splitlines() if "none" in line] == [
        ["isolated", "none", "72"], ["cluster", "none", "36"],
    ]  # fmt: skip
    assert "--verbose prints a row for each of the 108" in summary
    monkeypatch.setattr(front.MANNERS, "verbose", True)
    assert printed(108).count("isolated") == 72


def test_a_night_prints_its_verdict_as_json(here, monkeypatch, tmp_path):
    import simtest.nightly.run

    verdict = {"state": "regression", "exit_code": 1}
    (tmp_path / "verdict.json").write_text(json.dumps(verdict))
    judged = SimpleNamespace(verdict=SimpleNamespace(exit_code=1))
    made = SimpleNamespace(judged=judged, folder=tmp_path)
    monkeypatch.setattr(simtest.nightly.run, "run_nightly", lambda *_: made)
    code, output, errors = here("nightly", "--json")
    assert (code, errors) == (1, [])
    assert json.loads(output) == {**verdict, "files": [str(tmp_path / "index.html")]}


def test_pictures_and_frames_have_a_folder_of_their_own_where_none_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shot = np.full((60, 80, 3), 90, np.uint8)
    cv2.circle(shot, (40, 30), 4, (255, 255, 255), -1)
    cv2.imwrite("shot.png", shot)
    with pytest.warns(UserWarning, match="angles depend"):
        reconstruct(Path("shot.png"), known=PictureOptions(fov_deg=60.0))
    assert (tmp_path / "reports/normals/shot/normals.csv").is_file()
    written: list[Path] = []
    drawn = SimpleNamespace(highlights=[], advice="", write=lambda out: written.append(out) or [])
    monkeypatch.setattr("simtest.api.render", lambda *_: drawn)
    render("plane")
    render("plane", out=Path("here"))
    assert written == [Path("reports/frames/plane"), Path("here")]
