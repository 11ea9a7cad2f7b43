"""The command line: what it prints, how it fails, and that a stopped run goes on."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import simtest.report
from simtest import api
from simtest.cli import main as command_line
from simtest.spec import load_experiment
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

SLOW_MODULES = {"mitsuba", "drjit", "vtk", "vtkmodules", "torch", "pyvista", "polars", "matplotlib", "vl_convert"}
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

FILES = ("frame.png", "radiance.exr", "truth.npz", "frame.json", "camera.toml")


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


# Speed -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "statement",
    [
        "import simtest",
        "import simtest; dir(simtest); simtest.__version__",
        "import simtest; simtest.InputError, simtest.Failure",
        "import sys; sys.argv = ['simtest', '--help']; from simtest.cli.main import main; main()",
        "import sys; sys.argv = ['simtest', 'render', '--help']; from simtest.cli.main import main; main()",
        "import sys; sys.argv = ['simtest', 'schema', 'scene']; from simtest.cli.main import main; main()",
    ],
)
def test_light_commands_load_nothing_heavy(statement):
    code = (
        "import atexit, sys\n"
        "atexit.register(lambda: print('LOADED', *{name.split('.')[0] for name in sys.modules}, file=sys.stderr))\n"
        f"{statement}\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    loaded = set(done.stderr.split("LOADED ")[1].split())
    assert "simtest" in loaded
    assert not SLOW_MODULES & loaded


def test_the_installed_command_answers():
    from importlib.metadata import entry_points, version

    (point,) = entry_points(group="console_scripts", name="simtest")
    assert point.load() is command_line.main
    done = child("--version")
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, version("simtest"), "")


def shipped(kind):
    return sorted(file.stem for file in (ROOT / "scenes" / kind).glob("*.toml"))


@pytest.mark.parametrize(("command", "kind", "page"), [("validate", "experiments", "reference/experiments.md"),
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
    "render plane": "--out: missing (Folder for the results; made if need be); simtest render --help describes it",
    "render plane --out": "--out: needs a value (Folder for the results",
    "score answers.csv": "--on: missing (Run or dataset whose frames were exported",
    "core check": "COMMAND: missing; simtest core check --help describes it",
    "core check .": "estimator 'command: .': . is a folder; must be a program",
    "camera convert cam.toml --out .": "--out .: is a folder; must be a file",
    "render plane --out x --frob 3": "Unknown option: --frob",
    "render plane --out x extra": "Unused Tokens: ['extra']",
    "render plain --out x": "plain: no such file; shipped by name: anatomy, cylinder, plane",
    "render plane --out x --set tilt": "--set tilt: must be key=value, for example surface.distance_mm=12",
    "render plane --out x --set =3": "--set =3: must be key=value",
    "render plane --out x --set surface.tilt_deg=95": "values: surface.tilt_deg = 95: must be less than 90",
    "render plane --out x --set surface.typo=1": "surface.typo = 1: unknown key; allowed: type, relief, distance_mm",
    "render plane --out x --set surface.tilt_deg=steep": "surface.tilt_deg = 'steep': must be a number",
    "render plane --out x --set rig.lights.3.power=2": "index 3 is not allowed; the first item is 0",
    "render plane --out x --set surface.tilt_deg.x=1": "surface.tilt_deg is a plain value, not a table",
    "schema kidney": 'Invalid value "kidney" for OF. Choose from: "scene", "experiment", "dataset"',
    "fit none.png --recipe tiny --out x": "--out x: must be a file whose name ends in .toml",
    "fit none.png --recipe endoscopy --out x.toml": "--scene is needed where a recipe has several families",
    "fit none.png --recipe smooth --scene sea --out x.toml": "--scene sea; must name one of its base scenes",
    "dataset tiny": "--out: missing (",
    "dataset kidney --out made": "kidney: no such file; shipped by name: endoscopy, highlights, highlights_smooth, ",
    "dataset tiny --out made --samples 0": "tiny.toml with replaced values: samples = 0: must be greater than or equal",
    "dataset tiny --out made --workers 0": "workers = 0: must be 1 to 256",
    "dataset tiny --out made --set sensor.bits=4": "sensor.bits = 4: must be greater than or equal to 8",
    "dataset verify nowhere": "nowhere: no such folder",
    "dataset sample nowhere 0": "nowhere: no dataset to read (manifest.json: missing)",
    "dataset preview nowhere": "nowhere: no dataset to read (manifest.json: missing)",
    "doctor extra": "Unused Tokens: ['extra']",
    "validate": "EXPERIMENT: missing",
    "validate plain": "plain: no such file; shipped by name: anatomy, anatomy_sensor, camera, colon, compare",
    "validate overview --realisations many": "Invalid value for --realisations: many is not a whole number",
    "validate overview --realisations 0": "with replaced values: realisations = 0: must be greater than or equal to 1",
    **{
        f"{command} --seed {seed}": f"Invalid value for --seed: {seed} is no seed; must be a whole number from 0 to 922"
        for seed in (-1, 2**63)
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
    "validate overview --estimator magic": "estimator 'magic': not installed; allowed: ",
    "validate overview --set surface.typo=1": "surface.typo = 1: unknown key; allowed: ",
    "validate overview --set typo": "--set typo: must be key=value",
    "reconstruct": "IMAGE: missing",
    "reconstruct none.png --fov 60 --out x": "none.png: ",
    "reconstruct none.png --out x": "--camera or --fov: exactly one of them must be given",
    "twin": "FRAME: missing",
    "twin none.png --fov 60 --out x": "none.png: ",
    "twin none.png --out x": "--camera or --fov: exactly one of them must be given",
    "twin none.png --fov 60 --frames 0 --out x": "--frames 0: must be 1 to 1000",
    "twin none.png --fov 60 --frames some --out x": "Invalid value for --frames: some is not a whole number",
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


def test_bad_use_in_a_process_of_its_own():
    done = child("render", "plane", "--out", "x", "--set", "surface.tilt_deg=95")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("simtest: ")


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
        ("experiment", {"groups", "realisations", "seed", "estimators"}),
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


def test_the_default_schema_is_the_scenes(here):
    assert here("schema")[1] == here("schema", "scene")[1]


# Rendering -------------------------------------------------------------------------------------------------------

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
        written = (
            "frame.png",
            "radiance.exr",
            "truth.npz",
            "frame.json",
            "camera.toml",
            "calibration.toml",
            "preview.jpg",
        )
        assert output.split() == [f"{name}/{file}" for file in written]
    return folder / "first", folder / "second"


@pytest.mark.render
def test_render_writes_its_files_with_the_documented_keys(frames):
    first, _ = frames
    assert {path.name for path in first.iterdir()} == {
        "frame.png",
        "radiance.exr",
        "truth.npz",
        "frame.json",
        "camera.toml",
        "calibration.toml",
        "preview.jpg",
    }
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
    plain = tmp_path / "plain"
    plain.write_text("mine")
    code, output, errors = here("export", "plane", *SET_SMALL, "--out", plain)
    assert (code, output, errors) == (2, "", [f"simtest: --out {plain}: is a file; must be a folder"])


@pytest.mark.render
def test_a_scene_out_of_sight(here):
    code, output, errors = here("render", "sphere", *SET_SMALL, "--set", "camera.cx=470", "--out", "x")
    assert (code, output) == (2, "")
    assert errors == ["simtest: scene sphere: no pixel sees the surface; move it, or widen the field of view"]


@pytest.mark.render
def test_the_smallest_camera_renders(tmp_path):
    done = child(
        "render", "plane", "--set", "camera.width=1", "--set", "camera.height=1", "--out", "x", folder=tmp_path
    )
    assert done.returncode == 0


@pytest.mark.render
@pytest.mark.parametrize("variable", [False, True])
def test_an_unknown_variant_exits_2(here, monkeypatch, variable):
    if variable:
        monkeypatch.setenv("SIMTEST_VARIANT", "scalar_mono")
    given = [] if variable else ["--variant", "scalar_mono"]
    code, output, errors = here("render", "plane", *SET_SMALL, "--out", "x", *given)
    assert (code, output, len(errors)) == (2, "", 1)
    given = "SIMTEST_VARIANT" if variable else "variant"
    assert f"{given} 'scalar_mono': cannot be used; allowed: " in errors[0]


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
    plain, other = tmp_path / "plain", tmp_path / "other"
    plain.write_text("mine")
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    for out, said in (
        (plain, f"--out {plain}: is a file; must be a folder"),
        (plain / "below", f"{plain / 'below'}: Not a directory"),
        (other, f"--out {other}: holds notes.txt, which is no part of a run; must be empty or hold a run"),
    ):
        code, output, errors = here("validate", "overview", "--out", out)
        assert (code, output) == (2, "")
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
    assert "Traceback" not in errors
    assert {"fingerprint.json", "case-00000.parquet"} <= held
    assert not {"results.parquet", "case-00004.parquet"} & held
    # No half-written file stays behind.
    assert not [name for name in held if name.startswith(".")]


@pytest.mark.render
def test_a_stopped_run_says_that_it_goes_on(stopped):
    *_, errors = stopped
    assert without_bar(errors.splitlines()) == [
        "simtest: stopped; what is finished is kept, and the same command goes on from there"
    ]


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


@pytest.mark.ci  # meanwhile: test_stopping: other commands whose reader has gone
def test_a_reader_that_has_gone_is_no_error():
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-c", MAIN, "schema", "scene"]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
