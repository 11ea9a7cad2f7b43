"""A run from start to end: exit codes, what it leaves, and what stops it."""

import errno
import json
import os
import re
import shutil
import signal
import sys
from dataclasses import replace
from datetime import timedelta
from functools import cache
from itertools import product
from pathlib import Path

import polars as pl
import pytest

from simtest.cli import main as command_line
from simtest.errors import BackendError, InputError, SimtestError
from simtest.nightly import run as run_module
from simtest.nightly.quantities import setting_figures
from simtest.nightly.run import RunOptions, run_nightly
from simtest.nightly.store import BASELINE_ROWS, Reports, accept, load_baseline, read_history, save_run
from simtest.runtime.resources import data_root
from simtest.spec import Profile, experiments_of, load_profile
from simtest.validation.cases import expand
from simtest.validation.columns import SCHEMA
from simtest.validation.fingerprints import definition
from tests.marked import marked
from tests.unit.nightly_samples import STARTED, make_rows, make_run, regression

DOCS = Path(__file__).resolve().parents[2] / "docs"

pytestmark = pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")

SMALL = """
title = "Small"
[[experiments]]
experiment = "planes.toml"
[[experiments]]
experiment = "paper"
labels = ["slant"]
realisations = 2
"""
PLANES = """
realisations = 3
estimators = ["cone_axis", "brightest_point"]
[[groups]]
scene = "plane"
label = "plane"
isolated = false
set = { "camera.width" = 96, "camera.height" = 96 }
sweep = [{ "surface.tilt_deg" = [0.5, 3.0] }]
"""


@pytest.fixture
def small(tmp_path):
    """Return the path of a profile of two quick experiments."""
    (tmp_path / "planes.toml").write_text(PLANES)
    (tmp_path / "small.toml").write_text(SMALL)
    return tmp_path / "small.toml"


@pytest.fixture
def reports(tmp_path):
    return Reports(tmp_path / "reports")


@cache
def sample():
    """Return a run of the samples; runs and their tables do not change."""
    return make_run()


plan_run = run_module.plan_run


@cache
def _plan_of(described):
    return plan_run(Profile.model_validate_json(described))


def planned(profile):
    """Return a profile's plan; a profile is expanded once in all tests, which takes half a second."""
    return _plan_of(profile.model_dump_json())


@pytest.fixture
def measured(monkeypatch):
    """Have runs that are measured in no time; return the list whose first one is next."""
    runs = [sample()] * 10

    def measure_run(profile, folder, run_id, *_, **__):
        return with_record(runs.pop(0), id=run_id, profile=profile.name)

    monkeypatch.setattr(run_module, "measure_run", measure_run)
    monkeypatch.setattr(run_module, "plan_run", planned)
    return runs


def with_record(run, **values):
    return replace(run, record=run.record.model_copy(update=values))


def quick():
    return load_profile("quick")


def accept_first(reports):
    run_nightly(quick(), reports)
    accept(reports, "quick", "first")


def contents(folder):
    """Return all files by path, but for locks."""
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.endswith("lock")
    }


# Profiles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["quick", "full"])
def test_shipped_profiles_represent_every_experiment(name):
    experiments = experiments_of(load_profile(name))
    shipped = {file.stem for file in (data_root("scenes") / "experiments").glob("*.toml")}
    # `mesh` is `colon` until it is given a mesh.
    assert {experiment.name for experiment in experiments} == shipped - {"mesh"}
    for experiment in experiments:
        assert expand(experiment)


