"""Manners of the commands: lists, completion, JSON, suggestions, how much is said."""

import json
import subprocess
import sys
import time
import tomllib
import types
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import simtest
from simtest.cli import commands, common, main, progress
from simtest.cli.common import gather_settings
from simtest.cli.runs import validate
from simtest.cli.scenes import HEADINGS, names_of
from simtest.dataset import verify as verifying
from simtest.errors import InputError
from simtest.estimators.names import DESCRIPTIONS, ESTIMATORS, describe_estimators, load_estimators
from simtest.rendering import backend
from simtest.rendering.backend import BackendReport
from simtest.runtime.boundary import suggestion
from simtest.runtime.resources import OWN
from simtest.spec import load_dataset, load_experiment, load_profile, load_scene

ROOT = Path(__file__).resolve().parents[2]
MAIN = "from simtest.cli.main import main; main()"


@pytest.fixture(autouse=True)
def ordinary(monkeypatch):
    """Leave no flags and no handler of warnings behind."""
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(main.MANNERS, "quiet", False)
    monkeypatch.setattr(main.MANNERS, "verbose", False)


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


def test_estimators_are_described_without_being_imported():
    code = (
        "import sys; from simtest.cli.scenes import names_of; print(names_of('estimators')['inverse_rendering'])\n"
        "assert not {'numpy', 'scipy', 'mitsuba', 'cv2'} & set(sys.modules), sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(DESCRIPTIONS["inverse_rendering"].rstrip("."))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
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


def test_every_command_has_its_help(here):
    for name in commands.COMMANDS:
        code, output, errors = here(name, "--help")
        assert (code, errors) == (0, [])
        assert output.startswith(f"Usage: simtest {name}")
        assert "--quiet" in output


# Did you mean ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("rendr plane", 'Did you mean "render"?'),
        ("render plane --out x --varient llvm", "Did you mean --variant?"),
        ("render plan --out x", "(did you mean plane?)"),
        ("render tissue_stomac --out x", "(did you mean tissue_stomach?)"),
        ("validate overveiw", "(did you mean overview?)"),
        ("nightly --profile quik", "(did you mean quick?)"),
        ("validate overview --estimator circle", "(did you mean circle_pose?)"),
        ("render plane --out x --set surface.tilt=3", "(did you mean tilt_deg?)"),
        ("render plane --out x --set surfase.tilt_deg=3", "(did you mean surface?)"),
        ("render plane --out x --set reflectance.type=phonk", "(did you mean phong?)"),
        ("render plane --out x --variant lvm", "(did you mean llvm?)"),
        ("validate overview --set realisation=1", "(did you mean realisations?)"),
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


@pytest.mark.parametrize("count", [0, 1, 30])
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
    assert lines[-1] == {0: "sound", 1: "1 fault"}.get(count, "30 faults")
    if count == 30:
        assert len(lines) == 22
        assert lines[20] == "and 10 more; --verbose prints them all"
        assert len(here("dataset", "verify", "d", "--verbose")[1].splitlines()) == 31


def test_json_holds_neither_nan_nor_paths_that_break_it(capsys):
    from pathlib import Path

    import numpy as np

    common.print_json({"x": float("nan"), "y": np.array([1.0, np.inf]), "file": Path("a/b")})
    assert json.loads(capsys.readouterr().out) == {"x": None, "y": [1.0, None], "file": "a/b"}


def test_reports_are_json_on_request():
    """Each command that reports takes --json: whoever adds one is reminded."""
    reports = {"calibrate light", "core check", "score", "advise", "twin",
               "doctor", "list", "render", "views", "view", "export", "reconstruct", "realism", "fit", "validate",
               "nightly", "nightly accept", "dataset", "dataset verify", "dataset sample", "dataset preview",
               "dataset export", "mesh check", "mesh colon", "mesh liver", "bench run", "bench table",
               "bench cases", "bench frames", "camera show", "camera convert"}  # fmt: skip
    without = {"schema", "completion", "mesh"}  # a schema is JSON, a script is none, mesh alone does nothing
    for name in reports:
        found, *_ = commands.APP.parse_commands(name.split())[1][-1:]
        assert any("--json" in argument.names for argument in found.assemble_argument_collection()), name
    assert {name.split()[0] for name in reports} | without == set(commands.COMMANDS)


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "simtest", "--version"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, simtest.__version__, "")


def test_a_command_that_is_gone_says_what_takes_its_place(here):
    assert not set(commands.GONE) & set(commands.COMMANDS)
    for name, instead in commands.GONE.items():
        assert here(name, "--out", "x") == (2, "", [f"simtest: {name}: is gone; {instead}"])


# How much is said ------------------------------------------------------------------------------------------------


def test_flags_stand_anywhere_but_behind_two_dashes():
    assert main.take_flags(["--quiet", "render", "x", "--traceback"]) == (["render", "x"], True)
    assert (main.MANNERS.quiet, main.MANNERS.verbose) == (True, False)
    assert main.take_flags(["render", "--", "--verbose"]) == (["render", "--", "--verbose"], False)
    assert (main.MANNERS.quiet, main.MANNERS.verbose) == (False, False)


def test_quiet_and_verbose_exclude_each_other(here):
    assert here("doctor", "--quiet", "--verbose")[::2] == (
        2, ["simtest: --quiet and --verbose exclude each other; give one of them"],
    )  # fmt: skip


def warned(*_):
    warnings.warn("look here", stacklevel=1)
    return BackendReport("llvm_ad_mono", None, [], {}, None)


@pytest.mark.parametrize(("flags", "lines"), [((), ["simtest: warning: look here"]), (("--quiet",), [])])
def test_quiet_leaves_out_warnings(here, monkeypatch, flags, lines):
    monkeypatch.setattr(backend, "examine", warned)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, output, errors = here("doctor", *flags)
    assert (code, errors) == (0, lines)
    assert "rendering   works" in output


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
    monkeypatch.setattr(main.MANNERS, "verbose", True)
    assert steps(capsys) == [f"simtest: {i}/3 {'the end' if i == 3 else f'step {i}'} (0 s)" for i in range(4)]


def test_quiet_shows_no_progress_at_a_terminal_either(capsys, monkeypatch):
    monkeypatch.setattr(progress, "at_terminal", lambda: True)
    monkeypatch.setattr(main.MANNERS, "quiet", True)
    assert steps(capsys) == []


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
    monkeypatch.setattr(main.MANNERS, "verbose", True)
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


@pytest.mark.parametrize(("number", "text"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames")])
def test_nouns_agree_with_their_number(number, text):
    assert common.counted(number, "frame") == text


class Spots(list):
    """Specularities without an estimate or a reference: two of three isolated, the others clusters."""

    reference = None

    def __init__(self, count):
        super().__init__(
            SimpleNamespace(id=i, kind="cluster" if i % 3 == 0 else "isolated", score=0.5, best=None,
                            best_estimate=None, peak_px=(1.0, 2.0), normals={})
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
    monkeypatch.setattr(main.MANNERS, "verbose", True)
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
