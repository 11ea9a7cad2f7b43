"""Cores in whole runs: equal rows, nothing of the truth, several workers, and no process left however a run ends."""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import polars as pl
import psutil
import pytest

import simtest
from simtest.dataset.manifest import new_manifest, read_manifest
from simtest.dataset.plan import Plan
from simtest.dataset.shard_writer import write_dataset
from simtest.errors import InputError
from simtest.estimators.names import close_cores
from simtest.runtime.provenance import file_hash
from simtest.spec.recipes import Dataset, PaperSetting, load_dataset
from simtest.validation.paper.gallery_item import reproduce_command
from tests.marked import marked
from tests.unit.core_helpers import BAD_CORE, CORES, OWN_CORE, processes_with, wait_until

EXPERIMENT = """
name = "aslant"
realisations = 2
seed = 7481927361
estimators = ["cone_axis"]

[[groups]]
scene = "cylinder"
isolated = false
label = "peculiar-setting-label"
set = { "camera.width" = 200, "camera.height" = 150 }
sweep = [{ "surface.tilt_deg" = [7.31, 13.77] }]
"""

PUBLISHED = """
name = "published-few"
realisations = 2
seed = 3
estimators = ["cone_axis"]

[[groups]]
scene = "published"
label = "few"
sweep = [{ "paper.sigma" = [0.0, 0.02] }]
"""


OF_LAWS = ("error_law_deg", "error_look_law_deg", "axis_ratio_seen_law")


def own_core(folder, *arguments):
    """Describe the core that runs an estimator of ours; it must choose the kernels of the linear algebra as we do."""
    path = folder / "own_core.toml"
    line = json.dumps(f"{sys.executable} {OWN_CORE} {' '.join(arguments)}".strip())
    path.write_text(f'[core]\nname = "own_core"\ncommand = {line}\nenvironment = ["OPENBLAS_CORETYPE"]\n')
    return str(path)


def command(script, *arguments):
    return f"command: {sys.executable} {script} {' '.join(map(str, arguments))}".strip()


@pytest.fixture
def experiment(tmp_path):
    path = tmp_path / "aslant.toml"
    path.write_text(EXPERIMENT)
    return path