def profile_of(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    return load_profile(tmp_path / "mine.toml")


def test_a_profile_cuts_experiments_down(tmp_path):
    profile = profile_of(tmp_path, """
        [[experiments]]
        experiment = "colon"
        name = "colon_few"
        labels = ["curvature", "bounces"]
        pool = 2
        seed = 9
        estimators = ["cone_axis"]
        [experiments.set]
        "sensor.noise_sigma" = 0.01
    """)  # fmt: skip
    (experiment,) = experiments_of(profile)
    assert (experiment.name, experiment.seed, experiment.estimators) == ("colon_few", 9, ("cone_axis",))
    assert [group.label for group in experiment.groups] == ["curvature", "bounces"]
    cases = expand(experiment)
    assert [case.swept["surface.viewpoint"] for case in cases] == [0, 1] * 4
    assert {case.data["sensor"]["noise_sigma"] for case in cases} == {0.01}


def test_the_profile_of_the_page_on_the_nightly_is_sound(tmp_path):
    (text,) = re.findall(r"```toml\n(.*?)```", (DOCS / "howto" / "nightly.md").read_text(), re.DOTALL)
    profile = profile_of(tmp_path, text)
    curvature, dark = experiments_of(profile)
    assert (curvature.realisations, dark.name, len(expand(dark))) == (8, "colon_dark", 4)


COLON = '[[experiments]]\nexperiment = "colon"\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (2 * COLON, "experiment colon: listed twice; give one of them another name"),
        (f'name = "../x"\n{COLON}', "name = '../x': must match the pattern"),
    ],
)
def test_a_profile_that_gives_two_reports_one_place_or_one_elsewhere_is_refused(tmp_path, text, said):
    with pytest.raises(InputError, match=f"mine.toml: .*{said}"):
        profile_of(tmp_path, text)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ('experiment = "kidney"', "kidney: no such file; shipped by name: anatomy, "),
        ('experiment = "colon"\nlabels = ["bends"]', "colon has no group 'bends'; allowed: curvature, light beside"),
        ('experiment = "colon"\nset = { "surface.typo" = 1 }', "surface.typo = 1: unknown key"),
        ('experiment = "colon"\nestimators = ["magic"]', "estimator 'magic': not installed"),
    ],
)
def test_a_night_refuses_an_experiment_before_it_works(tmp_path, reports, entry, said):
    profile = profile_of(tmp_path, f"[[experiments]]\n{entry}")
    with pytest.raises(InputError, match=said):
        run_nightly(profile, reports)
    assert contents(reports.root) == {}


# A whole night ---------------------------------------------------------------------------------------------------


@pytest.mark.render
def test_a_night_is_measured_kept_and_published(small, reports):
    """Twice, with an accept between them: the second has the first's bytes."""
    profile, steps = load_profile(small), []
    first = run_nightly(profile, reports, RunOptions("simtest nightly", progress=lambda *step: steps.append(step)))
    assert (first.judged.verdict.exit_code, first.judged.verdict.state) == (0, "no baseline")
    assert any("run simtest nightly accept" in note for note in first.judged.verdict.notes)
    (total,) = {total for _, total, _ in steps}
    assert [done for done, *_ in steps] == sorted(done for done, *_ in steps)
    assert steps[0][0] == 0
    assert steps[-1] == (total, total, "done")
    files = {path.name for path in first.folder.iterdir()}
    assert files == {"index.html", "verdict.json", "summary.md", "run.json", "rows.parquet", "figures.parquet"}
    history, _ = read_history(reports.history("small"))
    assert set(history["run_id"]) == {first.judged.run.record.id}
    assert json.loads((first.folder / "run.json").read_text())["command"] == "simtest nightly"
    assert not [path for path in reports.work.iterdir() if path.is_dir()]

    accept(reports, "small", "first")
    second = run_nightly(profile, reports)
    assert (second.judged.verdict.state, second.judged.verdict.bit_equal) == ("fine", True)
    assert second.judged.run.rows.equals(first.judged.run.rows)
    assert second.judged.run.figures.equals(first.judged.run.figures)
    assert read_history(reports.history("small"))[0]["run_id"].n_unique() == 2
    assert second.judged.verdict.baseline.reason == "first"


@pytest.mark.render
def test_experiments_with_findings_have_their_report(small, reports, monkeypatch):
    profile = load_profile(small)
    run_nightly(profile, reports)
    accept(reports, "small", "first")
    moved = lambda run, *_: replace(  # noqa: E731
        run,
        rows=run.rows.with_columns(pl.when(experiment="planes").then(9.0).otherwise("error_deg").alias("error_deg")),
    )
    compare = run_module.compare
    monkeypatch.setattr(run_module, "compare", lambda tonight, before: compare(refigured(moved(tonight)), before))
    outcome = run_nightly(profile, reports)
    assert outcome.judged.verdict.state == "regression"
    assert outcome.judged.reports == ("planes",)
    assert (outcome.folder / "reports" / "planes" / "index.html").is_file()
    assert json.loads((outcome.folder / "verdict.json").read_text())["reports"] == ["planes"]
    assert 'href="reports/planes/index.html"' in (outcome.folder / "index.html").read_text()


def refigured(run):
    """Return a run with the figures of its rows."""
    return replace(run, figures=setting_figures(run.rows))


def test_a_regression_exits_1(measured, reports, monkeypatch):
    accept_first(reports)
    monkeypatch.setattr(run_module, "compare", lambda tonight, baseline: regression(tonight))
    outcome = run_nightly(quick(), reports)
    assert outcome.judged.verdict.exit_code == 1
    assert json.loads((outcome.folder / "verdict.json").read_text())["exit_code"] == 1
    history, _ = read_history(reports.history("quick"))
    own = history.filter(pl.col("run_id") == outcome.judged.run.record.id)
    assert own["state"].unique().to_list() == ["regression"]


def own_rows(**values):
    """Return rows of an estimator of a user's that gives one normal, whatever the noise."""
    normal = {"normal_x": 0.3, "normal_y": 0.0, "normal_z": -(0.91**0.5)}
    values = {"estimator": "mine", "noise_sigma": 0.05, **normal, "error_deg": 0.7, "status": "ok", **values}
    return (
        make_rows()
        .filter(estimator="cone_axis")
        .with_columns(pl.lit(value).alias(name) for name, value in values.items())
        .cast(SCHEMA)
    )


def test_an_estimator_of_a_users_is_fine_where_nothing_changed(measured, reports):
    measured[:] = [make_run(rows=own_rows())] * 2
    accept_first(reports)
    verdict = run_nightly(quick(), reports).judged.verdict
    assert (verdict.state, verdict.bit_equal, verdict.exit_code) == ("fine", True, 0)
    assert verdict.causes == ()


BROKEN = {"status": "estimator_error", "flags": "the first candidate must be the proposed normal", "error_deg": None}


def test_an_error_inside_an_estimator_is_the_first_cause(measured, reports):
    broken = make_run(rows=own_rows(**BROKEN))
    measured[:] = [make_run(rows=own_rows()), broken, broken, broken]
    accept_first(reports)
    said = f"mine: {BROKEN['flags']}, {own_rows().height} times"
    assert run_nightly(quick(), reports).judged.verdict.causes[0] == f"{said}."
    # What the accepted run has as often needs no reason; without a baseline it is said.
    accept(reports, "quick", "it is known to fail")
    verdict = run_nightly(quick(), reports).judged.verdict
    assert (verdict.state, verdict.causes) == ("fine", ())
    alone = run_module.verdict_on(broken, None)
    assert (alone.state, alone.causes) == ("no baseline", (f"{said}.",))


@pytest.mark.filterwarnings("ignore:.*; skipped")
def test_damage_in_the_history_is_told_on_the_page_and_the_night_goes_on(measured, reports):
    first = run_nightly(quick(), reports)
    os.truncate(first.history_file, 50)
    second = run_nightly(quick(), reports)
    assert [note for note in second.judged.verdict.notes if first.history_file.name in note]
    assert first.history_file.stat().st_size == 50
    assert set(read_history(reports.history("quick"))[0]["run_id"]) == {second.judged.run.record.id}


def test_a_clock_that_goes_back_is_told_and_nothing_is_overwritten(measured, reports):
    measured[0] = with_record(measured[0], started=(STARTED + timedelta(days=30)).isoformat())
    first, second = (run_nightly(quick(), reports) for _ in range(2))
    assert [note for note in second.judged.verdict.notes if note.startswith("The clock went back")]
    assert not [note for note in first.judged.verdict.notes if "clock" in note]
    history, _ = read_history(reports.history("quick"))
    assert history["run_id"].unique(maintain_order=True).to_list() == [o.judged.run.record.id for o in (second, first)]