@pytest.fixture
def published(tmp_path):
    """Return an experiment that renders nothing, so that it takes no time."""
    path = tmp_path / "published.toml"
    path.write_text(PUBLISHED)
    return path


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Run one of ours, the same as a core, and a foreign core; return the run, that core and what is left of it."""
    folder = tmp_path_factory.mktemp("told")
    (folder / "published.toml").write_text(PUBLISHED)
    mark = f"--mark={folder}"
    core = command(BAD_CORE, "none", mark)
    run = simtest.validate(
        folder / "published.toml", folder / "run", estimators=["cone_axis", own_core(folder, "cone_axis"), core]
    )
    left = [*processes_with(mark), *(c for c in psutil.Process().children() if "simtest-core" in " ".join(c.cmdline()))]
    return run, core, left


@pytest.fixture(autouse=True)
def no_core_stays():
    yield
    close_cores()


# The same rows --------------------------------------------------------------------------------------------------------


def same_but_for_the_name(results, first, second):
    """Check that two estimators have equal rows but for their names."""
    one, other = (results.filter(pl.col("estimator") == name).drop("estimator") for name in (first, second))
    assert len(one)
    assert "ok" in one["status"]
    differing = [name for name in one.columns if not one[name].equals(other[name])]
    # A core declares no laws, so none is predicted for it.
    assert all(name in OF_LAWS and other[name].null_count() == len(other) for name in differing), differing


def test_an_estimator_of_ours_gives_the_same_rows_as_a_core(told):
    same_but_for_the_name(told[0].results, "cone_axis", "own_core")


@pytest.mark.ci
def test_an_estimator_of_ours_gives_the_same_rows_as_a_core_over_files(tmp_path, published):
    core = own_core(tmp_path, "cone_axis", "--files")
    run = simtest.validate(published, tmp_path / "run", estimators=["cone_axis", core])
    same_but_for_the_name(run.results, "cone_axis", "own_core")


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("name", ["cone_axis", "circle_pose"])
def test_an_estimator_of_ours_gives_the_same_rows_as_a_core_in_rendered_frames(tmp_path, experiment, name):
    run = simtest.validate(experiment, tmp_path / "run", estimators=[name, own_core(tmp_path, name)])
    same_but_for_the_name(run.results, name, "own_core")


@pytest.mark.render
def test_a_frame_core_answers_for_the_highlight_that_it_looks_at(tmp_path, experiment):
    core = command(CORES / "brightest_core.py")
    run = simtest.validate(experiment, tmp_path / "run", realisations=1, estimators=["brightest_point", core])
    found = {name: rows for (name,), rows in run.results.group_by("estimator")}
    assert set(found) == {"brightest_point", "brightest_core"}
    own, others = found["brightest_core"], found["brightest_point"]
    assert set(own["status"]) == {"ok"}
    # The brightest pixel's centre against the sub-pixel peak.
    assert np.abs(own["look_x_px"].to_numpy() - others["look_x_px"].to_numpy()).max() < 0.75
    assert np.abs(own["error_deg"].to_numpy() - others["error_deg"].to_numpy()).max() < 0.5


@pytest.mark.render
@pytest.mark.slow
def test_two_workers_give_the_same_rows_as_one(tmp_path, experiment, monkeypatch):
    monkeypatch.chdir(CORES)
    core = f"command: {sys.executable} own_core.py cone_axis"
    runs = [simtest.validate(experiment, tmp_path / str(n), estimators=[core], workers=n) for n in (1, 2)]
    assert runs[0].results.equals(runs[1].results)
    assert set(runs[0].results["status"]) == {"ok"}


# Nothing of the truth -------------------------------------------------------------------------------------------------


def patterns(value):
    """Return the bytes by which a number that is not round could be told from all others."""
    return [repr(value)[:9].encode(), struct.pack("<d", value), struct.pack("<f", value)]


@pytest.mark.render
@pytest.mark.parametrize("kind", ["patch", "frame"])
def test_a_core_sees_nothing_of_the_truth(tmp_path, experiment, kind):
    spied = tmp_path / "spied.bin"
    out = tmp_path / "peculiar-output-folder"
    run = simtest.validate(experiment, out, estimators=[command(CORES / "spy_core.py", spied, f"--{kind}")])
    content = spied.read_bytes()
    rows = run.results
    assert "ok" in rows["status"]
    assert content.count(f'"type":"{kind}"'.encode()) == 4
    truths = ["truth_x", "truth_y", "truth_z", "bp_true_x_px", "bp_true_y_px", "kd_min", "kd_max", "eps_over_d"]
    values = {v for name in (*truths, "surface.tilt_deg") for v in rows[name].drop_nulls().to_list()}
    # A round number, such as 0, says nothing.
    telling = [v for v in values if abs(v * 1e3 - round(v * 1e3)) > 1e-9 or v in (7.31, 13.77)]
    assert len(telling) > 8
    found = [v for v in telling for pattern in patterns(v) if pattern in content]
    assert found == []
    # Searched for rightly: what it was told is found.
    told = rows["look_x_px"].to_list() if kind == "patch" else ['"width":200', '"K":[[']
    assert [v for v in told if str(v)[:9].encode() in content] == told
    words = ["7481927361", "peculiar", "aslant", "cylinder", "realisation", "truth", "setting", "seed", "noise_sigma"]
    words += [str(seed) for seed in rows["seed"].to_list()]
    assert [word for word in words if word.encode() in content] == []
    assert [seed for seed in rows["seed"].to_list() if struct.pack("<q", seed) in content] == []


@pytest.mark.render
def test_a_core_has_an_empty_folder_three_pipes_and_a_short_environment(tmp_path, experiment, monkeypatch):
    monkeypatch.setenv("SECRET_OF_THE_USER", "42")
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", "") or str(tmp_path))
    spied = tmp_path / "spied.bin"
    simtest.validate(experiment, tmp_path / "run", realisations=1, estimators=[command(CORES / "spy_core.py", spied)])
    line = next(line for line in spied.read_bytes().split(b"\n") if line.startswith(b"SURROUNDINGS "))
    seen = json.loads(line.removeprefix(b"SURROUNDINGS "))
    assert seen["tree"] == [[".", [], []]]
    assert sorted(seen["open"]) == ["0", "1", "2"]
    assert all(link.startswith("pipe:") for link in seen["open"].values())
    allowed = {"PATH", "HOME", "LANG", "LD_LIBRARY_PATH", "TMPDIR", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"}
    # Python itself adds LC_CTYPE in the C locale.
    assert {name for name in seen["environment"] if not name.startswith("LC_")} <= allowed
    assert seen["environment"]["TMPDIR"] == seen["cwd"]
    assert not os.path.exists(seen["cwd"])


# The end --------------------------------------------------------------------------------------------------------------

PARENT = """
import sys, time
from simtest.estimators import load_estimators
(estimator,) = load_estimators([sys.argv[1]]).values()
print(estimator.core._child.folder, flush=True)
{then}
"""


@contextmanager
def parent(then, fault, mark):
    """Yield a process that holds a core, and the core's folder; at the end neither core nor folder may be left."""
    line = [sys.executable, "-c", PARENT.format(then=then), command(BAD_CORE, fault, mark)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as started:
        folder = started.stdout.readline().strip()
        yield started, folder
    assert wait_until(lambda: not processes_with(mark))
    assert wait_until(lambda: not os.path.exists(folder))
    assert wait_until(lambda: not processes_with(folder))


@pytest.mark.parametrize("fault", ["stays", "ignores_term"])
def test_a_core_dies_with_a_parent_that_is_killed(tmp_path, fault):
    mark = f"--mark={tmp_path}-{fault}"
    with parent("time.sleep(60)", fault, mark) as (started, folder):
        assert len(processes_with(mark)) == 2  # the parent's own command line holds it too
        assert os.path.isdir(folder)
        started.kill()


def test_a_guard_is_no_child_so_that_who_kills_all_children_leaves_it(tmp_path):
    with parent("time.sleep(60)", "stays", f"--mark={tmp_path}") as (started, _):
        process = psutil.Process(started.pid)
        (core,) = process.children(recursive=True)
        for each in (core, process):
            each.kill()


@pytest.mark.parametrize(
    "then", marked(["", "raise SystemExit(1)", "import os; os._exit(0)"], ci=["", "import os; os._exit(0)"])
)
def test_a_core_ends_with_its_parent(tmp_path, then):
    with parent(then, "none", f"--mark={tmp_path}"):
        pass


@pytest.mark.parametrize(
    ("number", "workers"), [("SIGINT", 1), ("SIGTERM", 1), ("SIGKILL", 1), ("SIGINT", 2), ("SIGKILL", 2)]
)
@pytest.mark.slow
def test_a_run_that_is_stopped_leaves_no_process(tmp_path, number, workers):
    mark = f"--mark={tmp_path}"
    line = f"-m simtest validate paper --out {tmp_path / 'run'} --workers {workers} --estimator".split()
    core = command(BAD_CORE, "hang", "--spared3", mark)
    started = subprocess.Popen(
        [sys.executable, *line, core], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    held = lambda: [p for p in processes_with(mark) if p.pid != started.pid]  # noqa: E731
    assert wait_until(held, 60)
    time.sleep(1)
    started.send_signal(getattr(signal, number))
    started.wait(60)
    assert wait_until(lambda: not processes_with(mark))


def test_a_run_closes_its_cores(told):
    assert told[2] == []


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore:bad_core:RuntimeWarning")
def test_a_run_of_rendered_frames_closes_its_cores(tmp_path, experiment):
    mark = f"--mark={tmp_path}"
    simtest.validate(experiment, tmp_path / "run", realisations=1, estimators=[command(BAD_CORE, "none", mark)])
    assert processes_with(mark) == []


# What is told of it ---------------------------------------------------------------------------------------------------


def test_a_run_tells_of_its_cores(told):
    run, core, _ = told
    assert set(run.results["estimator"]) == {"cone_axis", "own_core", "bad_core"}
    summary = json.loads((run.folder / "summary.json").read_text())
    record = summary["run"]["cores"]["bad_core"]
    assert (record["command"], record["name"], record["version"]) == (core, "bad core", "0.1")
    assert len(record["files"][str(BAD_CORE)]) == 64
    assert "bad core 0.1" in summary["experiments"]["published-few"]["estimators"]["bad_core"]
    assert "bad_core" in run.page.read_text()


def test_an_experiment_and_a_nightly_profile_name_a_core(tmp_path, published):
    from simtest.nightly.run import measure_run, plan_run
    from simtest.spec.recipes import load_profile

    core = command(BAD_CORE, "none")
    published.write_text(PUBLISHED.replace('"cone_axis"', json.dumps(core)))
    assert simtest.load_experiment(published).estimators == (core,)
    profile = tmp_path / "profile.toml"
    entry = f'[[experiments]]\nexperiment = "{published}"\nestimators = ["cone_axis", {json.dumps(core)}]\n'
    profile.write_text(entry)
    planned = plan_run(load_profile(profile))
    made = measure_run(load_profile(profile), tmp_path / "scratch", "a", planned=planned)
    assert set(made.figures["estimator"]) >= {"cone_axis", "bad_core"}


def test_a_changed_program_is_another_run(tmp_path, published):
    script = tmp_path / "core.py"
    script.write_text(BAD_CORE.read_text())
    arguments = {"realisations": 1, "estimators": [command(script, "none")]}
    simtest.validate(published, tmp_path / "run", **arguments)
    before = (tmp_path / "run" / "summary.json").read_text()
    with pytest.warns(UserWarning, match="run: is kept, since the core's command and files are the same"):
        simtest.validate(published, tmp_path / "run", **arguments)
    assert (tmp_path / "run" / "summary.json").read_text() == before
    script.write_text(BAD_CORE.read_text().replace('"0.1"', '"0.2"'))
    with pytest.warns(UserWarning, match="another"):
        simtest.validate(published, tmp_path / "run", **arguments)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["run"]["cores"]["core"]["version"] == "0.2"


@pytest.mark.parametrize("extra", [pytest.param("", marks=pytest.mark.ci), "'$HOME' '\"!'"])
def test_the_command_that_makes_a_realisation_again_holds_the_core(extra):
    core = command(BAD_CORE, "none", extra)
    line = reproduce_command(PaperSetting(), (core,), 7)
    done = subprocess.run(["/bin/sh", "-c", line.replace("python -c", f"{sys.executable} -c", 1)], capture_output=True,
                          text=True, timeout=60, check=True)  # fmt: skip
    assert "bad_core" in done.stdout
    assert "Estimate(normal=(0, 0, -1)" in done.stdout


def test_the_manifest_of_a_dataset_holds_the_hashes_of_its_cores(tmp_path):
    dataset = load_dataset("smooth").model_copy(update={"estimators": (command(BAD_CORE, "none"),)})
    inputs = new_manifest(Plan(dataset), "llvm_ad_mono").origin["inputs"]
    assert inputs["core bad_core: bad_core.py"] == file_hash(BAD_CORE)
    for number in "12":
        (tmp_path / number).mkdir()
        (tmp_path / number / "net.bin").write_text(number)
    text = command(BAD_CORE, "none", str(tmp_path / "1" / "net.bin"), str(tmp_path / "2" / "net.bin"))
    dataset = dataset.model_copy(update={"estimators": (text,)})
    inputs = new_manifest(Plan(dataset), "llvm_ad_mono").origin["inputs"]
    assert inputs["core bad_core: net.bin"] == file_hash(tmp_path / "1" / "net.bin")
    assert inputs["core bad_core: net.bin (2)"] == file_hash(tmp_path / "2" / "net.bin")


def test_a_worker_of_a_dataset_finds_its_core_in_any_folder(tmp_path, monkeypatch):
    (tmp_path / "core.py").write_text(BAD_CORE.read_text())
    monkeypatch.chdir(tmp_path)
    named = f"command: {sys.executable} core.py none"
    dataset = load_dataset("smooth").model_copy(update={"estimators": (named,)})
    tasks = []

    class Stopping:
        def run(self, _, given, __):
            tasks.extend(given)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(dataset, tmp_path / "data", Stopping())
    (estimator,) = Dataset.model_validate_json(tasks[0].dataset).estimators
    assert str(tmp_path / "core.py") in estimator
    # The manifest names it as the user did.
    assert read_manifest(tmp_path / "data").dataset["estimators"] == [named]


@pytest.mark.filterwarnings("ignore:.*is kept, since:UserWarning")
def test_the_failures_of_a_core_are_counted(tmp_path, published):
    def validate():
        return simtest.validate(published, tmp_path / "run", realisations=3, estimators=[command(BAD_CORE, "exit")])

    with pytest.warns(RuntimeWarning, match="bad_core: core_died: .*no licence for this highlight.*, 6 times") as told:
        run = validate()
    assert len(told) == 1
    assert set(run.results["status"]) == {"core_died"}
    # At the sixth fault in a row the core is not asked any more, in each part anew.
    assert run.results["flags"].str.contains("no licence for this highlight").all()
    assert not run.results["flags"].str.contains("not asked").any()
    # Its text stands in summary.json and on the page, and the guide calls it failed.
    (fault,) = run.summary["experiments"]["published-few"]["faults"]
    assert (fault["estimator"], fault["reason"], fault["count"]) == ("bad_core", "core_died", 6)
    assert "no licence for this highlight" in run.page.read_text()
    guide = json.loads((run.folder / "guide.json").read_text())
    figures = [row["methods"]["bad_core"] for row in guide["rows"]]
    assert (sum(each["failed"] for each in figures), sum(each["refused"] for each in figures)) == (6, 0)
    # A finished run that is asked for again tells it again.
    with pytest.warns(RuntimeWarning, match="no licence for this highlight"):
        validate()


def test_a_frame_core_does_not_fit_the_published_protocol(tmp_path, published):
    core = command(BAD_CORE, "none", "--frame")
    with pytest.raises(InputError, match="needs a whole frame"):
        simtest.validate(published, tmp_path / "run", realisations=1, estimators=[core])


@pytest.mark.parametrize("kind", ["", "--frame"])
def test_a_picture_is_reconstructed_by_a_core(kind):
    y, x = np.mgrid[:480, :640] + 0.5
    picture = np.exp(-((x - 320) ** 2 + (y - 240) ** 2) / 200)
    camera = simtest.Camera.from_fov(70.0, 640, 480)
    made = simtest.reconstruct(picture, camera, estimators=["cone_axis", command(BAD_CORE, "none", kind)])
    assert made.choices.estimators == ("cone_axis", "bad_core")
    (spot,) = made
    assert spot.estimates["bad_core"].normal.tolist() == [0, 0, -1]