def test_a_damaged_baseline_stops_a_night_before_it_works(measured, reports):
    accept_first(reports)
    os.truncate(reports.baseline("quick") / "figures.parquet", 20)
    before, left = contents(reports.root), len(measured)
    with pytest.raises(InputError, match=r"baseline/quick/figures.parquet: damaged"):
        run_nightly(quick(), reports)
    assert contents(reports.root) == before
    assert len(measured) == left


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda run: replace(run, rows=run.rows.drop("seed")), "quick/night.parquet: damaged .no column seed"),
        (lambda run: replace(run, rows=run.rows.cast({"error_deg": pl.String})),
         "quick/night.parquet: damaged .column error_deg is of type String, not Float64"),
        pytest.param(lambda run: replace(run, figures=run.figures.cast({"value": pl.String})),
                     "quick/figures.parquet: damaged .column value is of type String, not Float64",
                     marks=pytest.mark.ci),
        (lambda run: with_record(run, profile="full"), "quick/run.json: profile = full; the "
         "baseline of this night must be of the profile quick"),
    ],
)  # fmt: skip
def test_a_baseline_that_cannot_be_compared_stops_a_night_before_it_works(measured, reports, change, said):
    """Its hashes are right: it was written so."""
    accept_first(reports)
    save_run(reports.baseline("quick"), change(load_baseline(reports, "quick")), BASELINE_ROWS)
    shutil.rmtree(reports.work)
    before, left = contents(reports.root), len(measured)
    with pytest.raises(InputError, match=said):
        run_nightly(quick(), reports)
    assert contents(reports.root) == before
    assert not reports.work.exists()
    assert len(measured) == left


@pytest.mark.parametrize("at", marked(range(8), ci=range(1, 7)))
def test_a_full_disk_is_told_and_nothing_is_lost(measured, reports, monkeypatch, at):
    """The disk is full from the n-th flush on: while the history, the tables, the outputs are written."""
    accept_first(reports)
    before = contents(reports.root)
    flushed, fsync = [], os.fsync

    def full(descriptor):
        flushed.append(descriptor)
        if len(flushed) > at:
            raise OSError(errno.ENOSPC, "No space left on device")
        fsync(descriptor)

    monkeypatch.setattr("simtest.runtime.files.os.fsync", full)
    with pytest.raises(
        SimtestError, match=r"the night could not be written .*No space left on device; .* free.*; what earlier"
    ):
        run_nightly(quick(), reports)
    monkeypatch.undo()
    after = contents(reports.root)
    assert {path: after.get(path) for path in before} == before
    assert {path.parts[0] for path in after.keys() - before.keys()} <= {"history"}


@pytest.mark.ci  # meanwhile: test_a_full_disk_is_told_and_nothing_is_lost stops at the same step
def test_the_next_night_works_after_a_full_disk(measured, reports, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "append", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOSPC, "No space")))
        with pytest.raises(SimtestError):
            run_nightly(quick(), reports)
    assert run_nightly(quick(), reports).judged.verdict.exit_code == 0


def fails_with(error):
    def fails(*_, **__):
        raise error

    return fails


def test_a_night_whose_report_cannot_be_drawn_is_kept_and_says_so(measured, reports, monkeypatch):
    accept_first(reports)
    monkeypatch.setattr(run_module, "write_report", fails_with(RuntimeError("no such\nframe")))
    monkeypatch.setattr(Path, "is_dir", lambda path, own=Path.is_dir: path.name in ("first", "second") or own(path))
    measured[:] = [make_run(rows=make_rows().with_columns(pl.col("error_deg") * 1.5))]
    outcome = run_nightly(quick(), reports)
    said = "The report of first could not be drawn (RuntimeError: no such frame)."
    assert said in outcome.judged.verdict.notes
    assert said in json.loads((outcome.folder / "verdict.json").read_text())["notes"]
    assert outcome.judged.reports == ()
    assert outcome.history_file.is_file()


STOPS = {"error0": RuntimeError("a page's fault"), "error1": KeyboardInterrupt()}


@pytest.mark.parametrize(
    ("step", "stop"),
    marked(
        product(["judge", "draw", "write_nightly_page", "append"], STOPS),
        ci=[("draw", "error0"), ("append", "error0"), *product(["judge", "draw", "write_nightly_page"], ["error1"])],
    ),
)
def test_nothing_is_kept_of_a_night_that_stops_before_it_is_whole(measured, reports, monkeypatch, step, stop):
    accept_first(reports)
    error = STOPS[stop]
    before = contents(reports.root)
    monkeypatch.setattr(run_module, step, fails_with(error))
    with pytest.raises(type(error)) as raised:
        run_nightly(quick(), reports)
    assert contents(reports.root) == before
    assert raised.value.args == error.args


def test_a_ctrl_c_after_the_history_says_what_is_kept(measured, here, monkeypatch, tmp_path):
    monkeypatch.setattr(run_module, "replace_folder", fails_with(KeyboardInterrupt()))
    code, output, errors = here()
    assert (code, output) == (130, "")
    assert errors[-1] == "simtest: stopped; this night is in the history; its page may not have been published"
    assert read_history(tmp_path / "reports" / "history" / "quick")[0].height


def test_a_fault_is_not_taken_for_a_full_disk(measured, reports, monkeypatch):
    for error in (pl.exceptions.ColumnNotFoundError("seed"), OSError(errno.ENOMEM, "Cannot allocate memory")):
        monkeypatch.setattr(run_module, "measure_run", fails_with(error))
        with pytest.raises(type(error)):
            run_nightly(quick(), reports)
    monkeypatch.setattr(run_module, "measure_run", fails_with(
        pl.exceptions.ComputeError("No space left on device (os error 28)")))  # fmt: skip
    with pytest.raises(SimtestError, match=r"the night could not be written .*No space left"):
        run_nightly(quick(), reports)


def test_an_acceptance_on_a_full_disk_is_told_in_one_line(measured, reports, monkeypatch):
    accept_first(reports)
    before = contents(reports.root)
    monkeypatch.setattr("simtest.runtime.files.os.fsync", fails_with(OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(
        SimtestError, match=r"the baseline could not be written .*No space left on device; .* free.*; the last"
    ):
        accept(reports, "quick", "second")
    assert contents(reports.root) == before


# Measuring -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished():
    """Experiments that are run, by their description: many nights below run the same."""
    return {}


@pytest.fixture
def parts(monkeypatch, finished):
    """Have experiments that were run already."""
    experiments = run_module.run_experiments

    def work(*arguments):
        described = tuple(experiment.model_dump_json() for experiment, _ in arguments[0])
        if described not in finished:
            finished[described] = experiments(*arguments)
        return finished[described]

    monkeypatch.setattr(run_module, "run_experiments", work)


PAPER = '[[experiments]]\nexperiment = "paper"\nlabels = ["noise"]\nrealisations = 1\n'


def night_of(tmp_path, text=PAPER):
    folder = tmp_path / f"night-{len(list(tmp_path.glob('night-*')))}"
    folder.mkdir()
    return run_module.measure_run(profile_of(tmp_path, text), folder, "id")


def test_a_run_that_measured_nothing_is_refused(tmp_path):
    """No highlight lies in view: history and gate would have no figure at all."""
    (tmp_path / "blank.toml").write_text(
        'realisations = 1\nestimators = ["brightest_point"]\n[[groups]]\nscene = "plane"\n'
        'set = { "surface.tilt_deg" = 60.0, "reflectance.diffuse" = 0.3, "camera.width" = 32, "camera.height" = 32 }\n'
    )
    blank = '[[experiments]]\nexperiment = "blank.toml"\n'
    with pytest.raises(InputError, match="profile mine: its experiments gave no rows; give it a setting"):
        night_of(tmp_path, blank)


def test_the_record_says_what_ran(parts, tmp_path):
    first, again, more = (night_of(tmp_path, text) for text in (PAPER, PAPER, PAPER + "seed = 3\n"))
    assert first.record.variants == {"paper": "llvm_ad_mono"}
    assert set(first.record.definitions) == {"paper"}
    assert re.fullmatch("[0-9a-f]{64}", first.record.definitions["paper"])
    assert first.record.definitions == again.record.definitions
    assert first.record.definitions != more.record.definitions


def test_a_definition_is_that_of_scene_and_files_and_not_of_place_source_or_prose(small, tmp_path, monkeypatch):
    def hashes(profile):
        return {own.name: definition(own, expand(own)) for own in experiments_of(load_profile(profile))}

    scene = tmp_path / "plane.toml"
    scene.write_text((data_root("scenes") / "plane.toml").read_text())
    planes = tmp_path / "planes.toml"
    planes.write_text(PLANES.replace('"plane"\nlabel', f'"{scene}"\nlabel'))
    first = hashes(small)
    monkeypatch.setattr("simtest.runtime.provenance.source_hash", lambda: "another")
    assert hashes(small) == first
    own = planes.read_text()
    planes.write_text(f'title = "Planes, told anew"\n{own}')
    assert hashes(small) == first
    planes.write_text(own)
    text = scene.read_text()
    scene.write_text(text + "\n# Another file.\n")
    assert hashes(small)["planes"] != first["planes"]
    assert hashes(small)["paper"] == first["paper"]


# The command -----------------------------------------------------------------------------------------------------


@pytest.fixture
def here(monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["simtest", "nightly", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            command_line.main()
        output, errors = capfd.readouterr()
        return stop.value.code, output, [line for line in errors.splitlines() if "━" not in line]

    return run


def test_the_command_prints_a_table_and_the_page(measured, here, tmp_path):
    code, output, errors = here()
    assert (code, errors) == (0, [])
    lines = output.splitlines()
    assert lines[0].strip() == "quick: no baseline"
    assert lines[-1] == "reports/nightly/quick/index.html"
    assert any(line.replace("│", " ").split() == ["first", "16", "15", "1", "0"] for line in lines)
    assert (tmp_path / lines[-1]).is_file()

    code, output, errors = here("accept", "--reason", "first night")
    assert (code, errors) == (0, [])
    assert output.endswith(" is the baseline of quick: first night\n")
    assert load_baseline(Reports(tmp_path / "reports"), "quick").record.reason == "first night"


@pytest.mark.ci  # meanwhile: test_the_command_prints_a_table_and_the_page, and test_gate_judged
def test_the_command_prints_what_is_worse(measured, here, monkeypatch):
    assert here()[0] == 0
    assert here("accept", "--reason", "first")[0] == 0
    worse = make_run(rows=make_rows().with_columns(pl.col("error_deg") * 1.5))
    measured[:] = [worse]
    code, output, _ = here()
    assert code == 1
    told = [line for line in output.splitlines() if line.startswith(("cone_axis in ", "circle_pose in "))]
    assert len(told) >= 4
    assert any(" in first, plane, tilt_deg=" in line and " deg, was " in line for line in told)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (BackendError("no libLLVM"), "no libLLVM"),
        (SimtestError("processes die"), "processes die"),
        (RuntimeError("odd"), "internal error, please report it (RuntimeError: odd); --traceback shows where"),
    ],
)
def test_a_night_that_could_not_be_run_exits_2(here, monkeypatch, error, said):
    """1 would be a regression."""
    monkeypatch.setattr(run_module, "measure_run", fails_with(error))
    assert here() == (2, "", [f"simtest: {said}"])


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--profile daily", "daily: no such file; shipped by name: full, quick"),
        ("--workers 0", "workers = 0: must be 1 to 256"),
        ("accept", "--reason: missing"),
        ("accept --reason because --profile full", "nightly/full: no night of the profile full; run simtest nightly"),
    ],
)
def test_bad_use_exits_2(here, line, said):
    code, output, (message,) = here(*line.split())
    assert (code, output) == (2, "")
    assert said in message


def test_ctrl_c_says_what_is_kept(here, monkeypatch, tmp_path):
    def stopped(profile, folder, run_id, options, planned):
        options.progress(0, 5, "first")
        os.kill(os.getpid(), signal.SIGINT)
        options.progress(1, 5, "first")

    monkeypatch.setattr(run_module, "measure_run", stopped)
    code, output, errors = here()
    assert (code, output) == (130, "")
    assert errors[-1] == (
        "simtest: stopped; nothing of this night is kept; history, baseline and the last page are as they were"
    )
    assert contents(tmp_path / "reports") == {}
